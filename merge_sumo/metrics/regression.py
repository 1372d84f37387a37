"""The margin of a regression: how far a case is from failing with a new version alone.

With margins m_new and m_old, below 0 for a failure, the margin of a regression is
max(m_new, -m_old): it is below 0 where the new version fails and the old one passes. A sampler
that is told this margin searches for regressions as it searches for failures.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from merge_sumo.metrics.outcome import NO_GAP, Outcome, Prediction
from merge_sumo.scenario.case import FloatArray

FARTHEST = NO_GAP - 1.0
"""Margin of a VUT that never arrives, and the largest one."""


def regression(new: Outcome, old: Outcome, prediction: Prediction | None = None) -> Outcome:
    """Return the outcome of a case whose failure is a regression.

    It has the measures of the new version, and the margin of a regression; without a verdict on
    both versions it has no margin.

    Args:
        new: outcome of the new version.
        old: outcome of the earlier version.
        prediction: prediction of the case.
    """
    for outcome in (new, old):
        if outcome.margin is None:
            return replace(new, measures=outcome.measures, margin=None, prediction=prediction)
    margin = max(_margin(new), -_margin(old))
    return replace(new, margin=min(margin, FARTHEST), prediction=prediction)


def _margin(outcome: Outcome) -> float:
    """Return the margin of an outcome, by its gap and not by its score, which says less."""
    if outcome.margin is not None and not outcome.is_by_score:
        return outcome.margin
    return float(margins(np.array([outcome.signed_gap], dtype=np.float64))[0])


def margins(gap: FloatArray) -> FloatArray:
    """Return the margins that signed gaps at M stand for: the inverse of `Outcome.signed_gap`.

    Args:
        gap: signed gaps in units of the limit, of any shape; NaN for a VUT that never arrives.

    Returns:
        Margins of the same shape, at most `FARTHEST`.
    """
    share = np.abs(gap)
    with np.errstate(divide="ignore"):
        margin = np.where(share >= 1.0, share - 1.0, 1.0 - 1.0 / share)
    return np.nan_to_num(margin, nan=FARTHEST, posinf=FARTHEST, neginf=-FARTHEST)


def regression_gaps(new: FloatArray, old: FloatArray) -> FloatArray:
    """Return the signed gaps of regressions, `Outcome.signed_gap` of `regression`, as an array.

    Args:
        new: signed gaps of the new version, in units of the limit; NaN where it never arrives.
        old: those of the earlier version, of the same shape.

    Returns:
        Gaps of the same shape: within -1 to 1 for a regression, with the sign of the new gap.
    """
    margin = np.minimum(np.maximum(margins(new), -margins(old)), FARTHEST)
    size = np.where(margin >= 0.0, 1.0 + margin, 1.0 / (1.0 - np.minimum(margin, 0.0)))
    return np.asarray(np.where(new < 0.0, -size, size), dtype=np.float64)
