"""The margin of a regression: how far a case is from failing with a new version alone.

With margins m_new and m_old, below 0 for a failure, the margin of a regression is
max(m_new, -m_old): it is below 0 where the new version fails and the old one passes. A sampler
that is told this margin searches for regressions as it searches for failures.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from merge_sumo.values.case import FloatArray
from merge_sumo.values.prediction import Prediction
from merge_sumo.values.scenario import DX_CRASH_M
from merge_sumo.values.score import Outcome

FARTHEST: Final = 200.0 / DX_CRASH_M - 1.0
"""Margin of a VUT that never arrives, and the largest one: that of a gap of 200 m."""


def regression(new: Outcome, old: Outcome, prediction: Prediction | None = None) -> Outcome:
    """Return the outcome of a case whose failure is a regression, with its prediction.

    It has the measures of the new version, and a margin under every criterion. Without a verdict on
    both versions it has none.
    """
    silent = next((outcome for outcome in (new, old) if outcome.score is None), None)
    if silent is not None:
        return replace(new, measures=silent.measures, margin=None, prediction=prediction)
    margin = max(_margin(new), -_margin(old))
    return replace(new, margin=min(margin, FARTHEST), prediction=prediction)


def _margin(outcome: Outcome) -> float:
    """Return the margin of an outcome with a verdict; the paper's criterion gives it by the gap."""
    if outcome.margin is not None:
        return outcome.margin
    gap_m = np.array([outcome.signed_gap_m], dtype=np.float64)
    return float(margins(gap_m, outcome.gap_limit_m)[0])


def margins(gap_m: FloatArray, limit_m: float) -> FloatArray:
    """Return the margins, (...), that signed gaps at M stand for; a case fails below the limit.

    The inverse of `Outcome.signed_gap_m`; NaN is the gap of a VUT that never arrives.
    """
    share = np.abs(gap_m) / limit_m
    with np.errstate(divide="ignore"):
        margin = np.where(share >= 1.0, share - 1.0, 1.0 - 1.0 / share)
    return np.nan_to_num(margin, nan=FARTHEST, posinf=FARTHEST, neginf=-FARTHEST)


def regression_gaps_m(new_m: FloatArray, old_m: FloatArray, limit_m: float) -> FloatArray:
    """Return what stands for the gap of a regression, (...), by the signed gaps of both versions.

    It is `Outcome.signed_gap_m` of `regression`: within 6 m for a regression, with the sign of the
    new version's gap.
    """
    margin = np.minimum(np.maximum(margins(new_m, limit_m), -margins(old_m, limit_m)), FARTHEST)
    size = np.where(margin >= 0.0, 1.0 + margin, 1.0 / (1.0 - np.minimum(margin, 0.0)))
    return np.asarray(DX_CRASH_M * np.where(new_m < 0.0, -size, size), dtype=np.float64)
