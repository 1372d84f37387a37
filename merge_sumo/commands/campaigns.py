"""Commands that run a campaign or a case, and that read the folder of a campaign."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from merge_sumo import options, verbs
from merge_sumo.commands.application import Given, app
from merge_sumo.commands.printing import folder_of, print_json, quoted, say, show, stoppable
from merge_sumo.errors import UserError
from merge_sumo.options import TESTED, WHERE

if TYPE_CHECKING:
    from merge_sumo.api import CaseRun

VutOption = Annotated[
    str,
    typer.Option(
        metavar="SPEC",
        help="Vehicle under test: level0, level1, level2, design1 or design2, or your own: "
        "`merge-sumo vuts` lists the kinds.",
        rich_help_panel=TESTED,
    ),
]
RunArgument = Annotated[Path, typer.Argument(help="Folder of a campaign.")]


@app.verb(verbs.Campaign)
def campaign(
    given: Given,
    vut: VutOption = "",
    resume: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN",
            help="Go on with the campaign in this folder; --cases may be more.",
            rich_help_panel=WHERE,
        ),
    ] = None,
) -> None:
    from merge_sumo import api

    asked = given.keywords
    folder = folder_of(asked["out"], resume, vut)

    def how_to_go_on() -> str | None:
        return _how_to_go_on(folder, list(asked["gates"]), asked["junit"], asked["workers"])

    with stoppable("batch", how_to_go_on) as check:
        if resume is None:
            run = api.campaign(vut, **{**asked, "out": folder, "check": check})
        else:
            run = api.resume(folder, **{**given.written, "vut": vut or None, "check": check})
    given.print(run)
    for remark in run.remarks():
        say(remark)
    raise typer.Exit(0 if run.passed else 1)


def _how_to_go_on(
    folder: Path, gates: list[str], junit: Path | None, workers: int | str | None
) -> str | None:
    if not folder.exists():
        return None
    from merge_sumo import api

    # None of these is a setting of the campaign that its folder would bring.
    words = [api.open_run(folder).go_on]
    words += [f"--gate {quoted(gate)}" for gate in gates]
    if junit is not None:
        words.append(f"--junit {quoted(junit)}")
    if isinstance(workers, str):
        words.append(f"--workers {quoted(workers)}")
    return f"go on with: {' '.join(words)}"


@app.verb(verbs.RunCase)
def run(
    given: Given,
    case: Annotated[
        tuple[Path, int] | None,
        typer.Option(
            metavar="RUN INDEX",
            help="A case of a campaign instead; options given beside it win.",
            rich_help_panel=TESTED,
        ),
    ] = None,
    at: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=NUMBER",
            help="Any coordinate of the case, by its name in outcomes.jsonl.",
            rich_help_panel=TESTED,
        ),
    ] = None,
) -> None:
    from merge_sumo import api

    out, gui = given.keywords["out"], given.keywords["gui"]

    def ended(result: CaseRun) -> None:
        if given.as_json:
            given.print(result, out=out)
            return
        given.print(result)
        if out is not None:
            show(f"kept: merge-sumo replay {quoted(out)} --gui")
        if gui:
            say("the replay is open in sumo-gui: close the window to end")

    asked = given.keywords if case is None else given.written
    result = api.run(**{**asked, "recorded": case, "at": _coordinates(at or []), "on_end": ended})
    raise typer.Exit(0 if result.passed else 1)


def _coordinates(given: list[str]) -> dict[str, float]:
    """Return coordinates that are given as NAME=NUMBER."""
    values: dict[str, float] = {}
    for text in given:
        name, _, number = text.partition("=")
        try:
            values[name.strip()] = float(number)
        except ValueError:
            raise UserError(f"--at {text}: give NAME=NUMBER, as x_pov0_m=-250") from None
    return values


@app.verb(verbs.Rerun)
def rerun(
    given: Given,
    run: Annotated[Path, typer.Argument(help="Folder of a campaign, or a cases file.")],
    case: Annotated[
        list[int] | None,
        typer.Argument(help="Indices of cases in outcomes.jsonl; all if left out."),
    ] = None,
    stress: Annotated[
        bool,
        typer.Option(
            "--stress",
            help="Change the simulation and not the VUT: a shorter step, an actuator that lags, "
            "limited power, a start that is off by the error of a sensor, longer cars. Failures "
            "that fail every time are robust.",
            rich_help_panel=options.CASES,
        ),
    ] = False,
) -> None:
    from merge_sumo import api

    if stress:
        if case or given.written.keys() & {"level", "out", "junit"}:
            raise UserError(
                "--stress runs all cases: leave indices, --level, --out and --junit away"
            )
        given.print(api.stress(run, **given.written))
        return
    result = api.rerun(run, case or (), **given.written)
    given.print(result, **{"page" if result.text is None else "cases": given.keywords["out"]})
    raise typer.Exit(1 if result.worse else 0)


@app.verb(verbs.Compare)
def compare(
    given: Given,
    runs: Annotated[
        list[Path],
        typer.Argument(help="Folders of campaigns, the oldest first."),
    ],
) -> None:
    from merge_sumo import api

    result = api.compare(runs, **given.keywords)
    given.print(result, page=given.keywords["out"])
    raise typer.Exit(1 if result.worse else 0)


@app.verb(verbs.Export)
def export(
    given: Given,
    run: RunArgument,
    case: Annotated[
        list[int] | None,
        typer.Argument(help="Indices of cases in outcomes.jsonl; csv: all, cases: 40 by default."),
    ] = None,
) -> None:
    from merge_sumo import api

    paths = api.export(run, case or None, **given.keywords)
    if given.as_json:
        print_json({"written": list(map(str, paths))})
        return
    for path in paths:
        show(path)


@app.verb(options.Beginning)
def replay(
    given: Given,
    folder: Annotated[
        Path,
        typer.Argument(help="A scenario folder, or a campaign's."),
    ],
    case: Annotated[
        int | None, typer.Argument(help="Index of the campaign's case in outcomes.jsonl.")
    ] = None,
    gui: Annotated[
        bool, typer.Option("--gui", help="Open it in sumo-gui.", rich_help_panel=WHERE)
    ] = False,
) -> None:
    """Replay a scenario in SUMO and check every position and speed against its record.

    A case of a campaign is exported first. Says what happened, then "identical" (exit code 0) or
    "diverged at t = ..." (exit code 1).

    Example:  merge-sumo replay scenarios/stalemate --gui --from -3
    """
    from merge_sumo import api

    if gui:
        raise typer.Exit(api.open_in_gui(folder, case, **given.keywords))
    result = api.replay(folder, case, **given.keywords)
    given.print(result)
    raise typer.Exit(0 if result.identical else 1)


@app.verb()
def report(given: Given, run: RunArgument) -> None:
    """Write the report of a campaign again and print its path.

    With --json each of its facts is printed, with the file and the key that it is from.

    Example:  merge-sumo report runs/design2
    """
    from merge_sumo import api

    opened = api.open_run(run)
    given.print(api.report(opened))
    if sentence := opened.run.interruption:
        say(sentence)
