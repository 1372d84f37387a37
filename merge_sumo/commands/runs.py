"""Commands on the folder of a campaign: export, replay, report, compare-runs."""

from __future__ import annotations

import json
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from merge_sumo.commands.shared import (
    JsonOption,
    NetOption,
    PoliciesOption,
    RunArgument,
    ToleranceOption,
    TrustOption,
    app,
    check_tolerance,
    print_troubles,
    show,
)
from merge_sumo.errors import UserError
from merge_sumo.system.folders import check_new_file, check_own
from merge_sumo.system.printable import quoted

if TYPE_CHECKING:
    from merge_sumo.reports.changes import RunComparison
    from merge_sumo.values.trajectory import Trajectory

EXPORTS: Final = "exports"


class Format(StrEnum):
    """What `export` writes."""

    SUMO = "sumo"
    OPENSCENARIO = "openscenario"
    CSV = "csv"
    PARQUET = "parquet"


@app.command()
def export(
    run: RunArgument,
    case: Annotated[
        list[int] | None,
        typer.Argument(help="Indices of cases in outcomes.jsonl; csv, parquet: all if left out."),
    ] = None,
    file_format: Annotated[
        Format,
        typer.Option(
            "--format",
            help="sumo: folders that sumo-gui replays. openscenario: folders with OpenSCENARIO "
            "and OpenDRIVE. csv, parquet: one table of motion.",
        ),
    ] = Format.SUMO,
    out: Annotated[
        Path | None, typer.Option(help="Folder.  [default: RUN/scenarios, else RUN/exports]")
    ] = None,
    net: NetOption = None,
) -> None:
    """Write cases of a campaign for SUMO, for other simulators, or as a table.

    Example:  merge-sumo export runs/design2 17 42
    """
    from merge_sumo.campaigns.conductor import SCENARIOS
    from merge_sumo.campaigns.ground import road_for
    from merge_sumo.campaigns.run import Run
    from merge_sumo.reports import exports

    loaded = Run(run)
    if out is None:
        check_own(run / SCENARIOS, run / EXPORTS)
    if file_format in (Format.CSV, Format.PARQUET):
        indices = case or [outcome.index for outcome in loaded.outcomes]
        show(exports.write_table(loaded, indices, out or run / EXPORTS, file_format.value))
        return
    if not case:
        raise UserError(f"--format {file_format} needs the indices of cases")
    to_sumo = file_format is Format.SUMO
    target = out or run / (SCENARIOS if to_sumo else EXPORTS)
    write = exports.write_sumo if to_sumo else exports.write_openscenario
    for path in exports.write_folders(loaded, case, target, write, road_for(loaded.scenario, net)):
        show(path)


