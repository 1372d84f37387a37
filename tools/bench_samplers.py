"""Measure how soon samplers find the failures of a dense truth, and what they cost.

    python tools/bench_samplers.py dense --vut design1 --level 0 --seeds 10 --first 1000
    python tools/bench_samplers.py time
    python tools/bench_samplers.py per-case

`dense` compares with a truth of 1,000,000 cases by the kinematic engine. It prints the share of the
truth's FMC after few cases, and the cases to .9 of it as a ratio to an oracle, which has all
failures of the truth and takes the most useful failure each time. `time` prints the seconds of CPU
that a sampler takes for a batch after N cases. `per-case` prints the CPU time of `coverage` with
its model of the controller for a case at three levels after N uniform cases, and the memory of the
model. `merge-sumo benchmark` compares samplers on any VUT.
"""

from __future__ import annotations

import argparse
import math
import pickle
import time
from bisect import bisect_left
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from measuring import append_record, benchmark_parser
from oracle import greedy_cover

from merge_sumo.analysis.sampler_study import COMPARED_BATCH, search
from merge_sumo.analysis.truth import DENSE_CASES, ground_truth
from merge_sumo.campaigns.campaign import controller_model_of
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.metrics.fmc import fmc
from merge_sumo.metrics.outcome import Prediction
from merge_sumo.samplers.registry import SAMPLERS, make_sampler
from merge_sumo.scenario.case import Pool, to_unit
from merge_sumo.scenario.scenario import LEVELS, US23
from merge_sumo.simulation.evaluate import simulate
from merge_sumo.simulation.plan import Engine

SHOWN = (30, 50, 100, 400)
"""Numbers of cases after which `dense` prints the share."""
MOST = 0.9
"""Share of the FMC of a dense truth up to which it counts cases."""
HISTORIES = (100, 200, 400, 1000, 2000, 5000)
MODEL_HISTORIES = (100, 500, 5000, 12_000)


def cases_to(wanted: float, points: Any, index: Any, most: int) -> float:
    """Return the cases after which failures have a coverage; infinite where they never have.

    Args:
        wanted: the coverage.
        points: failures in the unit cube, (m, d).
        index: their indices, ascending, (m,).
        most: number of cases of the search.
    """
    if fmc(points) < wanted:
        return math.inf
    return 1.0 + bisect_left(range(most), wanted, key=lambda n: fmc(points[index <= n]))


def dense(options: argparse.Namespace, names: Sequence[str]) -> dict[str, Any]:
    """Measure and print how soon samplers find the failures of a dense truth.

    Args:
        options: the options of the command line.
        names: names of the samplers.

    Returns:
        Figures by sampler.
    """
    level, cases = options.level, options.cases
    settings = CampaignSettings(vut=options.vut, levels=(level,), scenario=US23)
    plan = settings.load_plan().with_engine(Engine.KINEMATIC)
    truth = ground_truth(plan, level, DENSE_CASES).failures
    shown = [n for n in SHOWN if n <= cases]
    whole, (best, _) = fmc(truth), greedy_cover(truth, cases)
    oracle = cases_to(MOST * whole, best, np.arange(len(best)), len(best))
    print(f"{options.vut}, level {level}: dense FMC {whole:.4f}, oracle {oracle:.0f} to {MOST:.0%}")
    after = " ".join(f"{f'N={n}':>6s}" for n in shown)
    print(f"{'median FMC / dense FMC':30s}{after}  cases to {MOST:.0%} [quartiles]  over oracle")
    figures: dict[str, Any] = {"FMC": whole, "oracle": oracle}
    for name in names:
        shares, needed = [], []
        for seed in range(options.first, options.first + options.seeds):
            (found,) = search(plan, (level,), cases, options.batch, [(name, seed)])
            failed = [outcome for outcome in found.outcomes if outcome.failed]
            index = np.array([outcome.index for outcome in failed], dtype=np.int64)
            points = to_unit([outcome.case for outcome in failed], level, scenario=US23)
            shares.append([fmc(points[index < n]) / whole for n in shown])
            needed.append(cases_to(MOST * whole, points, index, cases))
        low, median, high = np.quantile(needed, (0.25, 0.5, 0.75), method="nearest").tolist()
        ratio, by_cases = median / oracle, np.median(shares, axis=0).tolist()
        figures[name] = {"shares": by_cases, "cases": needed, "ratio": ratio}
        columns = " ".join(f"{share:6.2f}" for share in by_cases)
        row = f"{name:30s}{columns}  {median:5.0f} [{low:.0f}, {high:.0f}]  {ratio:6.2f}"
        print(row, flush=True)
    return figures


