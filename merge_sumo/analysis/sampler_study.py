"""Comparison of samplers with each other and with the truth of a VUT, over several seeds."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import accumulate, chain, product
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
from merge_sumo.campaigns.loop import Batches, SearchLoop
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.controllers.in_memory import is_in_process
from merge_sumo.errors import UserError, notice
from merge_sumo.metrics.fmc import covered, fmc
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.records import to_plain
from merge_sumo.result import Result
from merge_sumo.samplers.registry import SAMPLERS, make_sampler
from merge_sumo.scenario.case import FloatArray, Pool, to_unit
from merge_sumo.scenario.scenario import level_name
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.workers import Workers

MOST_PROBES = 10_000
"""Maximum number of failures of which a share is covered: its error is then below .01."""
COMPARED_BATCH = 20
"""Cases of a batch of a sampler without a size of its own, as in Table II."""

Task = tuple[str, int]
"""A search: the name of the sampler, and its seed."""


@dataclass(frozen=True, slots=True)
class SamplerRun:
    """A search of one sampler with one seed.

    Attributes:
        outcomes: the outcomes in order.
        fmc: failure mode coverage after each batch, summed over the levels.
    """

    outcomes: list[Outcome]
    fmc: list[float]

    def failures(self, level: int) -> FloatArray:
        """Return the failing cases of a level as points of the unit cube, (m, d).

        Args:
            level: level of the POV.
        """
        cases = []
        for one in self.outcomes:
            if one.failed and one.case.level == level:
                cases.append(one.case)
        return to_unit(cases, level)


def search(
    plan: SimulationPlan,
    levels: tuple[int, ...],
    cases: int,
    batch: int | None,
    tasks: Sequence[Task],
) -> list[SamplerRun]:
    """Run searches in this process.

    Args:
        plan: how their cases run.
        levels: POV levels.
        cases: number of cases of a search.
        batch: cases of a batch; None for those of the sampler, or `COMPARED_BATCH`.
        tasks: name of the sampler and seed of each search.

    Returns:
        The searches, in the order of `tasks`.
    """
    searches = []
    pool = Pool(levels=levels, scenario=plan.scenario)
    for name, seed in tasks:
        sampler = make_sampler(name, pool, seed, controller_model_of(plan, pool, seed))
        size = batch or (None if sampler.uses_predictions else COMPARED_BATCH)
        batches: Batches = []
        SearchLoop(sampler, plan, cases, batch=size).run(batches.extend)
        found = SamplerRun([], [])
        for episodes in batches:
            found.outcomes.extend(episode.outcome for episode in episodes)
            found.fmc.append(sum(fmc(found.failures(level)) for level in levels))
        searches.append(found)
    return searches


def _lost_search(task: Task) -> SamplerRun:
    raise UserError(f"the process of the search of {task[0]} with seed {task[1]} ended each time")


def names_of(options: config.Benchmark) -> list[str]:
    """Return the names of the samplers to compare, each once.

    Args:
        options: options of the verb.

    Raises:
        UserError: for no name, or no seeds.
    """
    known = SAMPLERS if options.samplers is None else options.samplers
    listed = known.split(",") if isinstance(known, str) else known
    names = list(dict.fromkeys(map(str.strip, listed)))
    if not names:
        raise UserError(f"name at least one sampler: {', '.join(SAMPLERS)}")
    check_least(options, seeds=1, truth_cases=1)
    return names


def title(vut: str, levels: Sequence[int]) -> str:
    """Return the title of searches.

    Args:
        vut: spec of the VUT.
        levels: levels of the POV.
    """
    return f"{vut} v level {'/'.join(map(level_name, levels))}"


@dataclass(frozen=True, slots=True)
class Study:
    """A plan, and how truths and searches of it run.

    Example:
        study = Study(plan)
        searches = study.searches((0,), ["uniform"], config.Benchmark("design1", seeds=3))

    Attributes:
        plan: how cases run.
        workers: where they run; by default in this process.
        cache: folder of the truths; None for that of the user.
        on_part: called with the progress of each truth, and of all searches together.
        engine: engine of the truths, as in `SimulationPlan.with_engine`.
    """

    plan: SimulationPlan
    workers: Workers = field(default_factory=Workers)
    cache: Path | None = None
    on_part: OnPart = lambda *_: None
    engine: str | None = None

    def truth(self, level: int, cases: int | None = None, seed: int = 0) -> Truth:
        """Return the truth at a level, from the cache where it is kept.

        Args:
            level: level of the POV.
            cases: number of cases; None for that of the paper.
            seed: seed of the cases.
        """
        total = TRUTH_CASES[level] if cases is None else cases
        name = f"truth of {self.plan.vut.spec} at level {level_name(level)}"

        def on_case(ended: int) -> None:
            self.on_part(name, ended, total, "cases", "")

        plan = self.plan.at_level(level).with_engine(self.engine)
        return ground_truth(
            plan, level, total, seed, workers=self.workers, cache=self.cache, on_case=on_case
        )

    def truths(self, settings: CampaignSettings, options: config.GroundTruth) -> TruthResult:
        """Return the truth of settings at each of their levels.

        Args:
            settings: the settings.
            options: numbers of cases and the seed.

        Raises:
            UserError: for numbers that are too small.
        """
        check_least(options, cases=1, seed=0)
        by_level = {}
        for level in settings.levels:
            by_level[level] = self.truth(level, options.cases, options.seed)
        if not self.plan.vut.files_are_known and not is_in_process(settings.vut):
            notice(
                "merge-sumo cannot tell which files the program of this VUT loads: it reuses this "
                "truth until the command or a file named in it changes"
            )
        return TruthResult(settings.vut, by_level, settings.criterion, settings.scenario)

    def compare(
        self, levels: tuple[int, ...], samplers: Sequence[str], options: config.Benchmark
    ) -> SamplerStudy:
        """Let each sampler search with the seeds 0, 1, ..., and compare it with the truths.

        A dense truth is used where the cache has one.

        Args:
            levels: levels of the POV.
            samplers: names of the samplers.
            options: options of the verb.

        Returns:
            The searches, and the truth of each level.
        """
        truths, dense = {}, {}
        for level in levels:
            truths[level] = self.truth(level, options.truth_cases)
            plan = self.plan.at_level(level).with_engine(self.engine)
            truth = known_truth(plan, level, DENSE_CASES, cache=self.cache)
            if truth is not None:
                dense[level] = truth
        return SamplerStudy(self.searches(levels, samplers, options), truths, dense)

    def searches(
        self, levels: tuple[int, ...], samplers: Sequence[str], options: config.Benchmark
    ) -> dict[str, list[SamplerRun]]:
        """Let each sampler search with each seed.

        Args:
            levels: levels of the POV.
            samplers: names of the samplers.
            options: numbers of seeds and cases, and cases of a batch.

        Returns:
            The searches of each sampler, in the order of the seeds.
        """
        plan = self.plan.for_cases(options.batch or COMPARED_BATCH)
        name = title(str(plan.vut.spec), levels)
        tasks = list(product(samplers, range(options.seeds)))
        run_some = partial(search, plan, levels, options.cases, options.batch)
        ran = self.workers.run(run_some, tasks, _lost_search, chunk=1)
        found: dict[str, list[SamplerRun]] = defaultdict(list)
        for number, ((sampler, _), one) in enumerate(zip(tasks, ran, strict=True), start=1):
            found[sampler].append(one)
            self.on_part(name, number, len(tasks), "runs", sampler)
        return found


@dataclass(frozen=True, slots=True)
class Spread:
    """Median and quartiles over the seeds.

    Attributes:
        median: the median; None where too few seeds have a number.
        low: the lower quartile, likewise.
        high: the upper quartile, likewise.
    """

    median: float | None
    low: float | None
    high: float | None

    @classmethod
    def of(cls, values: ArrayLike) -> Spread:
        """Return the spread of a number over the seeds.

        Args:
            values: the number for each seed, (seeds,); NaN or infinity for none.
        """
        missing = 1e300  # larger than any number, and finite for the interpolation
        known = np.nan_to_num(np.asarray(values, dtype=float), nan=missing, posinf=missing)
        quantiles: list[float | None] = []
        for value in np.quantile(known, (0.5, 0.25, 0.75)).tolist():
            quantiles.append(value if value < 1e-9 * missing else None)
        return cls(*quantiles)


@dataclass(frozen=True, slots=True)
class SamplerSummary:
    """The results of one sampler over all seeds; FMC is summed over the levels.

    Attributes:
        fmc: failure mode coverage.
        fmc_over_truth: FMC divided by the FMC of the truth; None if the truth is too small.
        fmc_over_limit: FMC divided by `SamplerStudy.limit_fmc`.
        covered_share: share of the failures of the truth that lie within a radius of a failure of
            the search; the mean over the levels with failures.
        failures: number of failures found.
        regions_found: number of regions of the truth in which the search found a failure; None if
            the truth is too small for regions.
        cases_to_90_percent: number of cases until 90 % of the FMC of the truth.
        cases_by_batch: number of cases after each batch.
        fmc_by_batch: quartiles of FMC after each batch, at 25, 50 and 75 %.
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


