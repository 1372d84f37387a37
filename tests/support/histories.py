"""Outcomes without motions, one by one and of a level as arrays."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from merge_sumo.metrics.measures import Measures
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.samplers.history import LevelHistory
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import US23
from merge_sumo.scenario.trajectory import End

FloatArray = np.ndarray
CASE = Case(level=0, x_pov0_m=-250.0, v_pov0_mps=30.0, scenario=US23)
"""A case for outcomes and motions that are made by hand."""


def ended(
    case: Case, score: float | None, index: int = 0, batch: int = 0, **measures: Any
) -> Outcome:
    """Return what came of a case; without a score, an error of the VUT."""
    end = End.VUT_ERROR if score is None else End.MERGED
    known = {"end": end, "score": score, "t_end_s": 8.3, **measures}
    return Outcome(index, batch, case, Measures(**known))


def history_of(points: FloatArray, margin: FloatArray, **columns: Any) -> LevelHistory:
    """Return the history of cases that ran once each, in one batch, and have no gap."""
    failed = columns.pop("failed", margin < 0.0)
    history = LevelHistory(
        points=points,
        margin=margin,
        failed=failed,
        gap=np.full(len(points), np.nan),
        batch=np.zeros(len(points), dtype=np.int64),
        runs=np.ones(len(points), dtype=np.int64),
        failures=failed.astype(np.int64),
        variance=np.full(len(points), np.nan),
        varies=False,
    )
    return replace(history, **columns)
