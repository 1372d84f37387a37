"""Measure the intervals of `probability`: how often they hold, and how wide they are.

`python tools/bench_probability.py`

    sets      failure sets in the unit square with a known area, and surrogates that know them well,
              blurred, in part, in a wrong place or not at all; no simulation
    campaign  design1 at level 0 after a campaign of `coverage`: fresh cases by the kinematic
              engine, and the probability from a ground truth of 1,000,000 uniform cases
    merges    failures per merge of three VUTs in traffic of exid-5, by the kinematic engine: how
              many seeds have an interval that holds, by level and over all mixtures

Each row of sets and campaign gives seeds whose interval holds the probability, its mean width as a
ratio to that of Clopper and Pearson on as many plain cases (in brackets the largest ratio of a seed
to that mean), and the standard deviation of the estimate as a ratio to that of the plain share.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from bench_record import add_record_option, append_record
from numpy.typing import NDArray
from scipy.spatial import KDTree

from merge_sumo.analysis.exposure import read_distribution
from merge_sumo.analysis.traffic import named_traffic
from merge_sumo.api import truths
from merge_sumo.campaigns.campaign import run_campaign
from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.engine.evaluate import evaluate
from merge_sumo.engine.plan import Engine, SimulationPlan
from merge_sumo.studies import stratified
from merge_sumo.studies.failures_per_merge import OverMixtures, Part, Stated, part_of, parts_of
from merge_sumo.studies.probability import STREAM, Expected, strata_of
from merge_sumo.studies.run_study import RunStudy
from merge_sumo.studies.stratified import Draws, Strata, cells, estimate
from merge_sumo.values.case import FloatArray
from merge_sumo.values.chance import clopper_pearson
from merge_sumo.values.scenario import US23

CONFIDENCE = 0.95
PARTS = ("sets", "campaign", "merges")
TRUTH_CASES = 1_000_000
CAMPAIGN = CampaignSettings(vut="design1", levels=(0,), cases=200, seed=5, scenario=US23)
CHUNK = 20_000
VUTS = ("design1", "design2", "level0")
LEVELS = (0, 1, 2)
TRAFFIC = "exid-5"
MERGE_CASES = 120
"""Fresh cases of each part of a traffic,"""
FEW, NEIGHBOURS, BANK = 500, 5, 500
"""uniform cases that tell what to expect, those that decide on a cell, and cases of a stratum."""
Verdicts = NDArray[np.bool_]


@dataclass(frozen=True)
class Row:
    """What was measured of one kind of probability."""

    name: str
    probability: float
    cases: int
    held: int
    width: float
    widest: float
    spread: float


def measured(
    name: str,
    strata: Strata,
    probability: float,
    seeds: range,
    verdicts: Callable[[list[Draws]], Iterator[Verdicts]],
) -> Row:
    """Draw from strata with each seed, and compare the intervals with those of plain cases."""
    draws = [strata.draw(np.random.default_rng([seed, STREAM])) for seed in seeds]
    n = int(strata.cases.sum())
    found = []
    for drawn, failed in zip(draws, verdicts(draws), strict=True):
        found.append(estimate(strata, drawn, failed, np.ones(n, dtype=bool), CONFIDENCE))
    plain_failures = np.random.default_rng([seeds.start, 1]).binomial(n, probability, 1000)
    plain = [clopper_pearson(int(k), n, (1.0 - CONFIDENCE) / 2.0) for k in plain_failures]
    usual = float(np.mean([high - low for low, high in plain]))
    widths = np.array([one.high - one.low for one in found])
    spread = np.std([one.probability for one in found])
    return Row(
        name,
        probability,
        n,
        sum(one.low <= probability <= one.high for one in found),
        float(widths.mean()) / usual,
        float(widths.max()) / usual,
        float(spread) / np.sqrt(probability * (1.0 - probability) / n),
    )


def sets(cases: int, seeds: range) -> Iterator[Row]:
    """Measure on bands across the unit square, by what a surrogate knows of them."""
    for area in (0.009, 0.05, 0.2):
        # A band leaves the square through u = 0 and u = 1, and is this high everywhere.
        def beyond(points: FloatArray, middle: float, area: float = area) -> FloatArray:
            return np.abs(0.75 * points[:, 0] + points[:, 1] - middle) - area / 2.0

        def fails(points: FloatArray, beyond: Callable[..., FloatArray] = beyond) -> Verdicts:
            return beyond(points, 0.875) < 0.0

        where = cells(2)
        at, elsewhere = beyond(where, 0.875), beyond(where, 1.0 + area)
        left = np.where(where[:, 0] < 0.5, at, 1.0)
        surrogates = {
            "well": 1.0 / (1.0 + np.exp(np.clip(at / 0.002, -30, 30))),
            "blurred": 1.0 / (1.0 + np.exp(np.clip(at / 0.01, -30, 30))),
            "half of it": 1.0 / (1.0 + np.exp(np.clip(left / 0.002, -30, 30))),
            "wrong place": 1.0 / (1.0 + np.exp(np.clip(elsewhere / 0.002, -30, 30))),
            "nothing": np.zeros(len(where)),
        }
        for name, chance in surrogates.items():
            strata = Strata({1: 1.0}, {1: chance}, US23, cases, CONFIDENCE)

            def verdicts(
                draws: list[Draws], of: Callable[..., Verdicts] = fails
            ) -> Iterator[Verdicts]:
                return (of(one.chances[:, :2]) for one in draws)

            yield measured(f"band, known: {name}", strata, area, seeds, verdicts)


def campaign(cases: list[int], seeds: range) -> Iterator[Row]:
    """Measure after a campaign, against a ground truth of a million cases."""
    known = truths("design1", 0, cases=TRUTH_CASES, engine=Engine.KINEMATIC).truths[0]
    probability = len(known.failures) / len(known.score)
    plan = resolve(CAMPAIGN).with_engine(Engine.KINEMATIC)
    stated = read_distribution(None, CAMPAIGN.levels, CAMPAIGN.scenario)

    def verdicts(draws: list[Draws]) -> Iterator[Verdicts]:
        points = np.concatenate([one.chances[:, :2] for one in draws])
        of_points = CAMPAIGN.pool.cases(stated.points(0, points), 0)
        failed = np.empty(len(of_points), dtype=bool)
        for first in range(0, len(of_points), CHUNK):
            part = of_points[first : first + CHUNK]
            for place, result in evaluate(plan.for_cases(len(part)), part):
                failed[first + place] = result.outcome(first + place, 0).failed
        return iter(failed.reshape(len(draws), -1))

    with tempfile.TemporaryDirectory() as folder:
        run = run_campaign(CAMPAIGN, resolve(CAMPAIGN), Path(folder) / "run")
        for number in cases:
            expected = Expected(RunStudy(run, CAMPAIGN, plan))
            strata = strata_of(expected, CAMPAIGN.scenario, stated, number, CONFIDENCE)
            yield measured("design1, level 0", strata, probability, seeds, verdicts)


def merges(seeds: range) -> Iterator[tuple[str, dict[str, int], float, float]]:
    """Yield a VUT, seeds whose interval holds by level, and the range of the truth over mixtures.

    What is expected comes from few uniform cases in the place of twin and surrogate, which take
    longer: it decides the width alone. The population of a stratum are `BANK` cases of it that have
    run, so that the truth is known exactly; the cases of a seed are drawn from them independently.
    An interval over mixtures holds where it has the truths of all its parts.
    """
    for vut in VUTS:
        settings = CampaignSettings(vut=vut, levels=LEVELS, scenario=US23)
        plan = resolve(settings).with_engine(Engine.KINEMATIC)
        parts = parts_of(named_traffic(TRAFFIC), US23, LEVELS)
        banks = [_bank_of(settings, plan, part) for part in parts]
        true = np.array([bank.truth for bank in banks])
        held = dict.fromkeys(["all", *map(str, LEVELS)], 0)
        for seed in seeds:
            found = [bank.found(np.random.default_rng([seed, n])) for n, bank in enumerate(banks)]
            for name in held:
                own = [i for i, part in enumerate(found) if name in ("all", str(part.level))]
                one = OverMixtures.of(found[i] for i in own)
                held[name] += bool(one.low <= true[own].min() and true[own].max() <= one.high)
        yield vut, held, float(true.min()), float(true.max())


@dataclass(frozen=True)
class Bank:
    """Cases of all strata of a part that have run, and the truth of drawing from them."""

    part: Stated
    strata: Strata
    failed: list[Verdicts]

    @property
    def truth(self) -> float:
        """Failures per merge."""
        of_strata = [failed.mean() for failed in self.failed]
        return self.part.cars * float(self.strata.share @ of_strata)

    def found(self, rng: np.random.Generator) -> Part:
        """Return what independent cases of each stratum say."""
        failed = np.concatenate(
            [rng.choice(of, n) for of, n in zip(self.failed, self.strata.cases, strict=True)]
        )
        draws = self.strata.draw(rng)
        judged = np.ones(len(failed), dtype=bool)
        return part_of(self.part, self.strata, draws, failed, judged, CONFIDENCE)


def _bank_of(settings: CampaignSettings, plan: SimulationPlan, part: Stated) -> Bank:
    """Run the cases of a bank."""
    dims = len(US23.dimensions(part.level))
    few = np.random.default_rng(part.level).random((FEW, dims))
    known = _fail(plan, settings, part, few)
    _, near = KDTree(few).query(cells(dims), NEIGHBOURS)
    chance = {part.level: known[near].mean(axis=1)}
    strata = Strata({part.level: 1.0}, chance, US23, MERGE_CASES, CONFIDENCE)
    drawn = copy(strata)
    drawn.cases = np.full_like(strata.cases, BANK)
    draws = drawn.draw(np.random.default_rng(0))
    failed = _fail(plan, settings, part, draws.chances[:, :dims])
    return Bank(part, strata, [failed[draws.stratum == h] for h in range(len(strata.cases))])


def _fail(
    plan: SimulationPlan, settings: CampaignSettings, part: Stated, chances: FloatArray
) -> Verdicts:
    """Return which cases at chances of a part's distribution fail."""
    cases = settings.pool.cases(part.distribution.points(part.level, chances), part.level)
    failed = np.empty(len(cases), dtype=bool)
    for place, result in evaluate(plan.for_cases(len(cases)), cases):
        failed[place] = result.outcome(place, 0).failed
    return failed


