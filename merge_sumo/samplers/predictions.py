"""P(fail) by the predictions of a model of the controller, and their weight."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import expit, ndtr

from merge_sumo.metrics.fmc import BoolArray
from merge_sumo.metrics.outcome import NO_GAP, Outcome
from merge_sumo.scenario.case import FloatArray

# The error of a predicted gap is a mixture on the scale of `compressed`: normal components, as
# (standard deviation, weight), and a uniform one with the remaining weight of 5 %.
WIDTHS = ((0.01, 0.35), (0.1, 0.35), (0.35, 0.25))


def compressed(gaps: FloatArray) -> FloatArray:
    """Compress gaps to a scale that is logarithmic where they are large.

    Args:
        gaps: signed gaps of any shape; NaN where the VUT never arrives.
    """
    return np.arcsinh(np.nan_to_num(gaps, nan=NO_GAP))


def chance_by_gaps(gaps: FloatArray) -> FloatArray:
    """Return P(fail) by the predictions of an ensemble.

    Args:
        gaps: signed gaps by M members for n cases, (M, n).

    Returns:
        Probabilities, (n,).
    """
    predicted, limit = compressed(gaps), np.arcsinh(1.0)
    # The scale is 9 long: -45 to 45 times the limit.
    chance = np.full(gaps.shape[1], 0.05 * 2.0 * limit / 9.0)
    for width, share in WIDTHS:
        failing = ndtr((limit - predicted) / width) - ndtr((-limit - predicted) / width)
        chance += share * failing.mean(axis=0)
    return chance


def disagreement(gaps: FloatArray) -> FloatArray:
    """Return how informative cases are: very, where members disagree on a gap that may be small.

    Args:
        gaps: signed gaps by M members for n cases, (M, n).

    Returns:
        Information without a unit, (n,).
    """
    predicted = compressed(gaps)
    near = np.exp(-0.25 * np.square(np.median(predicted, axis=0)))
    information: FloatArray = predicted.std(axis=0) * near
    return information


def model_weight(outcomes: Sequence[Outcome]) -> float:
    """Return the weight of the model of the controller against the surrogate.

    It is logistic in the difference of their log likelihoods of the verdicts. A verdict counts half
    after 40 cases, as the model learns.

    Args:
        outcomes: outcomes in their order; those without a prediction are ignored.

    Returns:
        Weight from 0 to 1; 0.5 without predictions.
    """
    # Older verdicts count less than the last digit of the sum.
    chances, failed = _predictions(outcomes[-2000:])
    correct = np.where(failed[:, None], chances, 1.0 - chances)[:, :2]
    likelihood = np.log(np.clip(correct, 0.005, 0.995))
    age = np.arange(len(failed))[::-1]
    return float(expit(0.5 ** (age / 40.0) @ (likelihood[:, 0] - likelihood[:, 1])))


def gain_factor(outcomes: Sequence[Outcome]) -> float:
    """Return the share of the predicted failures of the last 100 picks that came true, at most 1.

    Picks have a large P(fail), so that P(fail) is biased upwards among them.

    Args:
        outcomes: outcomes in their order; those without a prediction are ignored.
    """
    chances, failed = _predictions(outcomes[-100:])
    return min((float(failed.sum()) + 1.0) / (float(chances[:, 2].sum()) + 1.0), 1.0)


def _predictions(outcomes: Sequence[Outcome]) -> tuple[FloatArray, BoolArray]:
    """Return P(fail) by the model, the surrogate and both, (N, 3), and whether cases failed."""
    chances, failed = [], []
    for outcome in outcomes:
        prediction = outcome.prediction
        if prediction is not None:
            chances.append((prediction.p_twin, prediction.p_surrogate, prediction.p_fail))
            failed.append(outcome.failed)
    return np.array(chances).reshape(-1, 3), np.array(failed, dtype=bool)
