"""Running the cases of a certificate: points of a level's unit cube in, verdicts out."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.engine.evaluate import CaseResult, CasesAt, evaluate
from merge_sumo.engine.plan import SimulationPlan
from merge_sumo.system.workers import Workers
from merge_sumo.values.case import Case, FloatArray
from merge_sumo.vuts.files import Files
from merge_sumo.vuts.output import LOG


class CheckedCase(NamedTuple):
    """What became of a case: its coordinates as they were run, and the verdict.

    `told` is whether there was one: the VUT reached the merge point, or failed.
    """

    case: tuple[float, ...]
    score: float
    failed: bool
    told: bool
    files: Files


RunPoints = Callable[[int, FloatArray], Iterable[tuple[int, CheckedCase]]]
"""Runs the cases at points, (n, d), of a level's unit cube; gives (place, result) in any order."""


def runs_points_on(
    workers: Workers, settings: CampaignSettings, plan: SimulationPlan, folder: Path
) -> RunPoints:
    """Return what runs points on workers; what a controller prints goes to the folder's log."""
    plan = plan.with_log(folder.resolve() / LOG)

    def run(level: int, points: FloatArray) -> Iterable[tuple[int, CheckedCase]]:
        return evaluate(plan, CasesAt(settings.pool, level, points), workers, _checked)

    return run


def _checked(results: Sequence[CaseResult]) -> list[CheckedCase]:
    # One dictionary for a chunk: it travels once.
    files = results[0].files | results[0].pov_files
    return [_result(done, files) for done in results]


def _result(done: CaseResult, files: Files) -> CheckedCase:
    """Return what a certificate keeps of a case, by the criterion of the plan."""
    outcome = done.outcome(0)
    score = math.nan if outcome.score is None else outcome.score
    return CheckedCase(_values(outcome.case), score, outcome.failed, outcome.is_tested, files)


def _values(case: Case) -> tuple[float, ...]:
    return tuple(getattr(case, d.field) for d in case.scenario.dimensions(case.level))
