"""Experiments on samplers: searches with many seeds, and how near they come to the ground truth."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from heapq import heappop, heapreplace
from io import StringIO
from itertools import accumulate, chain, count
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from merge_sumo.analysis.result import Result
from merge_sumo.campaigns.campaign import conduct
from merge_sumo.engine.evaluate import THIS_PROCESS, evaluate, workers_or_here
from merge_sumo.engine.plan import SimulationPlan
from merge_sumo.errors import UserError
from merge_sumo.road.centre_lines import centre_lines
from merge_sumo.samplers.coverage_grid import CoverageGrid
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.studies.truth import (
    DENSE_CASES,
    TRUTH_CASES,
    Repeats,
    Truth,
    ground_truth,
    known_truth,
)
from merge_sumo.system.printable import counted
from merge_sumo.system.workers import Workers
from merge_sumo.twin.twin import Twin
from merge_sumo.values.case import FloatArray, Pool, to_unit
from merge_sumo.values.fmc import covered, fmc
from merge_sumo.values.scenario import level_name
from merge_sumo.values.score import Outcome


@dataclass(frozen=True, slots=True)
class Search:
    """What one sampler did with one seed.

    Attributes:
        outcomes: what became of every case, in order.
        fmc: failure mode coverage after each batch, summed over the levels.
        sampler_s: seconds spent in the sampler, without simulation.
    """

    outcomes: list[Outcome]
    fmc: list[float]
    sampler_s: float

    def failures(self, level: int) -> FloatArray:
        """Return the failing cases of a level as points, (m, d)."""
        return to_unit((o.case for o in self.outcomes if o.failed and o.case.level == level), level)


ORACLE_STEP: Final = 5
"""Cases between two points of the oracle's curve; divides all batch sizes that samplers choose."""
MOST_PROBES: Final = 10_000
"""Failures of a truth of which a covered share is one, at most: its error is then below .01."""
COMPARED_BATCH: Final = 20
"""Cases of a batch by default, of samplers that choose none: that of Table II."""

Task = tuple[str, tuple[int, ...], int, int | None, int]
"""A search: sampler, levels, cases, batch, seed."""


def _searches(plan: SimulationPlan, tasks: Sequence[Task]) -> list[Search]:
    return [_search(plan, *task) for task in tasks]


def _search(
    plan: SimulationPlan,
    name: str,
    levels: tuple[int, ...],
    cases: int,
    batch: int | None,
    seed: int,
) -> Search:
    pool = Pool(levels=levels, scenario=plan.scenario)
    lines = centre_lines(plan.road)
    twin = Twin(pool, plan.povs, seed, criterion=plan.criterion, lines=lines)
    sampler = make_sampler(name, pool, seed, twin)
    spent = _Stopwatch()
    sampler.ask = spent.timed(sampler.ask)  # type: ignore[method-assign]
    sampler.tell = spent.timed(sampler.tell)  # type: ignore[method-assign]
    search = Search([], [], 0.0)
    batch = batch or (None if sampler.uses_predictions else COMPARED_BATCH)
    run = partial(evaluate, plan, workers=THIS_PROCESS)
    for ran in conduct(sampler, run, cases, batch):
        search.outcomes.extend(outcome for outcome, _ in ran)
        search.fmc.append(sum(fmc(search.failures(level)) for level in levels))
    return replace(search, sampler_s=spent.seconds)


