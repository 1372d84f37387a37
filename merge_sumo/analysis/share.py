"""The share of all starts that fail, by uniform cases.

A search looks for failures, so the share of its own cases that fail is not that of the pool.
"""

# By the equations of motion thousands of uniform cases take less than a second. A controller of a
# user takes as long without SUMO as in it: it drives fewer cases, in SUMO.

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from typing import Annotated

import numpy as np
from msgspec import Meta

from merge_sumo.analysis.run_study import RunStudy, StudyFile, end_of
from merge_sumo.campaigns.recorded import RecordedCampaign
from merge_sumo.controllers.process import LOG
from merge_sumo.errors import UserError
from merge_sumo.metrics.summary import clopper_pearson, summarise
from merge_sumo.records import Record
from merge_sumo.scenario.case import Case, from_unit
from merge_sumo.scenario.scenario import Scenario
from merge_sumo.simulation.evaluate import evaluate
from merge_sumo.workers import Workers

CASES = 2000
"""Uniform cases of a level: 0 failures among them are less than .15 % of all starts."""
CASES_IN_SUMO = 200
"""Uniform cases of a level where they run in SUMO."""
CONFIDENCE = 0.95
STREAM = 11
"""Key of the random stream, which no sampler uses."""
Count = Annotated[int, Meta(ge=0)]


class LevelShare(Record, frozen=True):
    """Uniform cases of a POV level, and how many of them fail.

    Attributes:
        level: level of the POV.
        cases: number of cases.
        failures: number of those that fail.
        without_verdict: number of those without a verdict: after an error, and where the VUT never
            reached the merge point.
    """

    level: Count
    cases: Count
    failures: Count
    without_verdict: Count = 0

    @property
    def interval(self) -> tuple[float, float]:
        """The exact interval of the share, from 0 to 1; one-sided without failures.

        Cases without a verdict count as safe for its lower end, and as failures for its upper end.
        """
        confidence = CONFIDENCE if self.failures else 2.0 * CONFIDENCE - 1.0
        return clopper_pearson(self.failures, self.cases, confidence, self.without_verdict)

    @property
    def shown(self) -> str:
        """The share and its interval in percent."""
        low, high = map(_percent, self.interval)
        if not self.failures:
            return f"< {high} %"
        return f"{_percent(self.failures / self.cases)} %  ({low} to {high})"


def _percent(share: float) -> str:
    digits = 1 if share < 0.001 else 2 if share < 0.1 else 3
    return f"{100.0 * share:.{digits}g}"


class Shares(Record, frozen=True):
    """The share of starts that fail.

    Attributes:
        levels: the shares, one for each level.
    """

    levels: tuple[LevelShare, ...]


SHARES = StudyFile("shares.json", Shares)


def own_shares(run: RecordedCampaign) -> list[LevelShare]:
    """Return the share of the cases of a campaign that fail, for each level.

    It is that of all starts where the campaign drew its cases uniformly. An undecided case has no
    verdict.

    Args:
        run: the campaign.
    """
    shares = []
    for level, found in summarise(run.outcomes, run.levels, run.tolerated).levels.items():
        without_verdict = found.cases - found.tested + found.undecided
        shares.append(LevelShare(level, found.cases, found.failures, without_verdict))
    return shares


def write_shares(study: RunStudy, on_part: Callable[[int, int], None]) -> None:
    """Measure the share that fails at each level of a campaign that has just ended, and write it.

    The cases of a campaign that drew them uniformly are counted where further ones take long or
    decide nothing: for drivers that ask SUMO, where a case may fail in some of its runs, and where
    most cases end as errors. Of other such campaigns nothing is written.

    Args:
        study: the campaign, and how its cases run.
        on_part: called with the number of cases that are done, and of all; may raise.
    """
    run, plan = study.run, study.plan
    errors = sum(outcome.measures.end.is_error for outcome in run.outcomes)
    random = run.tolerated or run.scenario.sense.is_random
    if plan.asks_sumo or random or 2 * errors > len(run.outcomes):
        if run.settings.sampler == "uniform" and not run.settings.stop_when_converged:
            SHARES.write(run.folder, Shares(tuple(own_shares(run))))
        return
    by_equations = plan.needs_sumo is None
    count = CASES if by_equations else CASES_IN_SUMO
    plan = plan.for_verdicts().with_engine(None).with_log(run.folder.resolve() / LOG)
    shares: list[LevelShare] = []
    # Worker processes would take longer to start than the cases by the equations of motion.
    with Workers() if by_equations else nullcontext(study.workers) as workers:
        for level in run.levels:
            cases = uniform_cases(plan.scenario, level, count, run.settings.seed)
            try:
                ended = list(evaluate(plan, cases, workers, end_of))
            except UserError:  # eq. (4) and SUMO disagree, as a rounding error turned a decision
                return
            failures, tested, _ = np.sum(ended, axis=0).tolist()
            shares.append(LevelShare(level, count, failures, count - tested))
            on_part(len(shares) * count, len(run.levels) * count)
    SHARES.write(run.folder, Shares(tuple(shares)))


def uniform_cases(scenario: Scenario, level: int, count: int, seed: int) -> list[Case]:
    """Return uniform cases of a level, which no sampler draws.

    Args:
        scenario: scenario of the cases.
        level: level of the POV.
        count: number of cases.
        seed: seed of the campaign.
    """
    rng = np.random.default_rng([seed, STREAM, level])
    points = rng.random((count, len(scenario.dimensions(level))))
    return from_unit(points, level, scenario=scenario)
