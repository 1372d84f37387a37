"""Commands that run a campaign or a case, and that read the folder of a campaign."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from merge_sumo.commands import complete
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
    from merge_sumo.api import CampaignRun, CaseRun, RunComparison

SETTINGS: Final = (
    *("vut", "against", "level", "sampler", "cases", "in_flight", "seed", "learn_from"),
)
COORDINATES: Final = ("x", "v", "psi", "headway_ahead", "headway_behind")


@app.verb(
    options=(
        *(
            *SETTINGS,
            "stop_after_converged",
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
            metavar="RUN",
            help="Go on with the campaign in this folder; --cases may be more.",
            autocompletion=complete.runs,
        ),
    ] = None,
    gate: Annotated[
        list[str] | None,
        typer.Option(
            metavar="GATE",
            help='Exit with 1 if there are failures, errors, timeouts, "fmc>X": an FMC above X at '
            "some level, or, with --against, regressions. May be given several times.",
            autocompletion=complete.gates,
        ),
    ] = None,
    junit: Annotated[
        Path | None, typer.Option(metavar="FILE", help="New file to write for CI: JUnit XML.")
    ] = None,
) -> None:
    """Test a VUT: run cases in SUMO, find failures, write a report and replayable scenarios.

    Ctrl-C lets the running batch end and says how to go on; twice stops at once.

    Exit code 1 when a --gate is met, and always when the VUT merged in no case: then
    nothing was tested. 2 for bad use, 130 or 143 when it was stopped, else 0.

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
            str,
            "POV level: 0, 1, 2 or own.",
            show_default="0, with --case the campaign's",
            autocompletion=complete.one_level,
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
    result = api.run_case(recorded=case, gui=gui, out=out, on_end=ended, **options)
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
    options=("level", *HOSTING, "policies", "tolerance", *RUNNING),
    own={"vut": VUT_AGAIN},
)
def rerun(
    given: Given,
    run: RunArgument,
    case: Annotated[
        list[int] | None,
        typer.Argument(help="Indices of cases in outcomes.jsonl; all if left out."),
    ] = None,
) -> None:
    """Run recorded cases again with a changed VUT, and say which verdicts changed.

    Exit code 1 when it is worse than what was recorded, as in compare-runs: at some level the share
    of cases with an error, with an error or a timeout, or the failure mode coverage (FMC) grew by
    more than the tolerance, or it merged in no case.

    Example:  merge-sumo rerun runs/design2 3 7 --vut design2
    """
    from merge_sumo import api

    tolerance = given.keywords["tolerance"]
    changed = {name: value for name, value in given.written.items() if name != "tolerance"}
    result = api.rerun(run, case or (), **changed)
    why = result.compared.worse(tolerance)
    if given.as_json:
        print_json({**result.to_record(), **_judgement(why, tolerance)})
    else:
        given.print(result)
        for one in result.changed[:1]:
            show(
                f"look at one: merge-sumo run --case {quoted(run)} {one.index} "
                f"--vut {quoted(result.vut)} --gui"
            )
        show(f"it is {result.compared.judgement(tolerance)} (A is what was recorded, B is now)")
        for sentence in why:
            show(f"  {sentence}")
    raise typer.Exit(1 if why else 0)


def _judgement(why: list[str], tolerance: float) -> dict[str, Any]:
    return {"tolerance": tolerance, "worse": bool(why), "why": why}