class _Stopwatch:
    def __init__(self) -> None:
        self.seconds = 0.0

    def timed(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def wrapper(*arguments: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*arguments)
            finally:
                self.seconds += time.perf_counter() - start

        return wrapper


@dataclass(frozen=True, slots=True)
class LevelShare:
    """What one sampler did at one level, as medians over all seeds."""

    cases_median: float
    failures_median: float
    fmc_median: float


Quartiles = tuple[float | None, float | None]


@dataclass(frozen=True, slots=True)
class SamplerSummary:
    """One sampler over all seeds, as medians and as quartiles (25 % and 75 %).

    FMC is summed over the levels. `covered_share` is the share of the truth's failures that lie
    within a radius of a failure found (`covered`), the mean over the levels with any; None without.
    `cases_to_50_percent_covered` and `cases_to_90_percent_covered` are cases until that share.
    `cases_to_50_percent` and `cases_to_90_percent` are cases until that share of the truth's FMC.
    All four are None where too few seeds reach it. What is divided by the truth's FMC is None where
    the truth has no failure or is too small (`Truth.is_small`), and `fmc_over_limit` where no limit
    was given. `regions_found` and `seeds_with_all_regions` are None where the truth is too small to
    tell regions.
    """

    fmc_median: float
    fmc_quartiles: Quartiles
    covered_share_median: float | None
    covered_share_quartiles: Quartiles
    fmc_over_truth_median: float | None
    fmc_over_truth_quartiles: Quartiles
    fmc_over_limit_median: float | None
    fmc_over_limit_quartiles: Quartiles
    failures_median: float
    failures_quartiles: Quartiles
    regions_found_median: float | None
    regions_found_quartiles: Quartiles
    seeds_with_all_regions: int | None
    cases_to_50_percent_covered_median: float | None
    cases_to_50_percent_covered_quartiles: Quartiles
    cases_to_90_percent_covered_median: float | None
    cases_to_90_percent_covered_quartiles: Quartiles
    cases_to_50_percent_median: float | None
    cases_to_50_percent_quartiles: Quartiles
    cases_to_90_percent_median: float | None
    cases_to_90_percent_quartiles: Quartiles
    sampler_s_median: float
    cases_by_batch: list[int]
    fmc_by_batch_median: list[float]
    fmc_by_batch_quartiles: tuple[list[float], list[float]]
    covered_share_by_batch_median: list[float] | None
    levels: dict[int, LevelShare]


def search(
    plan: SimulationPlan,
    levels: tuple[int, ...],
    samplers: Sequence[str],
    *,
    seeds: int = 10,
    cases: int = 400,
    batch: int | None = None,
    workers: Workers | None = None,
    on_search: Callable[[str, int], None] | None = None,
) -> dict[str, list[Search]]:
    """Let samplers search the pool of a plan's scenario; return the searches of each by seed.

    Args:
        plan: how cases run.
        levels: POV levels.
        samplers: their names.
        seeds: number of searches of each sampler, with the seeds 0 to `seeds` - 1.
        cases: cases of a search.
        batch: cases of a batch; by default what a sampler wants, or `COMPARED_BATCH`.
        workers: each search runs on one of them, by default in this process.
        on_search: told sampler and seed of a search that has ended.
    """
    tasks = [(name, levels, cases, batch, seed) for name in samplers for seed in range(seeds)]
    for level in levels:
        plan.povs.check_level(level)
    plan = plan.for_cases(batch or COMPARED_BATCH)
    by_place: dict[int, Search] = {}
    with workers_or_here(workers) as processes:
        for place, one in processes.run(partial(_searches, plan), tasks, _lost_search, chunk=1):
            by_place[place] = one
            if on_search is not None:
                name, *_, seed = tasks[place]
                on_search(name, seed)
    searches: dict[str, list[Search]] = {name: [] for name in samplers}
    for place, (name, *_) in enumerate(tasks):
        searches[name].append(by_place[place])
    return searches


def _lost_search(task: Task) -> Search:
    name, *_, seed = task
    raise UserError(f"the search of {name} with seed {seed} ended its worker process each time")


def limit_fmc(
    searches: Iterable[Search], truths: Mapping[int, Truth], dense: Mapping[int, Truth]
) -> float:
    """Return the coverage of all that is known to fail, summed over the levels: no search has more.

    A truth of a few thousand cases misses places that searches find. At each level this is the
    coverage of what truth and searches found together, or of a `dense` truth, whichever is more.
    """
    known = list(searches)
    total = 0.0
    for level, truth in truths.items():
        failing = [truth.failures, *(search.failures(level) for search in known)]
        together = fmc(np.concatenate([points for points in failing if len(points)] or failing[:1]))
        total += max(together, fmc(dense[level].failures) if level in dense else 0.0)
    return total


def compare(
    searches: Sequence[Search],
    truths: Mapping[int, Truth],
    limit: float | None = None,
    dense: Mapping[int, Truth] = MappingProxyType({}),
) -> SamplerSummary:
    """Compare what one sampler found, one search a seed, with the truth at each level.

    `limit` is the coverage of all that is known to fail (`limit_fmc`). Where a level has a `dense`
    truth, its failures are those of which the covered share is one.
    """
    curves = np.array([search.fmc for search in searches])
    whole = None if any_small(truths.values()) else _truth_fmc(truths)
    share, of_limit = (
        curves[:, -1] / divisor if divisor else np.full(len(curves), np.nan)
        for divisor in (whole, limit)
    )
    failures = np.array([sum(o.failed for o in search.outcomes) for search in searches])
    regions_found, seeds_with_all = _regions_found(searches, truths)
    after = _cases_by_batch(searches[0])
    half, most = (_cases_to(part * (whole or np.inf), curves, after) for part in (0.5, 0.9))
    covered_shares = _covered_shares(searches, covered_of(truths, dense))
    half_covered, most_covered = (_cases_to(part, covered_shares, after) for part in (0.5, 0.9))
    by_batch = [np.quantile(curves, part, axis=0).tolist() for part in (0.25, 0.75)]
    is_known = not np.isnan(covered_shares).any()
    return SamplerSummary(
        fmc_median=float(np.median(curves[:, -1])),
        fmc_quartiles=_quartiles(curves[:, -1]),
        covered_share_median=_quantile(covered_shares[:, -1], 0.5),
        covered_share_quartiles=_quartiles(covered_shares[:, -1]),
        fmc_over_truth_median=_quantile(share, 0.5),
        fmc_over_truth_quartiles=_quartiles(share),
        fmc_over_limit_median=_quantile(of_limit, 0.5),
        fmc_over_limit_quartiles=_quartiles(of_limit),
        failures_median=float(np.median(failures)),
        failures_quartiles=_quartiles(failures),
        regions_found_median=_quantile(regions_found, 0.5),
        regions_found_quartiles=_quartiles(regions_found),
        seeds_with_all_regions=seeds_with_all,
        cases_to_50_percent_covered_median=_quantile(half_covered, 0.5),
        cases_to_50_percent_covered_quartiles=_quartiles(half_covered),
        cases_to_90_percent_covered_median=_quantile(most_covered, 0.5),
        cases_to_90_percent_covered_quartiles=_quartiles(most_covered),
        cases_to_50_percent_median=_quantile(half, 0.5),
        cases_to_50_percent_quartiles=_quartiles(half),
        cases_to_90_percent_median=_quantile(most, 0.5),
        cases_to_90_percent_quartiles=_quartiles(most),
        sampler_s_median=float(np.median([search.sampler_s for search in searches])),
        cases_by_batch=after,
        fmc_by_batch_median=np.median(curves, axis=0).tolist(),
        fmc_by_batch_quartiles=(by_batch[0], by_batch[1]),
        covered_share_by_batch_median=(
            np.median(covered_shares, axis=0).tolist() if is_known else None
        ),
        levels={level: _level_share(searches, level) for level in truths},
    )


def any_small(truths: Iterable[Truth]) -> bool:
    """Return whether one of the truths is too small to be divided by."""
    return any(truth.is_small for truth in truths)


def _truth_fmc(truths: Mapping[int, Truth]) -> float:
    return sum(fmc(truth.failures) for truth in truths.values())


def covered_of(truths: Mapping[int, Truth], dense: Mapping[int, Truth]) -> dict[int, FloatArray]:
    """Return by level the failing points of uniform cases of which the covered share is one.

    They are those of the dense truth where there is one: the more, the smaller the error.
    """
    points = {level: dense.get(level, truth).failures for level, truth in truths.items()}
    return {level: failing[:MOST_PROBES] for level, failing in points.items() if len(failing)}


def _covered_shares(searches: Sequence[Search], failing: Mapping[int, FloatArray]) -> FloatArray:
    """Return the covered share after each batch, (S, batches); NaN where no truth has failures."""
    shares = np.full((len(searches), len(searches[0].fmc)), np.nan)
    for row, search in zip(shares, searches, strict=True):
        of_levels = [_covered_by_batch(search, level, points) for level, points in failing.items()]
        if of_levels:
            row[:] = np.mean(of_levels, axis=0)
    return shares


def _covered_by_batch(search: Search, level: int, points: FloatArray) -> FloatArray:
    """Return the share of points, (m, d), that the failures of a level cover after each batch."""
    failed = [o for o in search.outcomes if o.failed and o.case.level == level]
    batches, places = np.array([o.batch for o in failed], dtype=int), search.failures(level)
    numbers = np.unique([outcome.batch for outcome in search.outcomes])
    first = np.full(len(points), np.inf)
    for number in numbers[::-1]:
        first[covered(points, places[batches == number])] = number
    return np.array([(first <= number).mean() for number in numbers])


def _regions_found(
    searches: Sequence[Search], truths: Mapping[int, Truth]
) -> tuple[FloatArray, int | None]:
    """Return how many regions of the truths each search found, and how many searches found all.

    NaN and None where a truth does not tell regions.
    """
    if not all(truth.tells_regions for truth in truths.values()):
        return np.full(len(searches), np.nan), None
    real = [(level, region) for level, truth in truths.items() for region in truth.real_regions()]
    found = [sum(_found(s.failures(level), region) for level, region in real) for s in searches]
    return np.array(found, dtype=np.float64), sum(number == len(real) for number in found)


def _cases_by_batch(search: Search) -> list[int]:
    """Return the number of cases that have run after each batch."""
    sizes = Counter(outcome.batch for outcome in search.outcomes)
    return list(accumulate(sizes.values()))


def _cases_to(target: float, curves: FloatArray, after: list[int]) -> FloatArray:
    """Return the cases that each search needs to reach a coverage; infinite where it does not."""
    reached = curves >= target
    return np.where(reached.any(axis=1), np.array(after)[reached.argmax(axis=1)], np.inf)


def _quantile(values: FloatArray, part: float) -> float | None:
    """Return a quantile, linear between two values; None where one of them is not finite."""
    ordered = np.sort(values)
    place = part * (len(ordered) - 1)
    low, high = ordered[math.floor(place)], ordered[math.ceil(place)]
    if not np.isfinite(high):
        return None
    return float(low + (place - math.floor(place)) * (high - low))


def _quartiles(values: FloatArray) -> Quartiles:
    return _quantile(values, 0.25), _quantile(values, 0.75)


def _level_share(searches: Sequence[Search], level: int) -> LevelShare:
    cases = [sum(o.case.level == level for o in search.outcomes) for search in searches]
    points = [search.failures(level) for search in searches]
    return LevelShare(
        cases_median=float(np.median(cases)),
        failures_median=float(np.median([len(failing) for failing in points])),
        fmc_median=float(np.median([fmc(failing) for failing in points])),
    )


def _found(points: FloatArray, region: FloatArray) -> bool:
    """Return whether one of some failures, (m, d), lies in a region of the truth, (n, d)."""
    return bool(covered(points, region).any())


def oracle(truths: Mapping[int, Truth], cases: int, batch: int | None) -> dict[int, float]:
    """Return the coverage of an oracle by number of cases, summed over the levels.

    It knows the failures of the truth and takes, one after the other, the one whose ball adds the
    most volume: greedy maximum coverage, which no order beats by more than a factor of e / (e - 1)
    (Nemhauser, Wolsey and Fisher, 1978). A sampler may still pass its end, the truth's FMC: it may
    fail in places that the truth's cases have missed.

    Returns:
        FMC after every case of the first batch, and then after every batch, up to `cases`.
        Without a `batch`, samplers choose, and every ORACLE_STEP cases are shown.
    """
    batch = batch or ORACLE_STEP
    greedy = {level: greedy_cover(truth.failures, cases) for level, truth in truths.items()}
    ball = {level: fmc(np.zeros((1, truth.points.shape[1]))) for level, truth in truths.items()}
    gains = [(-g * ball[level], level) for level, (_, gain) in greedy.items() for g in gain]
    order = [level for _, level in sorted(gains)]
    shown = sorted({*range(min(batch, cases) + 1), *range(0, cases, batch), cases})
    return {
        n: sum(fmc(points[: order[:n].count(level)]) for level, (points, _) in greedy.items())
        for n in shown
    }


def greedy_cover(points: FloatArray, most: int) -> tuple[FloatArray, FloatArray]:
    """Return at most so many points, (m, d), in greedy order and what each adds, in balls.

    What a point adds never grows. So the best is one that still adds as much as it once did, if no
    other one ever did more (Minoux, 1978); of points that add the same it is the first.
    """
    grid = CoverageGrid(points.shape[1])
    queue = [(-1.0, place) for place in range(len(points))]
    order: list[int] = []
    gains: list[float] = []
    while queue and len(order) < most:
        once, place = queue[0]
        ball = grid.balls(points[[place]])
        new = float(grid.new(ball)[0])
        if new < -once:
            heapreplace(queue, (-new, place))
            continue
        heappop(queue)
        grid.cover(ball[0], 1.0)
        order.append(place)
        gains.append(new)
    return points[order], np.array(gains)


OnPart = Callable[[str, int, int, str, str], None]
"""Told how far a part of a study is: title, things done, things in all, what a thing is, a note."""


@dataclass(frozen=True, slots=True)
class Study:
    """A plan, and what truths and searches run it with.

    Attributes:
        plan: how cases run.
        workers: where they run; by default in this process.
        cache: folder of the truths, by default the user's.
        on_part: told how far each truth is, and all searches together.
        engine: what moves the vehicles of truths: see `SimulationPlan.with_engine`.
    """

    plan: SimulationPlan
    workers: Workers | None = None
    cache: Path | None = None
    on_part: OnPart = lambda *_: None
    engine: str | None = None

    def truth(
        self,
        level: int,
        cases: int | None = None,
        seed: int = 0,
        repeats: Repeats | None = None,
    ) -> Truth:
        """Return the truth at a level, from the cache where it is kept."""
        total, ended = TRUTH_CASES[level] if cases is None else cases, 0
        size = "dense truth" if total == DENSE_CASES else "truth"
        title = f"{size} of {self.plan.vut.spec} at level {level_name(level)}"

        def ran(more: int) -> None:
            nonlocal ended
            ended += more
            self.on_part(title, ended, total, "cases", "")

        plan = self.plan.at_level(level).with_engine(self.engine)
        where: dict[str, Any] = {"workers": self.workers, "cache": self.cache, "on_cases": ran}
        return ground_truth(plan, level, total, seed, repeats=repeats, **where)

    def dense_truths(self, levels: Sequence[int], wanted: bool | None) -> dict[int, Truth]:
        """Return the dense truths by level: made where `wanted`, where that is None the kept."""
        if wanted is False:
            return {}
        if wanted:
            return {level: self.truth(level, DENSE_CASES) for level in levels}
        kept = {one: known_truth(self.plan, one, DENSE_CASES, cache=self.cache) for one in levels}
        return {level: truth for level, truth in kept.items() if truth is not None}

    def searches(
        self,
        levels: tuple[int, ...],
        samplers: Sequence[str],
        seeds: int,
        cases: int,
        batch: int | None,
    ) -> dict[str, list[Search]]:
        """Let each sampler search with each seed; return the searches by sampler: see `search`."""
        title = f"{self.plan.vut.spec} v level {'/'.join(map(level_name, levels))}"
        number = count(1)
        return search(
            self.plan,
            levels,
            samplers,
            seeds=seeds,
            cases=cases,
            batch=batch,
            workers=self.workers,
            on_search=lambda name, _: self.on_part(
                title, next(number), len(samplers) * seeds, "runs", name
            ),
        )


@dataclass(frozen=True, repr=False)
class SamplerStudy(Result):
    """Samplers beside each other, and beside the ground truth, over several seeds.

    Attributes:
        samplers: `SamplerSummary` by name: medians and quartiles over the seeds.
        truths: the truth by level.
        dense: the dense truth of the levels that have one.
        limit_fmc: coverage of all that truth and searches found, or of the dense truths.
        oracle_fmc: coverage of an oracle by number of cases.
        cases: cases of each search.
        figure: file that was drawn, if any.
    """

    samplers: dict[str, SamplerSummary]
    truths: dict[int, Truth]
    dense: dict[int, Truth]
    limit_fmc: float
    oracle_fmc: dict[int, float]
    cases: int
    figure: Path | None = None

    @property
    def truth_fmc(self) -> float:
        """Failure mode coverage of the truth, summed over the levels."""
        return _truth_fmc(self.truths)

    @property
    def is_small(self) -> bool:
        """Whether a truth is too small to be divided by."""
        return any_small(self.truths.values())

    @classmethod
    def of(
        cls,
        searches: Mapping[str, Sequence[Search]],
        truths: dict[int, Truth],
        dense: dict[int, Truth],
        cases: int,
        batch: int | None,
    ) -> SamplerStudy:
        """Compare searches of so many cases, by sampler, with the truths by level."""
        limit = limit_fmc(chain.from_iterable(searches.values()), truths, dense)
        summaries = {
            name: compare(of_name, truths, limit, dense) for name, of_name in searches.items()
        }
        return cls(summaries, truths, dense, limit, oracle(truths, cases, batch), cases)

    def to_record(self) -> dict[str, Any]:
        """Return what `--json` prints."""
        first = next(iter(self.samplers.values()))
        return {
            "truth_fmc": self.truth_fmc,
            "truth_too_small": self.is_small,
            "covered_of": sum(map(len, covered_of(self.truths, self.dense).values())),
            "limit_fmc": self.limit_fmc,
            "dense_levels": list(self.dense),
            "oracle_fmc_by_batch": [self.oracle_fmc[n] for n in first.cases_by_batch],
            **{name: asdict(result) for name, result in self.samplers.items()},
        }

    def lines(self) -> list[str]:
        """Return truth, limit and oracle, and a table of the samplers."""
        failures = sum(len(truth.failures) for truth in self.truths.values())
        tells = all(truth.tells_regions for truth in self.truths.values())
        real = sum(len(truth.real_regions()) for truth in self.truths.values())
        return [
            f"truth: FMC {self.truth_fmc:.4f}, {counted(failures, 'failure')}"
            + (f", {counted(real, 'region')}" if tells else ""),
            *(
                f"  at level {level_name(level)} it is {remark}"
                for level, truth in self.truths.items()
                for remark in truth.remarks()
            ),
            f"limit: FMC {self.limit_fmc:.4f}, {self._limit_is()}",
            f"oracle: FMC {self.oracle_fmc[self.cases]:.4f} with {self.cases} cases",
            *_table(self.samplers, small=self.is_small),
            *self._covered_is(),
            *([] if self.figure is None else [f"figure: {self.figure}"]),
        ]

    def _covered_is(self) -> list[str]:
        """Return of what the covered share is one, and the interval of each sampler's median."""
        failing = covered_of(self.truths, self.dense)
        if not failing:
            return []
        counts = [len(points) for points in failing.values()]
        errors = [
            math.sqrt(sum(_half_width(one.covered_share_median or 0.0, n) ** 2 for n in counts))
            / len(counts)
            for one in self.samplers.values()
        ]
        return [
            f"covered share: of {counted(sum(counts), 'failing uniform case')}, those within a "
            f"radius of a failure found; to within {max(errors):.2f} (95 %)"
        ]

    def _limit_is(self) -> str:
        if not self.dense:
            return "of all that truth and searches found (--dense runs 1,000,000 cases)"
        part = "" if len(self.dense) == len(self.truths) else " at some levels"
        return (
            f"of {DENSE_CASES:,} uniform cases{part}, or of all that was found, where that is more"
        )


def _half_width(share: float, n: int) -> float:
    """Return half the width of the 95 % interval of a binomial share (Wilson, 1927)."""
    z = 1.96
    return z / (1.0 + z**2 / n) * math.sqrt(share * (1.0 - share) / n + (z / (2.0 * n)) ** 2)


def _table(compared: Mapping[str, SamplerSummary], *, small: bool) -> list[str]:
    """Return a line per sampler: medians, with the quartiles in brackets.

    Nothing is divided by the FMC of a `small` truth.
    """
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False, caption=r"medians \[quartiles]", caption_justify="left")
    table.add_column("sampler")
    rows = {name: _columns(one, small=small) for name, one in compared.items()}
    for heading in next(iter(rows.values()), {}):
        table.add_column(heading, justify="right", no_wrap=True)
    for name, cells in rows.items():
        table.add_row(name, *cells.values())
    text = StringIO()
    # As wide as it is: a line of a table that is read by a program must not be broken.
    Console(width=220, highlight=False, soft_wrap=True, file=text).print(table)
    return [line.rstrip() for line in text.getvalue().splitlines()]