def main() -> None:
    """Print a table of what was measured."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--cases", type=int, nargs="+", default=[600, 4000])
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS)
    add_record_option(parser)
    args = parser.parse_args()
    stratified.upper_end = _once(stratified.upper_end)  # the same counts have the same end
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    print(f"seeds {seeds.start} to {seeds.stop - 1}, confidence {CONFIDENCE:.0%}")
    print(f"{'':30} {'p':>7} {'cases':>6} {'held':>9}  {'width':>14}  {'spread':>6}")
    figures = []
    rows = (
        [row for number in args.cases for row in sets(number, seeds)] if "sets" in args.only else []
    )
    for row in rows:
        show(row, args.seeds)
        figures.append(row)
    if "campaign" in args.only:
        for row in campaign(args.cases, seeds):
            show(row, args.seeds)
            figures.append(row)
    recorded = {row.name: row.width for row in figures}
    if "merges" in args.only:
        for vut, held, least, most in merges(seeds):
            counts = ", ".join(f"{name}: {count}/{args.seeds}" for name, count in held.items())
            print(f"{vut}, {least:.4f} to {most:.4f} failures per merge: {counts}", flush=True)
            recorded |= {f"{vut}, {name}": float(count) for name, count in held.items()}
    append_record(args.record, "probability", recorded)


def show(row: Row, seeds: int) -> None:
    """Print a row."""
    print(
        f"{row.name:30} {row.probability:7.4f} {row.cases:6d} {row.held:5d}/{seeds}"
        f"  {row.width:5.2f} (<= {row.widest:.2f})  {row.spread:6.2f}",
        flush=True,
    )


def _once(end: Callable[..., float]) -> Callable[..., float]:
    """Return the function, which keeps its results."""

    @cache
    def kept(
        share: tuple[float, ...], cases: tuple[int, ...], failures: tuple[int, ...], risk: float
    ) -> float:
        return end(np.array(share), np.array(cases), np.array(failures), risk)

    return lambda share, cases, failures, risk: kept(
        tuple(share.tolist()), tuple(cases.tolist()), tuple(failures.tolist()), risk
    )


if __name__ == "__main__":
    main()
