"""How well the cases of a campaign were predicted by the twin of its VUT."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from merge_sumo.samplers.prediction_skill import compressed
from merge_sumo.values.score import Outcome


def prediction_error_m(outcome: Outcome) -> float | None:
    """Return the error of the predicted gap in m; None without a prediction or a gap."""
    if outcome.prediction is None or outcome.margin is None:
        return None
    predicted_m, gap = outcome.prediction.median_dx_m, outcome.signed_gap
    if predicted_m is None or gap is None:
        return None
    return abs(predicted_m - gap * outcome.case.scenario.dx_crash_m)


def surprises(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Return the cases with a prediction, the largest surprise first: gaps on a logarithmic scale.

    A case in which the VUT never arrived, or was predicted not to, is one with a large gap.
    """

    def surprise(outcome: Outcome) -> float:
        assert outcome.prediction is not None, "filtered below"  # noqa: S101
        predicted_m, limit_m = outcome.prediction.median_dx_m, outcome.case.scenario.dx_crash_m
        predicted = math.nan if predicted_m is None else predicted_m / limit_m
        gaps = np.array([predicted, outcome.signed_gap], dtype=np.float64)
        return abs(float(np.diff(compressed(gaps))[0]))

    predicted = [o for o in outcomes if o.prediction is not None and o.margin is not None]
    return sorted(predicted, key=lambda o: (-surprise(o), o.index))