def _columns(one: SamplerSummary, *, small: bool) -> dict[str, str]:
    """Return the cells of a sampler by heading."""

    def cell(name: str, form: str) -> str:
        return _spread(getattr(one, f"{name}_median"), getattr(one, f"{name}_quartiles"), form)

    covered_share, sampler_s = cell("covered_share", ".3f"), f"{one.sampler_s_median:.2f}"
    if small:
        return {
            "covered share": covered_share,
            "50 % covered": cell("cases_to_50_percent_covered", ".0f"),
            "90 % covered": cell("cases_to_90_percent_covered", ".0f"),
            "FMC": cell("fmc", ".4f"),
            "failures": cell("failures", ".0f"),
            "sampler s": sampler_s,
        }
    return {
        "FMC / truth": cell("fmc_over_truth", ".3f"),
        "FMC / limit": cell("fmc_over_limit", ".3f"),
        "covered share": covered_share,
        "FMC": cell("fmc", ".4f"),
        "failures": cell("failures", ".0f"),
        "regions": cell("regions_found", ".1f"),
        "to 50 %": cell("cases_to_50_percent", ".0f"),
        "to 90 %": cell("cases_to_90_percent", ".0f"),
        "sampler s": sampler_s,
    }


def _spread(median: float | None, quartiles: Quartiles, form: str) -> str:
    median_text, low, high = (
        "-" if value is None else f"{value:{form}}" for value in (median, *quartiles)
    )
    return f"{median_text} [{low}, {high}]"