def cost_of_batches(_: object, names: Sequence[str]) -> dict[str, dict[int, float]]:
    """Print and return the CPU seconds of a batch after N cases of `design1` at level 2."""
    plan = CampaignSettings(vut="design1", levels=(2,), scenario=US23).load_plan()
    (known,) = search(plan, (2,), HISTORIES[-1], None, [("uniform", 0)])
    print(f"{'seconds for a batch after N =':30s}" + " ".join(f"{n:7d}" for n in HISTORIES))
    figures: dict[str, dict[int, float]] = {}
    for name in names:
        figures[name] = {}
        for size in HISTORIES:
            sampler = make_sampler(name, Pool(levels=(2,), scenario=US23), 0)
            sampler.tell(known.outcomes[:size])
            start_s = time.process_time()
            sampler.ask(COMPARED_BATCH)
            figures[name][size] = time.process_time() - start_s
        times = " ".join(f"{s:7.2f}" for s in figures[name].values())
        print(f"{name:30s}{times}", flush=True)
    return figures


def cost_of_cases(*_: object) -> dict[str, dict[int, float]]:
    """Print and return what `coverage` with its model takes for a case after N of design2."""
    settings = CampaignSettings(vut="design2", levels=LEVELS, scenario=US23)
    plan, pool = settings.load_plan(), settings.pool
    cases = make_sampler("uniform", pool, 0).ask(MODEL_HISTORIES[-1])
    order, rng = np.random.default_rng(1).permutation(len(cases)), np.random.default_rng(2)
    outcomes, motions = [], {}
    for index, result in enumerate(simulate(plan, [cases[place] for place in order.tolist()])):
        gap_m = result.outcome.measures.dx_m
        gap_m = np.nan if gap_m is None else gap_m
        chance = 0.9 if abs(gap_m) < US23.dx_crash_m else 0.1
        told = Prediction.of(gap_m + rng.normal(0.0, 0.5, 4), chance, chance, chance)
        outcomes.append(result.at(index, index // COMPARED_BATCH, told).outcome)
        motions[index] = result.trajectory.motion
    figures: dict[str, dict[int, float]] = {"ms of CPU per case": {}, "MB of the model": {}}
    for size in MODEL_HISTORIES:
        model = controller_model_of(plan, pool, 0)
        sampler = make_sampler("coverage", pool, 0, model)
        sampler.tell(outcomes[: size - COMPARED_BATCH], motions)
        sampler.ask(sampler.batch_size())  # what the first batch alone has to learn
        start_s = time.process_time()
        sampler.tell(outcomes[size - COMPARED_BATCH : size], motions)
        batch = sampler.ask(sampler.batch_size())
        spent_s = time.process_time() - start_s
        figures["ms of CPU per case"][size] = 1e3 * spent_s / len(batch)
        figures["MB of the model"][size] = len(pickle.dumps(model)) / 1e6
    print(f"{'after N =':30s}" + " ".join(f"{n:7d}" for n in MODEL_HISTORIES))
    for name, values in figures.items():
        print(f"{name:30s}" + " ".join(f"{value:7.1f}" for value in values.values()))
    return figures


PARTS: dict[str, Callable[[argparse.Namespace, list[str]], dict[str, Any]]] = {
    "dense": dense,
    "time": cost_of_batches,
    "per-case": cost_of_cases,
}


def main() -> None:
    """Print the table that the command line names."""
    parser = benchmark_parser(__doc__)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--vut", default="design1")
    parser.add_argument("--level", type=int, default=0)
    parser.add_argument("--samplers", default=",".join(SAMPLERS))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--cases", type=int, default=max(SHOWN), help="cases per search")
    parser.add_argument("--batch", type=int, help="cases per batch; by default the sampler's")
    options = parser.parse_args()
    figures = PARTS[options.part](options, options.samplers.split(","))
    append_record(options.record, f"samplers, {options.part}", figures)


if __name__ == "__main__":
    main()
