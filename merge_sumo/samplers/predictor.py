"""How a model of the controller predicts failures, and how far its predictions are trusted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, ndtr

from merge_sumo.metrics.outcome import NO_GAP, Outcome
from merge_sumo.scenario.case import FloatArray

WIDTHS: Final = ((0.01, 0.35), (0.1, 0.35), (0.35, 0.25))
"""Standard deviations of a predicted gap on the scale of `compressed`, with how often each holds;
in the other 5 % the gap may be anywhere on that scale."""
SCALE: Final = 9.0
"""Length of the scale of `compressed`: -45 to 45 times the limit."""
SURE: Final = 0.005
"""Probabilities nearer to 0 or 1 than this are not told apart."""
HALF_LIFE: Final = 40.0
"""Cases after which a prediction counts half: the model learns."""
REMEMBERED: Final = 2000
"""Cases after which a prediction counts nothing: that is below the last digit of a sum."""
TRUSTED_FROM: Final = 100
"""Last cases that give the bias of P(fail) among picks."""


class Predictor(Protocol):
    """Predicts the gaps of cases; a pure function of the outcomes told so far.

    Attributes:
        members: number of members of its ensemble. They know different things, so that they
            disagree where they guess.
    """

    members: int

    def tell(self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray]) -> None:
        """Take outcomes, and their motions, (T + 1, A, 3), by index."""

    def can_predict(self, level: int) -> bool:
        """Return whether the outcomes so far suffice to predict cases of a level."""

    def predict(
        self, points: Mapping[int, FloatArray], member: int | None = None
    ) -> Mapping[int, FloatArray]:
        """Return the signed gaps (`Outcome.signed_gap`) of cases, (M, n); NaN where none is.

        Args:
            points: cases of the unit cube by level of the POV, (n, d) each.
            member: the one that predicts, so that M is 1; None for all.
        """


def compressed(gaps: FloatArray) -> FloatArray:
    """Return gaps on a scale that is logarithmic where they are large."""
    return np.asarray(np.arcsinh(np.nan_to_num(gaps, nan=NO_GAP)))


def failure_probability(gaps: FloatArray) -> FloatArray:
    """Return P(fail), (n,), by the gaps, (M, n), that the members of an ensemble predict."""
    predicted, limit = compressed(gaps), np.arcsinh(1.0)
    anywhere = 1.0 - sum(share for _, share in WIDTHS)
    chance = np.full(gaps.shape[1], anywhere * 2.0 * limit / SCALE)
    for width, share in WIDTHS:
        failing = ndtr((limit - predicted) / width) - ndtr((-limit - predicted) / width)
        chance += share * failing.mean(axis=0)
    return np.asarray(chance, dtype=np.float64)


def disagreement(gaps: FloatArray) -> FloatArray:
    """Return the information in cases, (n,), by predicted gaps, (M, n).

    Large where members disagree on a gap that may be small.
    """
    predicted = compressed(gaps)
    near = np.exp(-0.25 * np.square(np.median(predicted, axis=0)))
    return np.asarray(predicted.std(axis=0) * near, dtype=np.float64)


def model_weight(outcomes: Sequence[Outcome]) -> float:
    """Return the weight of the model of the controller against the surrogate.

    It is logistic in the difference of their log likelihoods of the verdicts, of which the last
    ones count most.
    """
    chances, failed = _predictions(outcomes[-REMEMBERED:])
    correct = np.where(failed[:, None], chances, 1.0 - chances)[:, :2]
    likelihood = np.log(np.clip(correct, SURE, 1.0 - SURE))
    age = np.arange(len(failed))[::-1]
    return float(expit(0.5 ** (age / HALF_LIFE) @ (likelihood[:, 0] - likelihood[:, 1])))


def gain_factor(outcomes: Sequence[Outcome]) -> float:
    """Return how many of the predicted failures of the last picks came true, at most 1.

    Picks have a large P(fail), so that P(fail) is biased upwards among them.
    """
    chances, failed = _predictions(outcomes[-TRUSTED_FROM:])
    return min((float(failed.sum()) + 1.0) / (float(chances[:, 2].sum()) + 1.0), 1.0)


def _predictions(outcomes: Sequence[Outcome]) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return P(fail) by the model, the surrogate and both, (N, 3), and whether cases failed."""
    chances, failed = [], []
    for outcome in outcomes:
        known = outcome.prediction
        if known is not None:
            chances.append((known.p_twin, known.p_surrogate, known.p_fail))
            failed.append(outcome.failed)
    return np.array(chances).reshape(-1, 3), np.array(failed, dtype=bool)