@dataclass(frozen=True, repr=False)
class SamplerStudy(Result):
    """The comparison of samplers with each other and with the ground truth.

    `ms.benchmark` returns it.

    Example:
        ```python
        study = ms.benchmark("design1", level=0, seeds=3)
        print(study.samplers["coverage"].fmc.median)
        ```

    Attributes:
        searches: the searches of each sampler, one for each seed.
        truths: the truth of each POV level.
        dense: the dense truth (1,000,000 cases) of the levels that have one.
        figure: file of the figure, if there is one.
    """

    searches: dict[str, list[SamplerRun]]
    truths: dict[int, Truth]
    dense: dict[int, Truth] = field(default_factory=dict)
    figure: Path | None = None

    @cached_property
    def truth_fmc(self) -> float:
        """FMC (failure mode coverage) of the truth, summed over the levels."""
        return sum(fmc(truth.failures) for truth in self.truths.values())

    @property
    def is_small(self) -> bool:
        """Whether a truth is too small to give shares and regions."""
        return any(truth.is_small for truth in self.truths.values())

    @cached_property
    def regions(self) -> list[tuple[int, FloatArray]] | None:
        """Level and points (m, d) of each region of the truths; None if a truth is too small."""
        if self.is_small:
            return None
        found = []
        for level, truth in self.truths.items():
            found += [(level, region) for region in truth.real_regions()]
        return found

    @cached_property
    def limit_fmc(self) -> float:
        """FMC of all known failures, summed over the levels: the upper limit of a search.

        A truth of a few thousand cases misses failures that searches find. At each level the limit
        is the FMC of the failures of truth and searches together, or of a dense truth if that is
        larger.
        """
        total = 0.0
        for level, truth in self.truths.items():
            found = [one.failures(level) for one in chain.from_iterable(self.searches.values())]
            known = np.concatenate([truth.failures, *filter(len, found)])
            total += max(fmc(known), fmc(self.dense.get(level, truth).failures))
        return total

    @cached_property
    def probes(self) -> dict[int, FloatArray]:
        """The failures that `covered_share` counts, by level, as points (m, d).

        They come from the dense truth if there is one: more failures give a smaller error.
        """
        points = {}
        for level, truth in self.truths.items():
            failing = self.dense.get(level, truth).failures
            if len(failing):
                points[level] = failing[:MOST_PROBES]
        return points

    @cached_property
    def samplers(self) -> dict[str, SamplerSummary]:
        """The summary of each sampler, by its name."""
        return {name: self._summary(searches) for name, searches in self.searches.items()}

    def _summary(self, searches: Sequence[SamplerRun]) -> SamplerSummary:
        curves = np.array([search.fmc for search in searches])
        truth_fmc = math.nan if self.is_small else self.truth_fmc or math.nan
        by_batch = Counter(outcome.batch for outcome in searches[0].outcomes)
        after = list(accumulate(by_batch.values()))
        covered_share: list[float] = []
        failures: list[float] = []
        regions_found: list[float] = []
        cases_to_90_percent: list[float] = []
        for row, search in enumerate(searches):
            failures.append(sum(outcome.failed for outcome in search.outcomes))
            reached = np.flatnonzero(curves[row] >= 0.9 * truth_fmc)
            cases_to_90_percent.append(after[reached[0]] if len(reached) else math.inf)
            of_levels = []
            for level, points in self.probes.items():
                of_levels.append(covered(points, search.failures(level)).mean())
            covered_share.append(np.mean(of_levels) if of_levels else math.nan)
            found = math.nan if self.regions is None else 0.0
            for level, region in self.regions or ():
                found += bool(covered(search.failures(level), region).any())
            regions_found.append(found)
        return SamplerSummary(
            fmc=Spread.of(curves[:, -1]),
            fmc_over_truth=Spread.of(curves[:, -1] / truth_fmc),
            fmc_over_limit=Spread.of(curves[:, -1] / (self.limit_fmc or math.nan)),
            covered_share=Spread.of(covered_share),
            failures=Spread.of(failures),
            regions_found=Spread.of(regions_found),
            cases_to_90_percent=Spread.of(cases_to_90_percent),
            cases_by_batch=after,
            fmc_by_batch=np.quantile(curves, (0.25, 0.5, 0.75), axis=0).tolist(),
        )

    def to_record(self) -> dict[str, Any]:
        """Return the object that `--json` prints."""
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
