"""Commands that run a campaign or a case, and that read the folder of a campaign."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from merge_sumo.commands.application import Given, app
from merge_sumo.commands.options import (
    HOSTING,
    RUNNING,
    SETUP,
    VUT_AGAIN,
    RunArgument,
    flag,
    option,
    optional,
)
from merge_sumo.commands.printing import folder_of, print_json, quoted, say, show, stoppable
from merge_sumo.errors import UserError

if TYPE_CHECKING:
    from merge_sumo.api import CaseRun

SETTINGS: Final = (*("vut", "against", "level", "sampler", "cases", "in_flight", "seed"),)
COORDINATES: Final = ("x", "v", "psi", "headway_ahead", "headway_behind")


@app.verb(
    options=(
        *(
            *SETTINGS,
            "stop_when_converged",
            "repeat",
            "tolerate",
            *SETUP,
        ),
        *RUNNING,
    )
)
def campaign(
    given: Given,
    out: Annotated[
        Path | None, typer.Option(help="New folder to write.", show_default="runs/VUT-DATE")
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN", help="Go on with the campaign in this folder; --cases may be more."
        ),
    ] = None,
    gate: Annotated[
        list[str] | None,
        typer.Option(
            metavar="GATE",
            help='Exit with 1 if there are failures, errors, timeouts, "fmc>X": an FMC above X at '
            "some level, or, with --against, regressions. May be given several times.",
        ),
    ] = None,
    junit: Annotated[
        Path | None, typer.Option(metavar="FILE", help="New file to write for CI: JUnit XML.")
    ] = None,
) -> None:
    """Test a VUT: run cases in SUMO, find failures, write a report and replayable scenarios.

    Ctrl-C lets the running batch end and says how to go on; twice stops at once.

    Exit code 1 when a --gate is met, and always when the VUT merged in no case: then
    nothing was tested. 2 for bad use, 130, 141 or 143 when it was stopped, else 0.

    Example:  merge-sumo campaign --vut design1 --level 0 --cases 400 --seed 1

    Example:  merge-sumo campaign --vut design1 --against design2 --level 0 --cases 40
    """
    from merge_sumo import api

    folder, gates = folder_of(out, resume, given.keywords["vut"]), gate or []
    for_ci: dict[str, Any] = {"gates": gates, "junit": junit}

    def how_to_go_on() -> str:
        return _how_to_go_on(folder, gates, junit)

    with stoppable("batch", how_to_go_on) as check:
        if resume is None:
            run = api.campaign(**given.keywords, **for_ci, out=folder, check=check)
        else:
            run = api.resume(folder, **given.written, **for_ci, check=check)
    given.print(run)
    for remark in run.remarks():
        say(remark)
    raise typer.Exit(0 if run.passed else 1)


def _how_to_go_on(folder: Path, gates: list[str], junit: Path | None) -> str:
    if not folder.exists():
        return "stopped before the first case; nothing was written"
    from merge_sumo import api

    # None of these is a setting of the campaign that its folder would bring.
    words = [f"--resume {quoted(folder)}{api.open_run(folder).named_again}"]
    words += [f"--gate {quoted(gate)}" for gate in gates]
    if junit is not None:
        words.append(f"--junit {quoted(junit)}")
    return f"stopped; go on with: merge-sumo campaign {' '.join(words)}"


@app.verb(
    options=(*COORDINATES, *SETUP),
    own={
        "vut": VUT_AGAIN,
        "level": optional(
            str, "POV level: 0, 1, 2 or own.", show_default="0, with --case the campaign's"
        ),
        "debug": flag(
            "Run the VUT in this process without a deadline: breakpoints work.", "--debug"
        ),
    },
)
def run(
    given: Given,
    case: Annotated[
        tuple[Path, int] | None,
        typer.Option(
            metavar="RUN INDEX", help="A case of a campaign instead; options given beside it win."
        ),
    ] = None,
    at: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=NUMBER", help="Any coordinate of the case, by its name in outcomes.jsonl."
        ),
    ] = None,
    gui: Annotated[
        bool, typer.Option("--gui", help="Show it in sumo-gui while it runs, in real time.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option(help="New folder to keep it in, for `replay` and sumo-gui.")
    ] = None,
) -> None:
    """Run one case and show what happens: verdict, measures, and the motion second by second.

    Exit code 0 when the case passes, 1 when it fails, errs or times out, 2 for bad use.

    Example:  merge-sumo run --vut design2 --level 2 --x -298.6 --v 34.5 --psi 0.62
    """
    from merge_sumo import api

    def ended(result: CaseRun) -> None:
        if given.as_json:
            given.print(result, out=out)
            return
        given.print(result)
        if out is not None:
            show(f"kept: merge-sumo replay {quoted(out)} --gui")
        if gui:
            say("close the window to go on")

    options = given.keywords if case is None else given.written
    options = {**options, **_coordinates(at or [])}
    result = api.run(recorded=case, gui=gui, out=out, on_end=ended, **options)
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


@app.verb(
    options=("level", *HOSTING, "pov", "policies", *RUNNING),
    own={"vut": VUT_AGAIN},
)
def rerun(
    given: Given,
    run: RunArgument,
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
        ),
    ] = False,
) -> None:
    """Run recorded cases again with a changed VUT, and say which broke and which are fixed.

    The cases are those of the old version's search: `campaign --against` searches where the new one
    alone fails.

    Exit code 1 when a case broke: it passed, and does not pass now.

    Example:  merge-sumo rerun runs/design2 3 7 --vut design2

    Example:  merge-sumo rerun runs/design2 --stress
    """
    from merge_sumo import api

    if stress:
        if case or "level" in given.written:
            raise UserError("--stress runs all cases: leave indices and --level away")
        given.print(api.stress(run, **given.written))
        return
    result = api.rerun(run, case or (), **given.written)
    given.print(result)
    raise typer.Exit(1 if result.worse else 0)


@app.verb()
def compare(
    given: Given,
    runs: Annotated[
        list[Path],
        typer.Argument(help="Folders of campaigns, the oldest first."),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="New HTML page to write: what changed, in which cases, and both motions.",
        ),
    ] = None,
    junit: Annotated[
        Path | None, typer.Option(metavar="FILE", help="New file to write for CI: JUnit XML.")
    ] = None,
) -> None:
    """Compare recorded versions of a VUT: what broke, and what was fixed.

    Everything is read from the records. Cases that two campaigns share are paired; where each has
    cases of its own, regions of failures are compared, as a hint.

    Exit code 1 when a case broke, or the last version was tested in no case.

    Example:  merge-sumo compare runs/design1 runs/design2 --out changes.html
    """
    from merge_sumo import api

    result = api.compare(runs, out=out, junit=junit)
    given.print(result, page=out)
    raise typer.Exit(1 if result.worse else 0)


@app.verb(
    own={
        "file_format": option(
            str,
            "sumo",
            "Format: {formats}. sumo: folders that sumo-gui replays. openscenario: folders with "
            "OpenSCENARIO and OpenDRIVE. csv: "
            "one table of motion.",
            "--format",
        ),
        "out": optional(
            Path, "Folder to write into.", show_default="RUN/scenarios for sumo, else RUN/exports"
        ),
    },
)
def export(
    given: Given,
    run: RunArgument,
    case: Annotated[
        list[int] | None,
        typer.Argument(help="Indices of cases in outcomes.jsonl; csv: all if left out."),
    ] = None,
) -> None:
    """Write cases of a campaign for SUMO, for other simulators, or as a table.

    Example:  merge-sumo export runs/design2 17 42
    """
    from merge_sumo import api

    paths = api.export(run, case or None, **given.keywords)
    if given.as_json:
        print_json({"written": list(map(str, paths))})
        return
    for path in paths:
        show(path)


@app.verb()
def replay(
    given: Given,
    folder: Annotated[
        Path,
        typer.Argument(help="A scenario folder, or a campaign's."),
    ],
    case: Annotated[
        int | None, typer.Argument(help="Index of the campaign's case in outcomes.jsonl.")
    ] = None,
    gui: Annotated[bool, typer.Option("--gui", help="Open it in sumo-gui.")] = False,
) -> None:
    """Replay a scenario in SUMO and check every position and speed against its record.

    A case of a campaign that was not exported yet is exported first. Prints "identical" (exit
    code 0) or "diverged at t = ..." (exit code 1).

    Example:  merge-sumo replay scenarios/stalemate --gui
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
