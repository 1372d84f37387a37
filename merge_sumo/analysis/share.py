"""The share of all starts that fail, by uniform cases.

A search looks for failures, so the share of its cases that fail says nothing of the pool. By the
equations of motion thousands of uniform cases take less than a second; a share of them runs in
SUMO, too (`simulation/kinematic_simulator.py`). A controller of a user is asked step by step, and
takes as long without SUMO as in it: its cases run as those of the campaign do, in rounds, as many
as fit into a part of the time of the campaign. Where further cases would take long, those of a
campaign that drew its cases uniformly are counted.
"""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter
from typing import Annotated

import numpy as np
from msgspec import Meta

from merge_sumo.analysis.run_study import StudyFile
from merge_sumo.campaigns.run import Run
from merge_sumo.controllers.process import LOG
from merge_sumo.errors import UserError
from merge_sumo.metrics.outcome import Episode
from merge_sumo.metrics.summary import clopper_pearson, undecided
from merge_sumo.records import Record
from merge_sumo.scenario.case import Case, Pool
from merge_sumo.scenario.scenario import Scenario
from merge_sumo.simulation.evaluate import evaluate
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.workers import Workers, workers_or_here

CASES = 2000
"""Uniform cases of a level: 0 failures among them are less than .15 % of all starts."""
ROUND = 200
"""Uniform cases of a level that run at a time where they run in SUMO, and the least of them."""
PART = 0.2
"""Of the time of a campaign, for further rounds."""
CONFIDENCE = 0.95
STREAM = 11
"""Key of the random stream, so that it is none of a sampler's."""
Count = Annotated[int, Meta(ge=0)]


class LevelShare(Record, frozen=True):
    """Uniform cases of a POV level: how many fail, and how many are not judged.

    A case is not judged after an error, and where the VUT never reached the merge point.
    """

    level: Count
    cases: Count
    failures: Count
    without_verdict: Count = 0

    @property
    def interval(self) -> tuple[float, float]:
        """The exact interval of the share; of no failure one-sided, from 0.

        Cases without a verdict are safe for its lower end, and failures for the upper.
        """
        confidence = CONFIDENCE - (0.0 if self.failures else 1.0 - CONFIDENCE)
        most = self.failures + self.without_verdict
        low, _ = clopper_pearson(self.failures, self.cases, confidence)
        _, high = clopper_pearson(most, self.cases, confidence)
        return low, high

    @property
    def shown(self) -> str:
        """The share and its interval in percent."""
        low, high = map(_percent, self.interval)
        if not self.failures:
            return f"less than {high} %"
        return f"{_percent(self.failures / self.cases)} % [{low}, {high}]"


def _percent(share: float) -> str:
    return f"{100.0 * share:.{3 if share >= 0.1 else 2}g}"


class Shares(Record, frozen=True):
    """The share that fails at each level."""

    levels: tuple[LevelShare, ...]


SHARES = StudyFile("shares.json", Shares)


def own_shares(run: Run) -> list[LevelShare]:
    """Return the share of the cases of a campaign that fail; one that is undecided may fail.

    It holds for all starts where the campaign drew its cases uniformly.
    """
    unsure = undecided(run.outcomes, run.tolerated)
    shares = []
    for level in run.levels:
        cases = [outcome for outcome in run.cases if outcome.case.level == level]
        failures = sum(outcome.failed and outcome.index not in unsure for outcome in cases)
        unknown = sum(not outcome.is_tested or outcome.index in unsure for outcome in cases)
        shares.append(LevelShare(level, len(cases), failures, unknown))
    return shares


def note_shares(
    run: Run,
    plan: SimulationPlan,
    workers: Workers | None = None,
    took_s: float = 0.0,
    check: Callable[[], None] = lambda: None,
    on_part: Callable[[int, int], None] = lambda _done, _total: None,
) -> None:
    """Measure the share that fails at each level of a campaign that has just ended.

    Further cases do not run for drivers that ask SUMO, with which it takes long (`probability`),
    where one may fail in some of its runs, nor for a controller whose cases mostly end as errors.
    Nothing is written where a case ends otherwise in SUMO than by eq. (4). The cases of a campaign
    that drew them uniformly are such a measurement themselves, and are counted instead.

    Args:
        run: the campaign.
        plan: how it was run.
        workers: where its cases ran, and those of a user's controller run here, too.
        took_s: how long it took; cases in SUMO may take a part of that.
        check: called after each level, and may raise.
        on_part: told how many cases are done, and how many there are, from 0 on.
    """
    errors = sum(outcome.measures.end.is_error for outcome in run.outcomes)
    random = run.tolerated or run.scenario.sense.is_random
    if plan.asks_sumo or random or 2 * errors > len(run.outcomes):
        if run.settings.sampler == "uniform" and not run.settings.stop_when_converged:
            SHARES.write(run.folder, Shares(tuple(own_shares(run))))
        return
    by_equations = plan.needs_sumo is None
    size, budget_s = (CASES, 0.0) if by_equations else (ROUND, PART * took_s)
    # By the equations of motion where the drivers allow it, else in SUMO.
    plan = plan.for_verdicts().with_engine(None).with_log(run.folder.resolve() / LOG)
    streams = {level: stream(run.settings.seed, level) for level in run.levels}
    # Of each level: cases, failures, cases without a verdict.
    counts = {level: np.zeros(3, dtype=int) for level in run.levels}
    done, begun_s = 0, perf_counter()
    # Worker processes would take longer to start than the cases by the equations.
    with workers_or_here(None if by_equations else workers) as processes:
        while True:
            round_s = perf_counter()
            total = done + size * len(streams)
            for level, rng in streams.items():
                on_part(done, total)
                uniform = uniform_cases(plan.scenario, level, size, rng)
                try:
                    results = list(evaluate(plan, uniform, processes, end_of))
                except UserError:  # a rounding error turned a decision: eq. (4) alone does not tell
                    return
                counts[level] += (size, *np.sum(results, axis=0))
                done += size
                on_part(done, total)
                check()
            now_s = perf_counter()
            if now_s - begun_s + (now_s - round_s) > budget_s:
                break
    shares = [LevelShare(level, *known.tolist()) for level, known in counts.items()]
    SHARES.write(run.folder, Shares(tuple(shares)))


def stream(seed: int, level: int) -> np.random.Generator:
    """Return what draws the uniform cases of a level of a campaign with a seed."""
    return np.random.default_rng([seed, STREAM, level])


def uniform_cases(
    scenario: Scenario, level: int, count: int, rng: np.random.Generator
) -> list[Case]:
    """Return uniform cases of a level.

    Args:
        scenario: scenario of the cases.
        level: level of the POV.
        count: number of cases.
        rng: random generator.
    """
    points = rng.random((count, len(scenario.dimensions(level))))
    return Pool(levels=(level,), scenario=scenario).cases(points, level)


def end_of(episode: Episode) -> tuple[bool, bool]:
    """Return whether a case fails, and whether it is not judged."""
    return episode.outcome.failed, not episode.outcome.is_tested
