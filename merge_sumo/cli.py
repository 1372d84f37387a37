"""The command line: parse, call one function, print. Heavy modules are imported in the commands."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from merge_sumo.errors import UserError

if TYPE_CHECKING:
    from merge_sumo.experiments import Truth
    from merge_sumo.journal import Run
    from merge_sumo.summary import Summary

app = typer.Typer(
    help="""Find where a merging controller fails against drivers who react to it.

    A vehicle under test (VUT) merges from an on-ramp of US-23 in SUMO while a primary other
    vehicle (POV) on the mainline interacts with it. A sampler chooses the test cases; failures
    are collisions at the merge point, and failure mode coverage (FMC) says how much of the
    failing region was found.

    Start with:  merge-sumo campaign --vut design2
    """,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

NetOption = Annotated[
    Path | None, typer.Option(help="SUMO net to use instead of the shipped US-23 ramp.")
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print the result as one JSON object on standard output.")
]
RunArgument = Annotated[Path, typer.Argument(help="Folder of a campaign.")]


def say(text: str) -> None:
    """Print a line for a person, on standard error: standard output is for results."""
    typer.echo(text, err=True)


@app.callback(invoke_without_command=True)
def _version(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        from importlib.metadata import version as version_of

        typer.echo(f"merge-sumo {version_of('merge-sumo')}")
        raise typer.Exit


@app.command()
def campaign(
    vut: Annotated[
        str, typer.Option(help="Vehicle under test: level0, level1, level2, design1 or design2.")
    ],
    level: Annotated[str, typer.Option(help="POV level: 0, 1, 2 or all.")] = "all",
    sampler: Annotated[
        str, typer.Option(help="Who chooses: uniform, annealing, subset, gpr or coverage.")
    ] = "gpr",
    cases: Annotated[int, typer.Option(help="Number of test cases.")] = 800,
    batch: Annotated[
        int | None, typer.Option(help="Cases per batch.  [default: 40, or all if fewer]")
    ] = None,
    seed: Annotated[int, typer.Option(help="Same seed, same outcomes.")] = 0,
    v_vut0: Annotated[float, typer.Option(help="Initial speed of the VUT in m/s.")] = 18.0,
    out: Annotated[
        Path | None, typer.Option(help="New folder to write.  [default: runs/VUT-DATE]")
    ] = None,
    net: NetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Test a VUT: run cases in SUMO, find failures, write a report and replayable scenarios.

    Example:  merge-sumo campaign --vut design1 --level 0 --cases 400 --batch 20 --seed 1
    """
    from merge_sumo import campaign as conductor
    from merge_sumo.progress import CaseProgress
    from merge_sumo.report import write_report
    from merge_sumo.summary import summarise
    from merge_sumo.sumo.net import Net

    levels = conductor.parse_levels(level)
    settings = conductor.CampaignSettings(
        vut=vut,
        levels=levels,
        sampler=sampler,
        cases=cases,
        batch=min(conductor.DEFAULT_BATCH, max(cases, 1)) if batch is None else batch,
        seed=seed,
        v_vut0_mps=v_vut0,
    )
    folder = out or Path("runs") / f"{vut}-{datetime.now().astimezone():%Y%m%d-%H%M%S}"
    with CaseProgress(f"{vut} v level {'/'.join(map(str, levels))}", cases) as progress:
        run = conductor.run_campaign(settings, folder, Net(net), progress.case_ended)
    if level == "all" and len(levels) < 3:
        named = ", ".join(map(str, levels))
        say(f"--level all: policies are there for level {named}; `merge-sumo train` makes others")
    report_file = write_report(run)
    summary = summarise(run.outcomes, levels)
    if as_json:
        result = {**asdict(summary), "run": str(folder), "report": str(report_file)}
        typer.echo(json.dumps(result))
    else:
        _print_summary(run, summary, report_file)


@app.command()
def export(
    run: RunArgument,
    case: Annotated[list[int], typer.Argument(help="Indices of cases in outcomes.jsonl.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder for the case folders.  [default: RUN/scenarios]")
    ] = None,
    net: NetOption = None,
) -> None:
    """Write cases of a campaign as folders that sumo and sumo-gui replay with nothing else running.

    Example:  merge-sumo export runs/design2 17 42
    """
    from merge_sumo.campaign import SCENARIOS, case_name, export_case
    from merge_sumo.journal import Run
    from merge_sumo.sumo.net import Net

    loaded = Run(run)
    target = out or run / SCENARIOS
    folders = {index: target / case_name(index) for index in case}
    for index, folder in folders.items():
        loaded.outcome(index)
        if folder.exists():
            raise UserError(f"{folder} exists: choose another folder with --out")
    for index, folder in folders.items():
        typer.echo(export_case(loaded, index, folder, Net(net)))


