"""How near the samplers come to the ground truth, and what they cost.

    python tools/bench_samplers.py --vut design1 --level 0 --seeds 10
    python tools/bench_samplers.py --vut design1 --level 0 --seeds 10 --ablate
    python tools/bench_samplers.py --time
    python tools/bench_samplers.py --per-case
    python tools/bench_samplers.py --trials --seeds 10 --first 1000
    python tools/bench_samplers.py --held-out --seeds 6 --first 2000
    python tools/bench_samplers.py --dense --vut design1 --level 0 --seeds 10 --first 1000

The first prints medians of FMC / truth after 100, 200 and 400 cases, `coverage` in batches of its
own and the others in batches of 20; the second does so for `gpr` with one of its choices changed
at a time; the third prints the seconds that a sampler takes for a batch after N cases; the fourth
prints the CPU time of `coverage` with its model of the controller for a case at three levels after
N uniform cases, and the memory of the model; `--trials` lets `coverage`, the same without that
model, and `gpr` search the VUTs of `trial_vuts.py`, on which nothing was tuned, at every level at
which they fail;
`--held-out` lets samplers search the VUTs of `held_out_vuts.py`, whose failures nothing foretells,
and prints medians with the least and the most after 100 and 400 cases.

`--dense` measures against a dense truth of 1,000,000 cases by the kinematic engine: the share of
its FMC after few cases, and the cases to .9 of it as a ratio to those of an oracle, which knows all
failures of the truth and takes the most useful one each time.
"""

from __future__ import annotations

import argparse
import math
import pickle
import sys
import time
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from bench_record import add_record_option, append_record

from merge_sumo.analysis.truth import DENSE_CASES, Truth, ground_truth
from merge_sumo.campaigns.campaign import controller_model_of
from merge_sumo.campaigns.loop import Groups, SearchLoop
from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.metrics.fmc import RADIUS, fmc
from merge_sumo.metrics.measures import Measures
from merge_sumo.metrics.outcome import Outcome, Prediction
from merge_sumo.samplers import gpr
from merge_sumo.samplers.registry import SAMPLERS, make_sampler
from merge_sumo.scenario.case import Pool, to_unit
from merge_sumo.scenario.scenario import LEVELS, US23
from merge_sumo.scenario.trajectory import End
from merge_sumo.simulation.evaluate import simulate
from merge_sumo.simulation.plan import Engine, SimulationPlan

sys.path.append(str(Path(__file__).parent / "benchmark"))
from oracle import greedy_cover

CASES, BATCH = 400, 20
WITHOUT = "coverage without its model"
TRIALS = ("Idm", "Hysteresis", "Delayed", "Rss", "Courteous", "Table", "Noisy", "Hidden")
HELD_OUT = ("Cells", "Islands", "Shell", "NoisySensors")
DEVELOPMENT = ("Lots", "Stripes", "Ring")
"""VUTs whose failures nothing foretells: those to report on, and those to choose on."""
FEWEST_FAILURES = 5
"""Failures of a truth from which a share of it means something."""
SHOWN = (100, 200, 400)
ABLATIONS: dict[str, dict[str, Any]] = {
    "as it is": {},
    "noise 1e-4": {"NOISE": 1e-4},
    "noise 1e-3": {"NOISE": 1e-3},
    "noise 3e-2": {"NOISE": 3e-2},
    "z1 = 2": {"Z_EXPLOIT": (2.0, 1.0)},
    "z1 = 8": {"Z_EXPLOIT": (8.0, 1.0)},
    "epsilon0 = .1": {"EPSILON0": 0.1},
    "epsilon0 = .3": {"EPSILON0": 0.3},
    "alpha = .91": {"ALPHA": 0.91},
    "p = 1000": {"QUERIES": 1000},
    "p = 16000": {"QUERIES": 16_000},
    "lengths from .02": {"LENGTH_BOUNDS": (0.02, 5.0)},
    "lengths from .1": {"LENGTH_BOUNDS": (0.1, 5.0)},
    "covered balls not discounted": {"FLOOR": 1e9},
}
"""Of `gpr`: what each choice is worth is the difference to the first line."""