@app.verb(
    own={
        "file_format": option(
            str,
            "sumo",
            "Format: {formats}. sumo: folders that sumo-gui replays. openscenario: folders with "
            "OpenSCENARIO and OpenDRIVE. csv, parquet: "
            "one table of motion.",
            "--format",
            autocompletion=complete.formats,
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
        typer.Argument(help="Indices of cases in outcomes.jsonl; csv, parquet: all if left out."),
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
        typer.Argument(help="A scenario folder, or a campaign's.", autocompletion=complete.runs),
    ],
    case: Annotated[
        int | None, typer.Argument(help="Index of the campaign's case in outcomes.jsonl.")
    ] = None,
    gui: Annotated[bool, typer.Option("--gui", help="Open it in sumo-gui.")] = False,
) -> None:
    """Replay a scenario in SUMO and check every position and speed against its record.

    A case of a campaign is exported first. Says "identical" (exit code 0) or
    "diverged at t = ..." (exit code 1).

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


@app.verb(
    "compare-runs",
    options=["tolerance", "policies"],
    own={
        "rerun": option(
            bool,
            True,
            "Run the failures, errors and timeouts of each with the other's VUT.",
            "--rerun/--no-rerun",
        )
    },
)
def compare_runs(
    given: Given,
    a: Annotated[
        Path, typer.Argument(help="Folder of the campaign before.", autocompletion=complete.runs)
    ],
    b: Annotated[
        Path, typer.Argument(help="Folder of the campaign after.", autocompletion=complete.runs)
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="New HTML page to write: what changed, in which cases, and both motions.",
        ),
    ] = None,
) -> None:
    """Compare two VUTs, or two versions of one: what got fixed, and what broke.

    The failures, errors and timeouts of each campaign are run again with the other's VUT. Exit
    code 1 when B is worse at some level: when one of these grew by more than the tolerance, the
    share of cases with an error, the share of cases with an error or a timeout, or the failure
    mode coverage (FMC); and whenever B merged in no case of its campaign.

    Example:  merge-sumo compare-runs runs/design1 runs/design2 --out changes.html
    """
    from merge_sumo import api

    tolerance, runs = given.keywords["tolerance"], {"A": api.open_run(a), "B": api.open_run(b)}
    compared = api.compare_runs(runs["A"], runs["B"], out=out, **given.keywords)
    why = compared.worse(tolerance)
    if given.as_json:
        campaigns = {name.lower(): run.verdict.to_record() for name, run in runs.items()}
        print_json({**campaigns, **compared.to_record(), **_judgement(why, tolerance)})
    else:
        _print_comparison(compared, runs)
        alone = sum(level.changes["not run again"] for level in compared.levels.values())
        known = f"; {alone} failure{'s'[: alone > 1]} ran with one of them alone" if alone else ""
        show(f"B is {compared.judgement(tolerance)}{known}")
        for sentence in why:
            show(f"  {sentence}")
        if out is not None:
            show(f"page: {out}")
    raise typer.Exit(1 if why else 0)


def _print_comparison(compared: RunComparison, runs: dict[str, CampaignRun]) -> None:
    for name, run in runs.items():
        show(f"{name}: {run.folder} ({run.run.vut}): {run.verdict.counts}")
        for line in run.verdict.trouble_lines():
            show(line)
    for line in compared.lines():
        show(line)
    first = compared.look_first()
    if first:
        show("look first at:")
    for case in first:
        show(f"  {case.change}: merge-sumo export {quoted(runs[case.run].folder)} {case.index}")


@app.verb()
def history(
    given: Given,
    runs: Annotated[
        list[Path],
        typer.Argument(
            help="Folders of campaigns, the oldest first.", autocompletion=complete.runs
        ),
    ],
    out: Annotated[Path, typer.Option(help="Page to write; nothing may be there.")] = Path(
        "history.html"
    ),
) -> None:
    """Show several versions of a VUT in one page: failures, and what got fixed or broke.

    Everything is read from the records: no case runs again, and no VUT. A region in which the
    earlier version failed counts as fixed when the later one tested cases there and none failed;
    `compare-runs` runs the failures of two versions again and is the better evidence. Campaigns of
    different scenarios, criteria, initial speeds or POVs are refused.

    Example:  merge-sumo history runs/design1 runs/design2 --out runs/history.html
    """
    from merge_sumo import api

    given.print(api.history(runs, out=out), page=out)
