"""How well the cases of a campaign were predicted by the twin of its VUT."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from merge_sumo.samplers.prediction_skill import compressed
from merge_sumo.values.score import Outcome

LAST: Final = 200
"""Last cases whose prediction error is summarised."""
LIKELY: Final = 0.5
"""Predicted chance of failing from which a case is a likely failure. Chosen, not tuned."""


def prediction_error_m(outcome: Outcome) -> float | None:
    """Return the error of the predicted gap in m; None without a prediction or a gap."""
    if outcome.prediction is None or outcome.measures.score is None:
        return None
    predicted_m, gap_m = outcome.prediction.median_dx_m, outcome.signed_gap_m
    return None if predicted_m is None or gap_m is None else abs(predicted_m - gap_m)


def surprises(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Return the cases with a prediction, the largest surprise first: gaps on a logarithmic scale.

    A case in which the VUT never arrived, or was predicted not to, is one with a large gap.
    """

    def surprise(outcome: Outcome) -> float:
        assert outcome.prediction is not None, "filtered below"  # noqa: S101
        gaps = np.array([outcome.prediction.median_dx_m, outcome.signed_gap_m], dtype=np.float64)
        return abs(float(np.diff(compressed(gaps, outcome.gap_limit_m))[0]))

    predicted = [o for o in outcomes if o.prediction is not None and o.measures.score is not None]
    return sorted(predicted, key=lambda o: (-surprise(o), o.index))


def prediction_in_words(outcomes: Sequence[Outcome]) -> str | None:
    """Return the prediction error of the last cases in words; None without predictions."""
    last = [outcome for outcome in outcomes if outcome.prediction is not None][-LAST:]
    off = [gap for outcome in last if (gap := prediction_error_m(outcome)) is not None]
    if not off:
        return None
    likely = [o for o in last if o.prediction is not None and o.prediction.p_fail >= LIKELY]
    failed = sum(outcome.failed for outcome in likely)
    middle, most = np.quantile(off, (0.5, 0.9)).tolist()
    words = f"In half of the last {len(last)} cases the error was below {_metres(middle)}, and in "
    words += f"nine of ten below {_metres(most)}."
    if likely:
        words += f" Of {len(likely)} that were given a chance of failing of {LIKELY:.0%} or more, "
        words += f"{failed} failed."
    return words


def _metres(length_m: float) -> str:
    """Return a length that is rounded up, in centimetres or metres."""
    return f"{max(math.ceil(100.0 * length_m), 1)} cm" if length_m < 1.0 else f"{length_m:.1f} m"