@contextmanager
def changed(constants: dict[str, Any]) -> Iterator[None]:
    """Give constants of `gpr` other values for a while."""
    before = {name: getattr(gpr, name) for name in constants}
    try:
        for name, value in constants.items():
            setattr(gpr, name, value)
        yield
    finally:
        for name, value in before.items():
            setattr(gpr, name, value)


def search(
    name: str, level: int, seed: int, plan: SimulationPlan, truth: Truth
) -> tuple[list[float], int, float]:
    """Return FMC / truth at SHOWN, the real regions found, and the seconds of the sampler."""
    pool = Pool(levels=(level,), scenario=US23)
    games = None if name == WITHOUT else controller_model_of(plan, pool, seed)
    sampler = make_sampler("coverage" if name == WITHOUT else name, pool, seed, games)
    batch = None if sampler.predictor else BATCH
    seconds = 0.0

    def timed(function: Callable[..., Any]) -> Callable[..., Any]:
        def wrapper(*arguments: Any) -> Any:
            nonlocal seconds
            start = time.process_time()
            try:
                return function(*arguments)
            finally:
                seconds += time.process_time() - start

        return wrapper

    sampler.ask = timed(sampler.ask)  # type: ignore[method-assign]
    sampler.tell = timed(sampler.tell)  # type: ignore[method-assign]
    found: list[Any] = []
    curve, ended = {}, 0
    groups: Groups = []
    SearchLoop(sampler, plan, CASES, batch=batch).run(groups.extend)
    for group in groups:
        found += [one.outcome.case for one in group if one.outcome.failed]
        ended += len(group)
        if ended in SHOWN:
            curve[ended] = fmc(to_unit(found, level, scenario=US23))
    points, whole = to_unit(found, level, scenario=US23), fmc(truth.failures)
    regions = sum(
        bool((np.linalg.norm(points[:, None] - region, axis=2) <= RADIUS).any())
        for region in truth.real_regions()
    )
    return [curve[n] / whole if whole else math.nan for n in SHOWN], regions, seconds


SOON = (30, 50, 100, 400)
MOST = 0.9
"""Numbers of cases, and share of the FMC of a dense truth, that `--dense` prints."""
LEARNED_CASES = 100


def print_dense(options: argparse.Namespace, names: Sequence[str]) -> dict[str, Any]:
    """Print and return how soon samplers find the failures of a dense truth."""
    vut, level, cases = options.vut, options.level, options.cases
    plan = resolve(CampaignSettings(vut=vut, levels=(level,), scenario=US23)).with_engine(
        Engine.KINEMATIC
    )
    truth = ground_truth(plan, level, DENSE_CASES).failures
    soon = [n for n in SOON if n <= cases]
    whole, (best, _) = fmc(truth), greedy_cover(truth, cases)
    oracle = _cases_to(MOST * whole, best, np.arange(len(best)), len(best))
    figures: dict[str, Any] = {"FMC": whole, "oracle": oracle}
    after = " ".join(f"{f'N={n}':>6s}" for n in soon)
    print(f"{vut}, level {level}: dense FMC {whole:.4f}, oracle {oracle:.0f} cases to {MOST:.0%}")
    print(
        f"{'median FMC / dense FMC':30s}{after}  cases to {MOST:.0%} [quartiles]  ratio to oracle"
    )
    for name in names:
        shares, needed = [], []
        for seed in range(options.first, options.first + options.seeds):
            points, index = _failures(plan, name, level, seed, options.batch, cases)
            shares.append([fmc(points[index < n]) / whole for n in soon])
            needed.append(_cases_to(MOST * whole, points, index, cases))
        low, median, high = np.quantile(needed, (0.25, 0.5, 0.75), method="nearest").tolist()
        by_cases = np.median(shares, axis=0).tolist()
        figures[name] = {"shares": by_cases, "cases": needed, "ratio": median / oracle}
        columns = " ".join(f"{share:6.2f}" for share in by_cases)
        print(
            f"{name:30s}{columns}  {median:5.0f} [{low:.0f}, {high:.0f}]  {median / oracle:6.2f}",
            flush=True,
        )
    return figures


