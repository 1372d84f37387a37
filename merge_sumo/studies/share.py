"""The share of all starts that fail, by uniform cases that are none of the campaign's.

A search looks for failures, so the share of its cases that fail says nothing of the pool. By the
equations of motion thousands of uniform cases take less than a second; a share of them runs in
SUMO, too (`engine/kinematic_simulator.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Final

import numpy as np
from msgspec import Meta

from merge_sumo.campaigns.run import Run
from merge_sumo.engine.evaluate import CasesAt, Episodes, evaluate
from merge_sumo.engine.plan import SimulationPlan
from merge_sumo.errors import UserError
from merge_sumo.scenario.case import Pool
from merge_sumo.studies.study_file import StudyFile
from merge_sumo.system.records import Record
from merge_sumo.system.workers import Workers
from merge_sumo.verdict.chance import clopper_pearson

CASES: Final = 2000
"""Uniform cases of a level: 0 failures among them are less than .15 % of all starts."""
CONFIDENCE: Final = 0.95
STREAM: Final = 11
"""Key of the random stream, so that it is none of a sampler's."""
Count = Annotated[int, Meta(ge=0)]


class LevelShare(Record, frozen=True):
    """Uniform cases of a POV level, and how many of them fail."""

    level: Count
    cases: Count
    failures: Count

    @property
    def interval(self) -> tuple[float, float]:
        """The exact interval of the share; of no failure one-sided, from 0."""
        one_sided = 0.0 if self.failures else 1.0 - CONFIDENCE
        return clopper_pearson(self.failures, self.cases, CONFIDENCE - one_sided)

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


SHARES: Final = StudyFile("shares.json", Shares)


def note_shares(
    run: Run, plan: SimulationPlan, workers: Workers, check: Callable[[], None] = lambda: None
) -> None:
    """Measure the share that fails at each level of a campaign that has just ended.

    Nothing is written for drivers that need SUMO, where it takes long (`probability`), where a case
    ends otherwise in SUMO than by eq. (4), nor where one may fail in some of its runs. `check` is
    called after each level, and may raise.
    """
    if plan.needs_sumo is not None or run.tolerated or run.scenario.sense.is_random:
        return
    levels = []
    for level in run.levels:
        try:
            levels.append(share_at(plan, level, CASES, run.settings.seed, workers))
        except UserError:  # a rounding error turned a decision: eq. (4) alone does not tell
            return
        check()
    SHARES.write(run.folder, Shares(tuple(levels)))


def share_at(
    plan: SimulationPlan, level: int, cases: int, seed: int, workers: Workers | None = None
) -> LevelShare:
    """Return the share of uniform cases of a level that fail, by the equations of motion."""
    rng = np.random.default_rng([seed, STREAM, level])
    points = rng.random((cases, len(plan.scenario.dimensions(level))))
    pool = Pool(levels=(level,), scenario=plan.scenario)
    kinematic = plan.for_verdicts().with_engine(None)
    ran = evaluate(kinematic, CasesAt(pool, level, points), workers, fails_of)
    return LevelShare(level, cases, sum(fails for _, fails in ran))


def fails_of(results: Episodes) -> list[bool]:
    """Return of each result whether the case fails."""
    return [verdict.failed for verdict in results.verdicts()]
