"""Commands that measure: truth, compare, reproduce."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from merge_sumo.commands.shared import (
    DaskOption,
    DeadlineOption,
    DenseOption,
    FailWhenOption,
    FollowUpOption,
    InProcessOption,
    JsonOption,
    PoliciesOption,
    PovOption,
    RequireOption,
    ScenarioOption,
    VutCommandOption,
    VutMemoryOption,
    app,
    followed_up,
    say,
    show,
)
from merge_sumo.errors import UserError
from merge_sumo.system.folders import dated
from merge_sumo.values.scenario import DEADLINE_S, MEMORY_GIB, US23, level_name

if TYPE_CHECKING:
    from merge_sumo.campaigns.ground import GroundPlan
    from merge_sumo.campaigns.truth import Truth
    from merge_sumo.drivers.povs import Povs
    from merge_sumo.drivers.vuts.base import VutOptions
    from merge_sumo.system.workers import Workers
    from merge_sumo.values.criterion import Criterion
    from merge_sumo.values.scenario import Scenario


@app.command()
def truth(
    vut: Annotated[str, typer.Option(help="Vehicle under test.")],
    level: Annotated[str, typer.Option(help="POV level: 0, 1, 2 or own.")],
    cases: Annotated[
        int | None, typer.Option(help="Uniform cases.  [default: 10000, at level 2 20000]")
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
    workers: Annotated[int | None, typer.Option(help="Processes.  [default: one a core]")] = None,
    dask: DaskOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find the ground truth of a VUT at a level, by uniform cases on all cores.

    It is kept in a cache (MERGE_SUMO_CACHE, or the user's cache folder) under a hash of what it
    depends on, and used again while all files that the VUT has loaded are the same.

    Example:  merge-sumo truth --vut design2 --level 1 --cases 10000
    """
    from merge_sumo.campaigns.settings import one_level, povs_of
    from merge_sumo.campaigns.truth import REAL_REGION
    from merge_sumo.drivers.vuts.base import VutOptions
    from merge_sumo.scenarios.scenario_file import named_scenario
    from merge_sumo.system.workers import open_workers
    from merge_sumo.values.criterion import Criterion
    from merge_sumo.values.fmc import fmc, regions

    where = followed_up(named_scenario(scenario), follow_up)
    options = VutOptions(deadline_s=deadline, memory_gib=vut_memory, in_process=in_process)
    criterion = Criterion(fail_when, require)
    povs = povs_of(policies, where, pov, options)
    chosen = one_level(level, povs)
    plan = _plan(vut, vut_command, options, povs, where, criterion)
    with open_workers(povs.workers(plan.vut, workers), dask) as there:
        found = _truth(plan, chosen, cases, seed, there)
    if plan.vut.vut.named_only:
        say(
            "note: nobody can tell what the program behind this VUT loads; this truth is kept for "
            "its command and the files that are named there"
        )
    labels = regions(found.failures).tolist()
    sizes = [labels.count(label) for label in range(max(labels, default=-1) + 1)]
    result = {
        "vut": vut,
        "level": chosen,
        "cases": len(found.score),
        "failures": len(found.failures),
        "fmc": fmc(found.failures),
        "region_sizes": sizes,
        "real_regions": len(found.real_regions()),
        "fail_when": criterion.text,
    }
    if as_json:
        typer.echo(json.dumps(result))
        return
    show(
        f"{vut} at level {level_name(chosen)}: {result['failures']} failures in "
        f"{result['cases']} cases, FMC {result['fmc']:.4f}, {result['real_regions']} regions with "
        f"at least {REAL_REGION:.0%} of the failures"
    )
    if not criterion.is_papers:
        show(f"  a case fails when {criterion.words}")