def _failures(
    plan: SimulationPlan,
    name: str,
    level: int,
    seed: int,
    batch: int | None,
    cases: int,
) -> tuple[Any, Any]:
    """Return the failures that a sampler finds, (m, d), and their indices, (m,)."""
    pool = Pool(levels=(level,), scenario=US23)
    sampler = make_sampler(name, pool, seed, controller_model_of(plan, pool, seed))
    batch = batch or (None if sampler.predictor else BATCH)
    groups: Groups = []
    SearchLoop(sampler, plan, cases, batch=batch).run(groups.extend)
    failed = [one.outcome for group in groups for one in group if one.outcome.failed]
    points = to_unit([outcome.case for outcome in failed], level, scenario=US23)
    return points, np.array([outcome.index for outcome in failed], dtype=np.int64)


def _cases_to(wanted: float, points: Any, index: Any, most: int) -> float:
    """Return the cases after which failures, (m, d), of ascending indices have a coverage."""
    if fmc(points) < wanted:
        return math.inf
    return 1.0 + bisect_left(range(most), wanted, key=lambda n: fmc(points[index <= n]))


def bench(
    name: str, level: int, seeds: int, plan: SimulationPlan, truth: Truth, first: int = 0
) -> dict[str, float]:
    """Return the figures of a sampler over the seeds, from the first one on, by name."""
    runs = [search(name, level, seed, plan, truth) for seed in range(first, first + seeds)]
    shares = np.median([run[0] for run in runs], axis=0)
    return {
        **{f"share after {n}": float(share) for n, share in zip(SHOWN, shares, strict=True)},
        "lowest": min(run[0][-1] for run in runs),
        "all regions": sum(run[1] == len(truth.real_regions()) for run in runs),
        "seeds": seeds,
        "sampler s": float(np.median([run[2] for run in runs])),
    }


def cells(figures: dict[str, float]) -> str:
    """Return the figures of a sampler as cells of a table."""
    *shares, whole, seeds, seconds = figures.values()
    columns = " ".join(f"{share:7.2f}" for share in shares)
    return f"{columns}   {whole:2.0f} of {seeds:2.0f}   {seconds:6.1f}"