@app.command()
def replay(
    folder: Annotated[Path, typer.Argument(help="A scenario folder, or a campaign's.")],
    case: Annotated[
        int | None, typer.Argument(help="Index of the campaign's case in outcomes.jsonl.")
    ] = None,
    gui: Annotated[bool, typer.Option("--gui", help="Open it in sumo-gui.")] = False,
    net: NetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Replay a scenario in SUMO and check every position and speed against its record.

    A case of a campaign is exported first, where it is not yet. Says "identical" (exit code 0) or
    "diverged at t = ..." (exit code 1).

    Example:  merge-sumo replay scenarios/stalemate --gui
    """
    from merge_sumo.campaigns.run import SETTINGS
    from merge_sumo.sumo import replay as replayer

    if (folder / SETTINGS).is_file():
        folder = _exported(folder, case, net)
    elif case is not None:
        raise UserError(f"{folder} is no campaign, so it has no case {case}: leave that away")
    if gui:
        raise typer.Exit(replayer.open_gui(folder))
    result = replayer.replay(folder)
    identical = result.diverged_at_s is None
    if as_json:
        typer.echo(json.dumps({"identical": identical, **asdict(result)}))
    elif identical:
        show(f"identical: {result.rows} rows of x, y, position and speed")
    else:
        show(f"diverged at t = {result.diverged_at_s:.1f} s: {result.detail}")
    raise typer.Exit(0 if identical else 1)


def _exported(run: Path, case: int | None, net: Path | None) -> Path:
    """Return the folder of a campaign's case, which is written where it is not there yet."""
    from merge_sumo.campaigns.conductor import SCENARIOS, case_name
    from merge_sumo.campaigns.ground import road_for
    from merge_sumo.campaigns.run import Run
    from merge_sumo.reports import exports

    if case is None:
        raise UserError(
            f"{run} is a campaign: say which case, as in `merge-sumo replay {quoted(run)} 3`"
        )
    folder = run / SCENARIOS / case_name(case)
    if not folder.is_dir():
        check_own(run / SCENARIOS)
        loaded = Run(run)
        road = road_for(loaded.scenario, net)
        list(exports.write_folders(loaded, [case], run / SCENARIOS, exports.write_sumo, road))
    return folder


@app.command()
def report(run: RunArgument) -> None:
    """Write the report of a campaign again and print its path.

    Example:  merge-sumo report runs/design2
    """
    from merge_sumo.campaigns.run import Run
    from merge_sumo.reports.report import write_report

    show(write_report(Run(run)))


@app.command("compare-runs")
def compare_runs(
    a: Annotated[Path, typer.Argument(help="Folder of the campaign before.")],
    b: Annotated[Path, typer.Argument(help="Folder of the campaign after.")],
    tolerance: ToleranceOption = 0.0,
    rerun: Annotated[
        bool,
        typer.Option(
            "--rerun/--no-rerun",
            help="Run the failures, errors and timeouts of each with the other's VUT.",
        ),
    ] = True,
    net: NetOption = None,
    policies: PoliciesOption = None,
    trust_vut: TrustOption = False,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="New HTML page to write: what changed, in which cases, and both motions.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare two VUTs, or two versions of one: what got fixed, and what broke.

    The failures, errors and timeouts of each campaign are run again with the other's VUT. Exit
    code 1 when B is worse at some level: when one of these grew by more than the tolerance, the
    share of cases with an error, the share of cases with an error or a timeout, or the failure
    mode coverage (FMC); and whenever B reached the merge point in no case of its campaign.

    Example:  merge-sumo compare-runs runs/design1 runs/design2 --out changes.html
    """
    from merge_sumo.campaigns.avoidance import in_a_sentence, read_avoidance
    from merge_sumo.campaigns.ground import road_for
    from merge_sumo.campaigns.run import Run
    from merge_sumo.reports import comparison
    from merge_sumo.reports.comparison_page import write_comparison
    from merge_sumo.reports.verdict import judge

    check_tolerance(tolerance)
    if out is not None:
        check_new_file(out)
    runs = Run(a), Run(b)
    road = road_for(runs[0].scenario, net) if rerun else None
    given = {} if policies is None else {"policies": str(policies)}
    motions: dict[tuple[str, int], Trajectory] = {}

    def keep(of: str, index: int, trajectory: Trajectory) -> None:
        motions[of, index] = trajectory

    compared = comparison.compare_runs(
        *runs, rerun=rerun, net=road, given=given, trust=trust_vut, on_again=keep
    )
    if out is not None:
        write_comparison(compared, *runs, motions, tolerance, out)
    why = compared.worse(tolerance)
    careful = {
        name: in_a_sentence(read_avoidance(loaded).values())
        for name, loaded in zip("AB", runs, strict=True)
    }
    verdicts = {name: judge(loaded.outcomes) for name, loaded in zip("AB", runs, strict=True)}
    if as_json:
        own = {
            name.lower(): verdict.to_record() | {"careful": careful[name]}
            for name, verdict in verdicts.items()
        }
        judged = {"tolerance": tolerance, "worse": bool(why), "why": why}
        typer.echo(json.dumps({**own, **asdict(compared), **judged}))
    else:
        for (name, verdict), loaded in zip(verdicts.items(), runs, strict=True):
            show(f"{name}: {loaded.folder} ({loaded.vut}): {verdict.counts}")
            if (said := careful[name]) is not None:
                show(f"  {said}")
            print_troubles(verdict)
        _print_comparison(compared, {"A": a, "B": b})
        worse = "worse" if why else "not worse"
        show(f"B is {worse} than A, with a tolerance of {tolerance:g}")
        for sentence in why:
            show(f"  {sentence}")
        if out is not None:
            show(f"page: {out}")
    raise typer.Exit(1 if why else 0)


def _print_comparison(compared: RunComparison, folders: dict[str, Path]) -> None:
    for line in compared.lines():
        show(line)
    first = compared.look_first()
    if first:
        show("look first at:")
    for case in first:
        show(f"  {case.change}: merge-sumo export {quoted(folders[case.run])} {case.index}")
