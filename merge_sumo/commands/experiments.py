"""Commands that measure: truth, compare, reproduce."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from merge_sumo.commands import complete
from merge_sumo.commands.shared import (
    CoresOption,
    DaskOption,
    DeadlineOption,
    DenseOption,
    FailWhenOption,
    FollowUpOption,
    InProcessOption,
    JsonOption,
    LevelOption,
    PoliciesOption,
    PovOption,
    QuietOption,
    RequireOption,
    ScenarioOption,
    VutCommandOption,
    VutMemoryOption,
    VutOption,
    app,
    print_result,
    say,
    settings_in,
    show,
)
from merge_sumo.system.folders import dated
from merge_sumo.values.scenario import DEADLINE_S, MEMORY_GIB, US23, level_name


@app.command()
def truth(
    context: typer.Context,
    vut: VutOption,
    level: LevelOption = "all",
    cases: Annotated[
        int | None,
        typer.Option(help="Uniform cases of a level.", show_default="10000, at level 2 20000"),
    ] = None,
    seed: Annotated[int, typer.Option(help="Same seed, same cases.")] = 0,
    scenario: ScenarioOption = "us23",
    policies: PoliciesOption = None,
    pov: PovOption = None,
    fail_when: FailWhenOption = "paper",
    require: RequireOption = None,
    follow_up: FollowUpOption = None,
    vut_command: VutCommandOption = None,
    deadline: DeadlineOption = DEADLINE_S,
    vut_memory: VutMemoryOption = MEMORY_GIB,
    in_process: InProcessOption = False,
    workers: CoresOption = None,
    dask: DaskOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Find the ground truth of a VUT at each level, by uniform cases on all cores.

    It is kept in a cache (MERGE_SUMO_CACHE, or the user's cache folder) under a hash of what it
    depends on, and used again while all files that the VUT has loaded are the same.

    Example:  merge-sumo truth --vut design2 --level 1 --cases 10000
    """
    from merge_sumo import api

    asked = settings_in(context, "workers", "dask")
    print_result(api.truths(**asked, progress=not quiet), as_json=as_json)


@app.command()
def compare(
    context: typer.Context,
    vut: VutOption,
    level: LevelOption = "all",
    samplers: Annotated[
        str | None,
        typer.Option(
            help="Names, separated by commas: {samplers}.",
            show_default="all",
            autocompletion=complete.samplers,
        ),
    ] = None,
    seeds: Annotated[int, typer.Option(help="Runs of each sampler.")] = 10,
    cases: Annotated[int, typer.Option(help="Cases of each run.")] = 400,
    batch: Annotated[
        int | None,
        typer.Option(
            help="Cases per batch.", show_default="what coverage wants, 20 for the others"
        ),
    ] = None,
    truth_cases: Annotated[
        int | None,
        typer.Option(help="Cases of the truth.", show_default="10000, at level 2 20000"),
    ] = None,
    dense: DenseOption = None,
    scenario: ScenarioOption = "us23",
    policies: PoliciesOption = None,
    pov: PovOption = None,
    fail_when: FailWhenOption = "paper",
    require: RequireOption = None,
    follow_up: FollowUpOption = None,
    vut_command: VutCommandOption = None,
    deadline: DeadlineOption = DEADLINE_S,
    vut_memory: VutMemoryOption = MEMORY_GIB,
    figure: Annotated[
        Path | None,
        typer.Option(help="New file for FMC against cases: .png, .svg or .html.", metavar="FILE"),
    ] = None,
    in_process: InProcessOption = False,
    workers: CoresOption = None,
    dask: DaskOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compare samplers with each other and with the ground truth, over several seeds.

    With all levels, each run shares its cases out over them, and coverage is summed over them.
    The truth of the paper's size misses places that searches find, so coverage is also shown as a
    share of a limit: the coverage of 1,000,000 uniform cases, or of all that truth and searches
    found together, whichever is more. Such a dense truth is kept as any truth is, and used where it
    is there; to make it takes minutes, and --dense does.

    Example:  merge-sumo compare --vut design1 --level 0 --samplers uniform,gpr --seeds 3
    """
    from merge_sumo import api
    from merge_sumo.reports import figures

    if figure is not None:
        figures.check_figure(figure)
    asked = settings_in(context, "seeds", "truth_cases", "dense", "workers", "dask")
    found = api.compare(
        **asked, samplers=None if samplers is None else samplers.split(","), progress=not quiet
    )
    if figure is not None:
        title = f"{vut} v level {'/'.join(map(level_name, found.truths))}, {seeds} seeds"
        picture = figures.coverage_curves(
            *(title, found.samplers, found.truth_fmc, found.oracle_fmc, found.limit_fmc)
        )
        figures.save(picture, figure)
    print_result(found, as_json=as_json)
    if figure is not None and not as_json:
        show(f"figure: {figure}")


@app.command()
def reproduce(
    seeds: Annotated[
        int | None,
        typer.Option(help="Runs of each sampler.", show_default="10, with --quick 2"),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="New folder to write.", show_default="runs/reproduce-DATE"),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Few and short runs and a small truth: a first look.")
    ] = False,
    dense: DenseOption = None,
    policies: PoliciesOption = None,
    workers: CoresOption = None,
    dask: DaskOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Reproduce the paper: Table II and every figure of its results, beside the paper's numbers.

    Writes reproduction.md, reproduction.json, the figures as PNG, and index.html that shows it all.

    Example:  merge-sumo reproduce --seeds 10 --out reproduction
    """
    from merge_sumo.campaigns.settings import povs_of
    from merge_sumo.reports import figures
    from merge_sumo.reports.progress import Bars, rate_text
    from merge_sumo.reports.reproduction_page import write_reproduction_page
    from merge_sumo.studies import reproduction
    from merge_sumo.system.workers import open_workers

    if seeds is None:
        seeds = 2 if quick else 10
    scale = reproduction.quick(seeds) if quick else reproduction.Scale(seeds=seeds)
    if dense is not None:
        scale = replace(scale, dense=dense)
    povs = povs_of(policies, US23)
    folder = out or dated("reproduce")
    figures.require_matplotlib()
    with open_workers(workers, dask) as there, Bars(shown=not quiet) as bars:

        def ran(title: str, done: int, total: int, unit: str) -> None:
            bars.show(title, done, total, rate_text(done, bars.elapsed_s(title), unit))

        reproduction.reproduce(folder, scale, povs=povs, workers=there, on_run=ran)
    index = write_reproduction_page(folder)
    if as_json:
        typer.echo((folder / reproduction.TABLE_JSON).read_text(encoding="utf-8").strip())
        say(f"all of it: {index}")
        return
    typer.echo((folder / reproduction.TABLE_MARKDOWN).read_text(encoding="utf-8"), nl=False)
    show(f"all of it: {index}")