def outcome(index: int, case: Any) -> Outcome:
    """Return an outcome in closed form: a slanted band of failures."""
    x, v = to_unit([case], case.level, scenario=US23)[0, :2].tolist()
    dx_m = 200.0 * (0.6 * x + 0.8 * v - 0.7)
    overlap_m = 6.0 - abs(dx_m)
    score = -560.0 - 75.0 * overlap_m if overlap_m > 0 else -450.0 * math.exp(overlap_m / 15.0)
    measures = Measures(end=End.MERGED, score=score, t_end_s=8.3, dx_m=dx_m)
    return Outcome(index, index // BATCH, case, measures)


def print_times(names: list[str]) -> dict[str, dict[int, float]]:
    """Print and return the seconds of one core for a batch after N cases at level 2."""
    sizes = (100, 200, 400, 1000, 2000, 5000)
    print(f"{'seconds for a batch after N =':30s}" + " ".join(f"{n:7d}" for n in sizes))
    cases = make_sampler("uniform", Pool(levels=(2,), scenario=US23), 0).ask(sizes[-1])
    outcomes = [outcome(index, case) for index, case in enumerate(cases)]
    figures: dict[str, dict[int, float]] = {}
    for name in names:
        seconds = figures[name] = {}
        for size in sizes:
            sampler = make_sampler(name, Pool(levels=(2,), scenario=US23), 0)
            sampler.tell(outcomes[:size])
            start = time.process_time()
            sampler.ask(BATCH)
            seconds[size] = time.process_time() - start
        print(f"{name:30s}" + " ".join(f"{s:7.2f}" for s in seconds.values()), flush=True)
    return figures


def print_cost_per_case() -> dict[str, dict[int, float]]:
    """Print and return what `coverage` with its model takes for a case after N cases of design2."""
    sizes = (100, 500, 5000, 12_000)
    settings = CampaignSettings(vut="design2", levels=LEVELS, scenario=US23)
    plan, pool = resolve(settings), settings.pool
    cases = make_sampler("uniform", pool, 0).ask(sizes[-1])
    order, rng = np.random.default_rng(1).permutation(len(cases)), np.random.default_rng(2)
    outcomes, motions = [], {}
    for index, result in enumerate(simulate(plan, [cases[place] for place in order.tolist()])):
        gap_m = np.nan if result.outcome.measures.dx_m is None else result.outcome.measures.dx_m
        chance = 0.9 if abs(gap_m) < US23.dx_crash_m else 0.1
        told = Prediction.of(gap_m + rng.normal(0.0, 0.5, (2, 4)), chance, chance, chance)
        outcomes.append(result.at(index, index // BATCH, told).outcome)
        motions[index] = result.trajectory.motion
    figures: dict[str, dict[int, float]] = {"ms of CPU per case": {}, "MB of the model": {}}
    for size in sizes:
        model = controller_model_of(plan, pool, 0)
        sampler = make_sampler("coverage", pool, 0, model)
        sampler.tell(outcomes[: size - BATCH], motions)
        sampler.ask(sampler.batch_size())  # what the first batch alone has to learn
        start = time.process_time()
        sampler.tell(outcomes[size - BATCH : size], motions)
        batch = sampler.ask(sampler.batch_size())
        spent_s = time.process_time() - start
        figures["ms of CPU per case"][size] = 1e3 * spent_s / len(batch)
        figures["MB of the model"][size] = len(pickle.dumps(model)) / 1e6
    print(f"{'after N =':30s}" + " ".join(f"{n:7d}" for n in sizes))
    for name, values in figures.items():
        print(f"{name:30s}" + " ".join(f"{value:7.1f}" for value in values.values()))
    return figures


def print_trials(trials: Sequence[str], seeds: int, first: int) -> dict[str, dict[str, float]]:
    """Print and return how samplers search VUTs on which nothing was tuned."""
    figures = {}
    print("FMC / truth" + " ".join(f"{f'N={n}':>7s}" for n in SHOWN) + " lowest   all regions")
    for trial in trials:
        vut = f"{Path(__file__).with_name('trial_vuts.py')}:{trial}"
        plan = resolve(CampaignSettings(vut=vut, levels=LEVELS, scenario=US23))
        for level in LEVELS:
            truth = ground_truth(plan, level)
            if len(truth.failures) < FEWEST_FAILURES:
                continue
            for name in ("coverage", WITHOUT, "gpr"):
                search_name = f"{trial}, level {level}: {name}"
                figures[search_name] = bench(name, level, seeds, plan, truth, first)
                print(f"{search_name:45s}{cells(figures[search_name])}", flush=True)
    return figures


def print_held_out(options: argparse.Namespace, names: Sequence[str]) -> dict[str, Any]:
    """Print and return how samplers search VUTs whose failures nothing foretells."""
    figures: dict[str, Any] = {}
    shown = [SHOWN.index(n) for n in (100, 400)]
    print(f"{'median FMC / truth [least, most]':40s} {'N=100':>18s} {'N=400':>18s}  sampler s")
    for trial in options.held_out or HELD_OUT:
        vut = f"{Path(__file__).with_name('held_out_vuts.py')}:{trial}"
        settings = CampaignSettings(vut=vut, levels=(options.level,), scenario=US23)
        plan = resolve(settings).for_cases(BATCH)
        truth = ground_truth(plan, options.level)
        for name in names:
            seeds = range(options.first, options.first + options.seeds)
            runs = [search(name, options.level, seed, plan, truth) for seed in seeds]
            shares = np.array([[run[0][place] for place in shown] for run in runs])
            seconds = float(np.median([run[2] for run in runs]))
            row = f"{trial}, level {options.level}: {name}"
            figures[row] = {"shares": shares.tolist(), "sampler s": seconds}
            columns = (f"{np.median(of):6.3f} [{of.min():.2f}, {of.max():.2f}]" for of in shares.T)
            print(f"{row:40s} {' '.join(columns)}  {seconds:9.1f}", flush=True)
    return figures


def main() -> None:
    """Parse the command line and print the table that it asks for."""
    parser = argparse.ArgumentParser(description="What samplers find, and what they cost.")
    parser.add_argument("--vut", default="design1")
    parser.add_argument("--level", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--samplers", default=",".join(SAMPLERS))
    parser.add_argument("--ablate", action="store_true", help="change the choices of gpr")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument(
        "--trials",
        nargs="*",
        choices=TRIALS,
        metavar="NAME",
        help=f"search VUTs unlike ours: all, or some of {', '.join(TRIALS)}",
    )
    parser.add_argument(
        "--held-out",
        nargs="*",
        choices=(*HELD_OUT, *DEVELOPMENT),
        metavar="NAME",
        help=f"search VUTs that nothing foretells: {', '.join(HELD_OUT)}, or some of these and "
        f"{', '.join(DEVELOPMENT)}",
    )
    parser.add_argument("--dense", action="store_true", help="beside a dense truth and an oracle")
    parser.add_argument("--batch", type=int, help="of --dense: cases of a batch")
    parser.add_argument("--cases", type=int, default=max(SOON), help="of --dense: cases in all")
    parser.add_argument("--time", action="store_true", help="time batches up to N = 5,000")
    parser.add_argument("--per-case", action="store_true", help="CPU time per case of coverage")
    add_record_option(parser)
    options = parser.parse_args()
    names = options.samplers.split(",")
    if options.time:
        append_record(options.record, "samplers, time", print_times(names))
    elif options.per_case:
        append_record(options.record, "samplers, per case", print_cost_per_case())
    elif options.dense:
        figures = print_dense(options, names)
        what = f"samplers, {options.vut}, level {options.level}, dense"
        append_record(options.record, what, figures)
    elif options.held_out is not None:
        figures = print_held_out(options, names)
        append_record(options.record, f"samplers, held out, level {options.level}", figures)
    elif options.trials is not None:
        figures = print_trials(options.trials or TRIALS, options.seeds, options.first)
        append_record(options.record, "samplers, trials", figures)
    else:
        figures = print_searches(options, names)
        what = f"samplers, {options.vut}, level {options.level}"
        append_record(options.record, what + ", ablated" * options.ablate, figures)


def print_searches(options: argparse.Namespace, names: list[str]) -> dict[str, dict[str, float]]:
    """Print and return what samplers, or `gpr` with other constants, find of one VUT's failures."""
    settings = CampaignSettings(vut=options.vut, levels=(options.level,), scenario=US23)
    plan = resolve(settings).for_cases(BATCH)
    truth = ground_truth(plan, options.level)
    print(f"{options.vut}, level {options.level}, FMC of the truth {fmc(truth.failures):.4f}")
    heads = [*(f"N={n}" for n in SHOWN), "lowest"]
    print(
        f"{'FMC / truth':30s}" + " ".join(f"{h:>7s}" for h in heads) + "   all regions   sampler s"
    )
    rows = {label: ("gpr", constants) for label, constants in ABLATIONS.items()}
    if not options.ablate:
        rows = {name: (name, {}) for name in names}
    figures = {}
    for label, (name, constants) in rows.items():
        with changed(constants):
            figures[label] = bench(name, options.level, options.seeds, plan, truth, options.first)
        print(f"{label:30s}{cells(figures[label])}", flush=True)
    return figures


if __name__ == "__main__":
    main()
