"""Samplers beside each other and beside the truth of a VUT: searches with many seeds."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import accumulate, chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from merge_sumo import config
from merge_sumo.analysis.run_study import OnPart, check_least
from merge_sumo.analysis.truth import (
    DENSE_CASES,
    TRUTH_CASES,
    Truth,
    TruthResult,
    ground_truth,
    known_truth,
)
from merge_sumo.campaigns.campaign import controller_model_of
from merge_sumo.campaigns.loop import Groups, SearchLoop
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.controllers.in_memory import is_here
from merge_sumo.errors import UserError, notice
from merge_sumo.metrics.fmc import covered, fmc
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.records import to_plain
from merge_sumo.result import Result
from merge_sumo.samplers.registry import SAMPLERS, make_sampler
from merge_sumo.scenario.case import FloatArray, Pool, to_unit
from merge_sumo.scenario.scenario import level_name
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.workers import Workers, workers_or_here

MOST_PROBES = 10_000
"""Failures of a truth of which a covered share is one, at most: its error is then below .01."""
COMPARED_BATCH = 20
"""Cases of a batch by default, of samplers that choose none: that of Table II."""


@dataclass(frozen=True, slots=True)
class SamplerRun:
    """What one sampler did with one seed.

    Attributes:
        outcomes: what became of every case, in order.
        fmc: failure mode coverage after each batch, summed over the levels.
    """

    outcomes: list[Outcome]
    fmc: list[float]

    def failures(self, level: int) -> FloatArray:
        """Return the failing cases of a level as points, (m, d)."""
        return to_unit((o.case for o in self.outcomes if o.failed and o.case.level == level), level)

    def covered_shares(self, level: int, points: FloatArray) -> FloatArray:
        """Return the share of points, (m, d), that its failures cover after each batch."""
        failed = [o.batch for o in self.outcomes if o.failed and o.case.level == level]
        batches, places = np.array(failed, dtype=int), self.failures(level)
        numbers = np.unique([outcome.batch for outcome in self.outcomes])
        first = np.full(len(points), np.inf)
        for number in numbers[::-1]:
            first[covered(points, places[batches == number])] = number
        return np.array([(first <= number).mean() for number in numbers])


@dataclass(frozen=True, slots=True)
class Task:
    """A search of the pool of a plan's scenario.

    Attributes:
        name: the sampler.
        levels: POV levels.
        cases: number of cases.
        batch: cases of a batch; None for those of the sampler, or `COMPARED_BATCH`.
        seed: of the sampler.
    """

    name: str
    levels: tuple[int, ...]
    cases: int
    batch: int | None
    seed: int


def search(plan: SimulationPlan, tasks: Sequence[Task]) -> list[SamplerRun]:
    """Run searches in this process."""
    found = []
    for task in tasks:
        pool = Pool(levels=task.levels, scenario=plan.scenario)
        model = controller_model_of(plan, pool, task.seed)
        sampler, ran = make_sampler(task.name, pool, task.seed, model), SamplerRun([], [])
        batch = task.batch or (None if sampler.uses_predictions else COMPARED_BATCH)
        groups: Groups = []
        SearchLoop(sampler, plan, task.cases, batch=batch).run(groups.extend)
        for group in groups:
            ran.outcomes.extend(episode.outcome for episode in group)
            ran.fmc.append(sum(fmc(ran.failures(level)) for level in task.levels))
        found.append(ran)
    return found


def _lost_search(task: Task) -> SamplerRun:
    raise UserError(
        f"the search of {task.name} with seed {task.seed} ended its worker process each time"
    )


def names_of(asked: config.Benchmark) -> list[str]:
    """Return the names of the samplers that are compared; `UserError` for none, or no seeds."""
    known = SAMPLERS if asked.samplers is None else asked.samplers
    listed = known.split(",") if isinstance(known, str) else known
    names = list(dict.fromkeys(map(str.strip, listed)))
    if not names:
        raise UserError(f"name at least one sampler: {', '.join(SAMPLERS)}")
    check_least(asked, seeds=1)
    return names


def title(vut: str, levels: Sequence[int]) -> str:
    """Return what searches are called."""
    return f"{vut} v level {'/'.join(map(level_name, levels))}"


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

    def truth(self, level: int, cases: int | None = None, seed: int = 0) -> Truth:
        """Return the truth at a level, from the cache where it is kept.

        Args:
            level: level of the POV.
            cases: number of cases; by default that of the study.
            seed: seed of the cases.
        """
        total, ended = TRUTH_CASES[level] if cases is None else cases, 0
        title = f"truth of {self.plan.vut.spec} at level {level_name(level)}"

        def ran(more: int) -> None:
            nonlocal ended
            ended += more
            self.on_part(title, ended, total, "cases", "")

        plan = self.plan.at_level(level).with_engine(self.engine)
        where: dict[str, Any] = {"workers": self.workers, "cache": self.cache, "on_cases": ran}
        return ground_truth(plan, level, total, seed, **where)

    def truths(self, settings: CampaignSettings, asked: config.GroundTruth) -> TruthResult:
        """Return the truth of settings at each of their levels."""
        by_level = {level: self.truth(level, asked.cases, asked.seed) for level in settings.levels}
        if not self.plan.vut.files_are_known and not is_here(settings.vut):
            notice(
                "nobody can tell what the program behind this VUT loads; this truth is kept "
                "for its command and the files that are named there"
            )
        return TruthResult(settings.vut, by_level, settings.criterion, settings.scenario)

    def compare(
        self, levels: tuple[int, ...], samplers: Sequence[str], asked: config.Benchmark
    ) -> SamplerStudy:
        """Let each sampler search with the seeds 0, 1, ... beside the truth of each level.

        A dense truth is used where the cache has one.

        Args:
            levels: levels of the POV.
            samplers: names of the samplers.
            asked: options of the verb.
        """
        truths = {level: self.truth(level, asked.truth_cases) for level in levels}
        kept = {one: known_truth(self.plan, one, DENSE_CASES, cache=self.cache) for one in levels}
        dense = {level: truth for level, truth in kept.items() if truth is not None}
        searches = self.searches(levels, samplers, asked.seeds, asked.cases, asked.batch)
        return SamplerStudy(searches, truths, dense)

    def searches(
        self,
        levels: tuple[int, ...],
        samplers: Sequence[str],
        seeds: int,
        cases: int,
        batch: int | None,
    ) -> dict[str, list[SamplerRun]]:
        """Let each sampler search with each seed; return the searches by sampler.

        Args:
            levels: levels of the POV.
            samplers: names of the samplers.
            seeds: number of seeds.
            cases: cases of a search.
            batch: cases of a batch; None for the wish of the sampler.
        """
        numbers = range(seeds)
        tasks = [Task(name, levels, cases, batch, seed) for name in samplers for seed in numbers]
        for level in levels:
            self.plan.povs.check_level(level)
        plan = self.plan.for_cases(batch or COMPARED_BATCH)
        shown = title(str(plan.vut.spec), levels)
        with workers_or_here(self.workers) as processes:
            searches = processes.run(partial(search, plan), tasks, _lost_search, chunk=1)
            found: dict[str, list[SamplerRun]] = {name: [] for name in samplers}
            for number, (task, one) in enumerate(zip(tasks, searches, strict=True), start=1):
                found[task.name].append(one)
                self.on_part(shown, number, len(tasks), "runs", task.name)
        return found


@dataclass(frozen=True, slots=True)
class Spread:
    """The median over the seeds, and the quartiles; None where too few seeds have a number."""

    median: float | None
    low: float | None
    high: float | None

    @classmethod
    def of(cls, values: ArrayLike) -> Spread:
        """Return the spread of a number for each seed; NaN and infinite ones are none."""
        ordered = np.sort(np.asarray(values, dtype=np.float64))  # NaN comes last

        def quantile(part: float) -> float | None:
            place = part * (len(ordered) - 1)
            low, high = ordered[math.floor(place)], ordered[math.ceil(place)]
            return float(low + place % 1.0 * (high - low)) if np.isfinite(high) else None

        return cls(quantile(0.5), quantile(0.25), quantile(0.75))


@dataclass(frozen=True, slots=True)
class SamplerSummary:
    """One sampler over all seeds; FMC is summed over the levels.

    Attributes:
        fmc: failure mode coverage.
        fmc_over_truth: as a share of the truth's; None where that is too small.
        fmc_over_limit: as a share of all that is known to fail.
        covered_share: share of the truth's failures within a radius of a failure found, the mean
            over the levels with any.
        failures: failures found.
        regions_found: regions of the truth in which a failure was found; None where the truth
            is too small to tell regions.
        cases_to_90_percent: cases until .9 of the truth's FMC.
        cases_by_batch: cases after each batch.
        fmc_by_batch: quartiles of FMC after each batch, at 25, 50 and 75 %.
        covered_share_by_batch: median of the covered share after each batch; None without failures.
    """

    fmc: Spread
    fmc_over_truth: Spread
    fmc_over_limit: Spread
    covered_share: Spread
    failures: Spread
    regions_found: Spread
    cases_to_90_percent: Spread
    cases_by_batch: list[int]
    fmc_by_batch: list[list[float]]
    covered_share_by_batch: list[float] | None


@dataclass(frozen=True, repr=False)
class SamplerStudy(Result):
    """Samplers beside each other, and beside the ground truth, over several seeds.

    Attributes:
        searches: the searches of each sampler, one a seed.
        truths: the truth by level.
        dense: the dense truth of the levels that have one.
        figure: file that was drawn, if any.
    """

    searches: dict[str, list[SamplerRun]]
    truths: dict[int, Truth]
    dense: dict[int, Truth] = field(default_factory=dict)
    figure: Path | None = None

    @cached_property
    def truth_fmc(self) -> float:
        """Failure mode coverage of the truth, summed over the levels."""
        return sum(fmc(truth.failures) for truth in self.truths.values())

    @property
    def is_small(self) -> bool:
        """Whether a truth is too small to be divided by."""
        return any(truth.is_small for truth in self.truths.values())

    @cached_property
    def regions(self) -> list[tuple[int, FloatArray]] | None:
        """Level and points of each region of the truths; None where one cannot tell regions."""
        if not all(truth.tells_regions for truth in self.truths.values()):
            return None
        return [(one, region) for one, t in self.truths.items() for region in t.real_regions()]

    @cached_property
    def limit_fmc(self) -> float:
        """Coverage of all that is known to fail, summed over the levels: no search has more.

        A truth of a few thousand cases misses places that searches find. At each level this is the
        coverage of what truth and searches found together, or of a dense truth, if that is more.
        """
        known, total = list(chain.from_iterable(self.searches.values())), 0.0
        for level, truth in self.truths.items():
            failing = [truth.failures, *(search.failures(level) for search in known)]
            failing = [points for points in failing if len(points)] or failing[:1]
            dense = fmc(self.dense[level].failures) if level in self.dense else 0.0
            total += max(fmc(np.concatenate(failing)), dense)
        return total

    @cached_property
    def probes(self) -> dict[int, FloatArray]:
        """The failing uniform cases of which the covered share is one, by level.

        They are those of the dense truth where there is one: the more, the smaller the error.
        """
        points = {one: self.dense.get(one, truth).failures for one, truth in self.truths.items()}
        return {level: failing[:MOST_PROBES] for level, failing in points.items() if len(failing)}

    @cached_property
    def samplers(self) -> dict[str, SamplerSummary]:
        """What each sampler found."""
        return {name: self._summary(searches) for name, searches in self.searches.items()}

    def _summary(self, searches: Sequence[SamplerRun]) -> SamplerSummary:
        """Return what one sampler found, one search a seed."""
        curves = np.array([search.fmc for search in searches])
        divisor = math.nan if self.is_small else self.truth_fmc or math.nan
        after = list(accumulate(Counter(o.batch for o in searches[0].outcomes).values()))
        reached = curves >= (0.9 * divisor)
        regions_found = [
            math.nan
            if self.regions is None
            else sum(bool(covered(s.failures(one), place).any()) for one, place in self.regions)
            for s in searches
        ]
        shares = np.full(curves.shape, np.nan)
        if self.probes:
            for row, search in zip(shares, searches, strict=True):
                of_levels = [search.covered_shares(one, at) for one, at in self.probes.items()]
                row[:] = np.mean(of_levels, axis=0)
        return SamplerSummary(
            fmc=Spread.of(curves[:, -1]),
            fmc_over_truth=Spread.of(curves[:, -1] / divisor),
            fmc_over_limit=Spread.of(curves[:, -1] / (self.limit_fmc or math.nan)),
            covered_share=Spread.of(shares[:, -1]),
            failures=Spread.of([sum(o.failed for o in one.outcomes) for one in searches]),
            regions_found=Spread.of(regions_found),
            cases_to_90_percent=Spread.of(
                np.where(reached.any(axis=1), np.array(after)[reached.argmax(axis=1)], np.inf)
            ),
            cases_by_batch=after,
            fmc_by_batch=np.quantile(curves, (0.25, 0.5, 0.75), axis=0).tolist(),
            covered_share_by_batch=np.median(shares, axis=0).tolist() if self.probes else None,
        )

    def to_record(self) -> dict[str, Any]:
        """Return what `--json` prints."""
        return {
            "truth_fmc": self.truth_fmc,
            "truth_failures": sum(len(truth.failures) for truth in self.truths.values()),
            "truth_regions": None if self.regions is None else len(self.regions),
            "truth_too_small": self.is_small,
            "covered_of": sum(map(len, self.probes.values())),
            "limit_fmc": self.limit_fmc,
            "dense_fmc": {level: fmc(truth.failures) for level, truth in self.dense.items()},
            "samplers": to_plain(self.samplers),
        }
