"""Commands on the folder of a campaign: export, replay, report, compare-runs."""

from __future__ import annotations

import json
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from merge_sumo.commands import complete
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
from merge_sumo.system.printable import quoted

if TYPE_CHECKING:
    from merge_sumo.studies.versions import RunComparison


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
        Path | None,
        typer.Option(
            help="Folder to write into.", show_default="RUN/scenarios for sumo, else RUN/exports"
        ),
    ] = None,
    net: NetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write cases of a campaign for SUMO, for other simulators, or as a table.

    Example:  merge-sumo export runs/design2 17 42
    """
    from merge_sumo import api

    paths = api.export(run, case or None, file_format=file_format.value, out=out, net=net)
    if as_json:
        typer.echo(json.dumps({"written": list(map(str, paths))}))
        return
    for path in paths:
        show(path)


@app.command()
def replay(
    folder: Annotated[
        Path,
        typer.Argument(help="A scenario folder, or a campaign's.", autocompletion=complete.runs),
    ],
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
    from merge_sumo import api

    if gui:
        raise typer.Exit(api.open_in_gui(folder, case, net=net))
    result = api.replay(folder, case, net=net)
    identical = result.diverged_at_s is None
    if as_json:
        typer.echo(json.dumps({"identical": identical, **asdict(result)}))
    elif identical:
        show(f"identical: {result.rows} rows of x, y, position and speed")
    else:
        show(f"diverged at t = {result.diverged_at_s:.1f} s: {result.detail}")
    raise typer.Exit(0 if identical else 1)


@app.command()
def report(run: RunArgument, as_json: JsonOption = False) -> None:
    """Write the report of a campaign again and print its path.

    Example:  merge-sumo report runs/design2
    """
    from merge_sumo import api

    path = api.report(run)
    show(json.dumps({"report": str(path)}) if as_json else path)


@app.command("compare-runs")
def compare_runs(
    a: Annotated[
        Path,
        typer.Argument(help="Folder of the campaign before.", autocompletion=complete.runs),
    ],
    b: Annotated[
        Path, typer.Argument(help="Folder of the campaign after.", autocompletion=complete.runs)
    ],
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
    from merge_sumo import api
    from merge_sumo.analysis.verdict import counted

    check_tolerance(tolerance)
    runs = {"A": api.open_run(a), "B": api.open_run(b)}
    compared = api.compare_runs(
        *runs.values(),
        rerun=rerun,
        net=net,
        policies=policies,
        trust_vut=trust_vut,
        out=out,
        tolerance=tolerance,
    )
    why = compared.worse(tolerance)
    if as_json:
        own = {
            name.lower(): one.verdict.to_record() | {"careful": one.careful}
            for name, one in runs.items()
        }
        judged = {"tolerance": tolerance, "worse": bool(why), "why": why}
        typer.echo(json.dumps({**own, **asdict(compared), **judged}))
    else:
        for name, one in runs.items():
            show(f"{name}: {one.folder} ({one.run.vut}): {one.verdict.counts}")
            if one.careful is not None:
                show(f"  {one.careful}")
            print_troubles(one.verdict)
        _print_comparison(compared, {"A": a, "B": b})
        worse = "worse" if why else "not worse"
        alone = sum(level.changes["not run again"] for level in compared.levels.values())
        known = f"; {counted(alone, 'failure')} ran with one of them alone" if alone else ""
        show(f"B is {worse} than A, with a tolerance of {tolerance:g}{known}")
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
