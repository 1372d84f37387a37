"""Running the cases of a certificate: points of a level's unit cube in, verdicts out."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np

from merge_sumo.campaigns.plan import plan_of
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.engine.simulator import CaseResult, SimulationPlan, run_cases
from merge_sumo.road.corridor import Corridor
from merge_sumo.system.workers import Workers
from merge_sumo.values.case import Case, FloatArray, Pool
from merge_sumo.values.score import Outcome
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
    workers: Workers, settings: CampaignSettings, net: Corridor, folder: Path
) -> RunPoints:
    """Return what runs points on workers; what a controller prints goes to the folder's log."""
    plan = plan_of(settings, net, log=folder.resolve() / LOG)

    def run(level: int, points: FloatArray) -> Iterable[tuple[int, CheckedCase]]:
        pool, rows = settings.pool, cast("Sequence[FloatArray]", points)

        def lost(point: FloatArray) -> CheckedCase:
            case = pool.cases(np.asarray(point)[None], level)[0]
            return CheckedCase(_values(case), math.nan, failed=False, told=False, files={})

        return workers.run(partial(_run, plan, pool, level), rows, lost)

    return run


def _run(
    plan: SimulationPlan, pool: Pool, level: int, points: Sequence[FloatArray]
) -> Sequence[CheckedCase]:
    ran = run_cases(plan, pool.cases(np.asarray(points), level))
    # One dictionary for a chunk: it travels once.
    files = ran[0].files | ran[0].pov_files if ran else {}
    return [_result(done, files) for done in ran]


def _result(done: CaseResult, files: Files) -> CheckedCase:
    """Return what a certificate keeps of a case, by the criterion of the plan."""
    case = done.trajectory.case
    outcome = Outcome(0, 0, case, done.measures, margin=done.margin)
    score = math.nan if outcome.score is None else outcome.score
    return CheckedCase(_values(case), score, outcome.failed, outcome.is_tested, files)


def _values(case: Case) -> tuple[float, ...]:
    return tuple(getattr(case, d.field) for d in case.scenario.dimensions(case.level))