@app.command()
def replay(
    folder: Annotated[Path, typer.Argument(help="A scenario folder.")],
    gui: Annotated[bool, typer.Option("--gui", help="Open it in sumo-gui.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Replay a scenario in SUMO and check every position and speed against its record.

    Says "identical" (exit code 0) or "diverged at t = ..." (exit code 1).

    Example:  merge-sumo replay scenarios/stalemate --gui
    """
    from merge_sumo.sumo import replay as replayer

    if gui:
        raise typer.Exit(replayer.open_gui(folder))
    result = replayer.replay(folder)
    identical = result.diverged_at_s is None
    if as_json:
        typer.echo(json.dumps({"identical": identical, **asdict(result)}))
    elif identical:
        typer.echo(f"identical: {result.rows} rows of x, y, position and speed")
    else:
        typer.echo(f"diverged at t = {result.diverged_at_s:.1f} s: {result.detail}")
    raise typer.Exit(0 if identical else 1)


@app.command()
def report(run: RunArgument) -> None:
    """Write the report of a campaign again and print its path.

    Example:  merge-sumo report runs/design2
    """
    from merge_sumo.journal import Run
    from merge_sumo.report import write_report

    typer.echo(write_report(Run(run)))


@app.command()
def truth(
    vut: Annotated[str, typer.Option(help="Vehicle under test.")],
    level: Annotated[str, typer.Option(help="POV level: 0, 1 or 2.")],
    cases: Annotated[
        int | None, typer.Option(help="Uniform cases.  [default: 10000, at level 2 20000]")
    ] = None,
    seed: Annotated[int, typer.Option(help="Same seed, same cases.")] = 0,
    workers: Annotated[int | None, typer.Option(help="Processes.  [default: one a core]")] = None,
    as_json: JsonOption = False,
) -> None:
    """Find the ground truth of a VUT at a level, by uniform cases on all cores.

    It is kept in a cache (MERGE_SUMO_CACHE, or the user's cache folder) under a hash of everything
    that it depends on.

    Example:  merge-sumo truth --vut design2 --level 1 --cases 10000
    """
    from merge_sumo import experiments
    from merge_sumo.campaign import one_level
    from merge_sumo.fmc import fmc, regions

    chosen = one_level(level)
    found = _truth(vut, chosen, cases, seed, workers)
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
    }
    if as_json:
        typer.echo(json.dumps(result))
        return
    typer.echo(
        f"{vut} at level {chosen}: {result['failures']} failures in {result['cases']} cases, "
        f"FMC {result['fmc']:.4f}, {result['real_regions']} regions with at least "
        f"{experiments.REAL_REGION:.0%} of the failures"
    )


@app.command()
def compare(
    vut: Annotated[str, typer.Option(help="Vehicle under test.")],
    level: Annotated[str, typer.Option(help="POV level: 0, 1 or 2.")],
    samplers: Annotated[
        str, typer.Option(help="Names, separated by commas.")
    ] = "uniform,annealing,subset,gpr,coverage",
    seeds: Annotated[int, typer.Option(help="Runs of each sampler.")] = 10,
    cases: Annotated[int, typer.Option(help="Cases of each run.")] = 400,
    batch: Annotated[int, typer.Option(help="Cases per batch.")] = 20,
    truth_cases: Annotated[
        int | None, typer.Option(help="Cases of the truth.  [default: 10000, at level 2 20000]")
    ] = None,
    workers: Annotated[int | None, typer.Option(help="Processes.  [default: one a core]")] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare samplers with each other and with the ground truth, over several seeds.

    Example:  merge-sumo compare --vut design1 --level 0 --samplers uniform,gpr --seeds 3
    """
    from merge_sumo import experiments
    from merge_sumo.campaign import CampaignSettings, one_level
    from merge_sumo.fmc import fmc
    from merge_sumo.progress import Counter

    chosen = one_level(level)
    names = [name.strip() for name in samplers.split(",")]
    for name in names:
        CampaignSettings(vut=vut, levels=(chosen,), sampler=name, cases=cases, batch=batch)
    if seeds < 1:
        raise UserError(f"--seeds is {seeds}: it must be 1 or more")
    found = _truth(vut, chosen, truth_cases, 0, workers)
    with Counter(f"{vut} v level {chosen}", len(names) * seeds, "runs") as counter:
        compared = experiments.compare(
            vut,
            chosen,
            names,
            seeds=seeds,
            cases=cases,
            batch=batch,
            truth=found,
            workers=workers,
            on_search=lambda name, _: counter.ended(1, name),
        )
    truth_fmc = fmc(found.failures)
    if as_json:
        by_name = {name: asdict(result) for name, result in compared.items()}
        typer.echo(json.dumps({"truth_fmc": truth_fmc, **by_name}))
        return
    real = len(found.real_regions())
    typer.echo(f"truth: FMC {truth_fmc:.4f}, {len(found.failures)} failures, {real} regions")
    typer.echo(
        f"{'sampler':<10} {'FMC / truth':>22} {'FMC':>7} {'failures':>9} {'regions':>8} "
        f"{'to 50 %':>8} {'to 90 %':>8} {'sampler s':>10}"
    )
    for name, result in compared.items():
        low, high = result.fmc_over_truth_quartiles
        share = f"{result.fmc_over_truth_median:.3f} [{low:.3f}, {high:.3f}]"
        half, most = result.cases_to_50_percent_median, result.cases_to_90_percent_median
        typer.echo(
            f"{name:<10} {share:>22} {result.fmc_median:7.4f} {result.failures_median:9.0f} "
            f"{result.regions_found_median:8.1f} {half or '-':>8} {most or '-':>8} "
            f"{result.sampler_s_median:10.2f}"
        )


def _truth(vut: str, level: int, cases: int | None, seed: int, workers: int | None) -> Truth:
    from merge_sumo import experiments
    from merge_sumo.drivers.vut import vut_factory
    from merge_sumo.progress import Counter

    vut_factory(vut)
    total = experiments.TRUTH_CASES[level] if cases is None else cases
    if total < 1:
        raise UserError(f"--cases is {total}: it must be 1 or more")
    with Counter(f"truth of {vut} at level {level}", total, "cases") as counter:
        return experiments.ground_truth(
            vut, level, total, seed, workers=workers, on_cases=counter.ended
        )


@app.command()
def train(
    only: Annotated[
        list[str] | None, typer.Option(help="Network to train: pov1, vut1, pov2 or vut2.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Same seed, same weights.")] = 0,
    out: Annotated[
        Path | None, typer.Option(help="Folder.  [default: the policies in use]")
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Train nothing: measure regret of what is there.")
    ] = False,
    cases: Annotated[int, typer.Option(help="Random cases of a check.")] = 300,
    as_json: JsonOption = False,
) -> None:
    """Train the learned drivers in SUMO, level by level, and measure their regret.

    The regret is what a driver loses to its best response, as a share of what that gains over
    level-0 behaviour. An interrupted training goes on with the first network that is not finished.

    Example:  merge-sumo train --out my-policies --seed 1
    """
    from merge_sumo.drivers.policies import NETWORKS, read_manifest
    from merge_sumo.resources import resource

    folder = out or resource("policies")
    unknown = set(only or ()) - set(NETWORKS)
    if unknown:
        raise UserError(f"there is no network {unknown.pop()!r}: choose {', '.join(NETWORKS)}")
    names = tuple(name for name in NETWORKS if name in (only or NETWORKS))
    _need_training_packages()
    if not check:
        _train(folder, names, seed)
    manifest = read_manifest(folder)
    missing = [name for name in names if name not in manifest]
    if missing:
        raise UserError(f"{folder} has no {missing[0]}: run `merge-sumo train` to make it")
    if check:
        from merge_sumo.training.check import check_policy

        checks = {name: asdict(check_policy(name, folder, count=cases)) for name in names}
    else:
        checks = {name: manifest[name]["check"] for name in names}
    if as_json:
        typer.echo(json.dumps(checks))
        return
    typer.echo(
        "network  mean regret  p99 regret  collisions  avoidable  mean return  best  level 0"
    )
    for name, found in checks.items():
        typer.echo(
            f"{name:<7}  {found['mean_regret']:11.2%}  {found['p99_regret']:10.2%}  "
            f"{found['collisions']:10d}  {found['avoidable_collisions']:9d}  "
            f"{found['mean_return']:11.3f}  {found['mean_best']:.3f}  {found['mean_level0']:.3f}"
        )


def _need_training_packages() -> None:
    from importlib.util import find_spec

    for package in ("torch", "gymnasium"):
        if find_spec(package) is None:
            raise UserError(
                f"training needs {package}, which is not installed: run "
                "`pip install 'merge-sumo[train]'`"
            )


def _train(folder: Path, names: tuple[str, ...], seed: int) -> None:
    from merge_sumo.progress import TrainingBars
    from merge_sumo.training.helix import train_library

    with TrainingBars() as bars:
        train_library(folder, names, seed, on_progress=bars.progressed, on_done=bars.done)


def _print_summary(run: Run, summary: Summary, report_file: Path) -> None:
    from merge_sumo.campaign import SCENARIOS, case_name
    from merge_sumo.journal import failures

    typer.echo(f"{summary.failures} failures in {summary.cases} cases")
    for level, found in summary.levels.items():
        typer.echo(
            f"  level {level}: {found.failures} failures in {found.cases} cases, "
            f"FMC {found.fmc:.4f}, {found.regions} regions"
        )
    others = {end: n for end, n in summary.ends.items() if end not in ("MERGED", "COLLISION")}
    if others:
        typer.echo("  " + ", ".join(f"{n} {end}" for end, n in others.items()))
    typer.echo(f"report: {report_file}")
    worst = failures(run.outcomes)
    if worst:
        folder = run.folder / SCENARIOS / case_name(worst[0].index)
        typer.echo(f"worst case: merge-sumo replay {folder} --gui")


def main() -> None:
    """Run the command line; a `UserError` becomes one sentence and exit code 2."""
    try:
        app()
    except UserError as error:
        say(f"merge-sumo: {error}")
        sys.exit(2)


if __name__ == "__main__":
    main()