@app.command()
def compare(
    vut: Annotated[str, typer.Option(help="Vehicle under test.")],
    level: Annotated[str, typer.Option(help="POV level: 0, 1, 2, own or all.")],
    samplers: Annotated[
        str, typer.Option(help="Names, separated by commas.")
    ] = "uniform,annealing,subset,gpr,coverage",
    seeds: Annotated[int, typer.Option(help="Runs of each sampler.")] = 10,
    cases: Annotated[int, typer.Option(help="Cases of each run.")] = 400,
    batch: Annotated[
        int | None,
        typer.Option(help="Cases per batch.  [default: what coverage wants, 20 for the others]"),
    ] = None,
    truth_cases: Annotated[
        int | None, typer.Option(help="Cases of the truth.  [default: 10000, at level 2 20000]")
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
    workers: Annotated[int | None, typer.Option(help="Processes.  [default: one a core]")] = None,
    dask: DaskOption = None,
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
    from merge_sumo.campaigns import experiments
    from merge_sumo.campaigns.settings import CampaignSettings, parse_levels, povs_of
    from merge_sumo.campaigns.truth import DENSE_CASES, known_truth
    from merge_sumo.commands.comparisons import limit_of, print_comparisons, truths_of
    from merge_sumo.drivers.vuts.base import VutOptions
    from merge_sumo.reports import figures
    from merge_sumo.reports.progress import Counter
    from merge_sumo.scenarios.scenario_file import named_scenario
    from merge_sumo.system.workers import open_workers
    from merge_sumo.values.criterion import Criterion
    from merge_sumo.values.fmc import fmc

    where = followed_up(named_scenario(scenario), follow_up)
    options = VutOptions(deadline_s=deadline, memory_gib=vut_memory, in_process=in_process)
    povs = povs_of(policies, where, pov, options)
    levels, criterion = parse_levels(level, povs), Criterion(fail_when, require)
    names = list(dict.fromkeys(name.strip() for name in samplers.split(",")))
    plan = _plan(vut, vut_command, options, povs, where, criterion)
    for name in names:
        CampaignSettings(
            vut=vut,
            vut_command=vut_command,
            levels=levels,
            sampler=name,
            cases=cases,
            batch=batch,
            policies=None if policies is None else str(policies),
            pov=pov,
            scenario=where,
            fail_when=fail_when,
            require=require,
        )
    if seeds < 1:
        raise UserError(f"--seeds is {seeds}: it must be 1 or more")
    if figure is not None:
        figures.check_figure(figure)
    title = f"{vut} v level {'/'.join(map(level_name, levels))}"
    with (
        open_workers(povs.workers(plan.vut, workers), dask) as there,
        Counter(title, len(names) * seeds, "runs") as counter,
    ):
        truths = {level: _truth(plan, level, truth_cases, 0, there) for level in levels}
        made = partial(_truth, plan, cases=DENSE_CASES, seed=0, workers=there)
        known = partial(known_truth, plan, cases=DENSE_CASES)
        dense_truths = truths_of(levels, made if dense else known if dense is None else None)
        searches = experiments.search(
            plan,
            levels,
            names,
            seeds=seeds,
            cases=cases,
            batch=batch,
            workers=there,
            on_search=lambda name, _: counter.ended(1, name),
        )
    limit = experiments.limit_fmc(chain.from_iterable(searches.values()), truths, dense_truths)
    compared = {name: experiments.compare(found, truths, limit) for name, found in searches.items()}
    truth_fmc = sum(fmc(found.failures) for found in truths.values())
    of_oracle = experiments.oracle(truths, cases, batch)
    if figure is not None:
        picture = figures.coverage_curves(
            f"{title}, {seeds} seeds", compared, truth_fmc, of_oracle, limit
        )
        figures.save(picture, figure)
    if as_json:
        by_name = {name: asdict(result) for name, result in compared.items()}
        oracle_by_batch = [of_oracle[n] for n in compared[names[0]].cases_by_batch]
        result = {
            "truth_fmc": truth_fmc,
            "limit_fmc": limit,
            "dense_levels": list(dense_truths),
            "oracle_fmc_by_batch": oracle_by_batch,
            **by_name,
        }
        typer.echo(json.dumps(result, allow_nan=False))
        return
    failures = sum(len(found.failures) for found in truths.values())
    real = sum(len(found.real_regions()) for found in truths.values())
    show(f"truth: FMC {truth_fmc:.4f}, {failures} failures, {real} regions")
    show(f"limit: FMC {limit:.4f}, {limit_of(dense_truths, levels)}")
    show(f"oracle: FMC {of_oracle[cases]:.4f} with {cases} cases")
    print_comparisons(compared)
    if figure is not None:
        show(f"figure: {figure}")


@app.command()
def reproduce(
    seeds: Annotated[
        int | None, typer.Option(help="Runs of each sampler.  [default: 10; with --quick 2]")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="New folder to write.  [default: runs/reproduce-DATE]")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Few and short runs and a small truth: a first look.")
    ] = False,
    dense: DenseOption = None,
    policies: PoliciesOption = None,
    workers: Annotated[int | None, typer.Option(help="Processes.  [default: one a core]")] = None,
    dask: DaskOption = None,
    as_json: JsonOption = False,
) -> None:
    """Reproduce the paper: Table II and every figure of its results, beside the paper's numbers.

    Writes table2.md, table2.json, the figures as PNG, and index.html that shows it all.

    Example:  merge-sumo reproduce --seeds 10 --out reproduction
    """
    from merge_sumo.campaigns.settings import povs_of
    from merge_sumo.reports import reproduce as paper
    from merge_sumo.reports import table2
    from merge_sumo.reports.progress import Bars, rate_text
    from merge_sumo.system.workers import open_workers

    if seeds is None:
        seeds = 2 if quick else 10
    scale = table2.quick(seeds) if quick else table2.Scale(seeds=seeds)
    if dense is not None:
        scale = replace(scale, dense=dense)
    povs = povs_of(policies, US23)
    folder = out or dated("reproduce")
    with open_workers(workers, dask) as there, Bars() as bars:

        def ran(title: str, done: int, total: int, unit: str) -> None:
            bars.show(title, done, total, rate_text(done, bars.elapsed_s(title), unit))

        index = paper.reproduce(folder, scale, povs=povs, workers=there, on_run=ran)
    if as_json:
        typer.echo((folder / paper.TABLE_JSON).read_text(encoding="utf-8").strip())
        say(f"all of it: {index}")
        return
    typer.echo((folder / paper.TABLE_MARKDOWN).read_text(encoding="utf-8"), nl=False)
    show(f"all of it: {index}")


def _plan(
    vut: str,
    command: str | None,
    options: VutOptions,
    povs: Povs,
    scenario: Scenario,
    criterion: Criterion,
) -> GroundPlan:
    from merge_sumo.campaigns.plan import resolve
    from merge_sumo.drivers.vut import vut_factory

    factory = vut_factory(vut, replace(options, command=command, policies=povs.policies))
    return resolve(factory, scenario=scenario, criterion=criterion, povs=povs)


def _truth(plan: GroundPlan, level: int, cases: int | None, seed: int, workers: Workers) -> Truth:
    from merge_sumo.campaigns.truth import TRUTH_CASES, ground_truth
    from merge_sumo.reports.progress import Counter

    total = TRUTH_CASES[level] if cases is None else cases
    if total < 1:
        raise UserError(f"--cases is {total}: it must be 1 or more")
    title = f"truth of {plan.vut.spec} at level {level_name(level)}"
    with Counter(title, total, "cases") as counter:
        return ground_truth(plan, level, total, seed, workers=workers, on_cases=counter.ended)
