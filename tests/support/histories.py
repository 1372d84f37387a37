"""Outcomes of a level as arrays, for tests of samplers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from merge_sumo.samplers.history import LevelHistory

FloatArray = np.ndarray


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
