"""The estimate of a probability from weighted draws, with an interval that is always valid.

The weighted failures are independent and bounded, and the interval for their mean is by betting
(Waudby-Smith and Ramdas, 2024): valid for every number of cases, without any law of large numbers.

The cases from the defensive part are a plain sample of their own: the uniform arm. Its
Clopper-Pearson interval is shown for comparison. Which of the two is reported is not to be chosen
after looking; it is the first.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.studies.importance import Draws
from merge_sumo.values.case import FloatArray

BOLDNESS: Final = 0.9
"""The most that a bet may lose: 1 would be ruin by a single case."""


@dataclass(frozen=True, slots=True)
class Arm:
    """The cases that were drawn from the stated distribution itself, and their interval."""

    cases: int
    failures: int
    probability: float | None
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Estimate:
    """A probability of failure, with an interval that holds with at least `confidence`.

    Attributes:
        probability: the weighted share of failures; cases without a verdict count as safe.
        low: end of the interval; cases without a verdict count as safe.
        high: end of the interval; cases without a verdict count as failures.
        confidence: chance that the interval holds the probability.
        cases: fresh cases.
        failures: failures among them.
        without_verdict: cases that ended as VUT_ERROR or SIM_ERROR.
        weight_bound: the greatest weight that a case could have had.
        uniform_arm: the plain sample among them, with its Clopper-Pearson interval.
    """

    probability: float
    low: float
    high: float
    confidence: float
    cases: int
    failures: int
    without_verdict: int
    weight_bound: float
    uniform_arm: Arm


def estimate(
    draws: Draws,
    failed: NDArray[np.bool_],
    judged: NDArray[np.bool_],
    bound: float,
    confidence: float,
) -> Estimate:
    """Return the estimate from draws, whether each failed, (n,), and had a verdict, (n,)."""
    alpha = 1.0 - confidence
    sure, possible = draws.weight * failed, draws.weight * (failed | ~judged)
    low = bound * mean_at_least(sure / bound, alpha / 2.0)
    high = bound * (1.0 - mean_at_least(1.0 - possible / bound, alpha / 2.0))
    return Estimate(
        probability=float(sure.mean()),
        low=low,
        high=min(high, 1.0),
        confidence=confidence,
        cases=len(failed),
        failures=int(failed.sum()),
        without_verdict=int((~judged).sum()),
        weight_bound=bound,
        uniform_arm=_arm(failed[draws.plain], judged[draws.plain], alpha),
    )


def mean_at_least(x: FloatArray, alpha: float) -> float:
    """Return a lower bound of a mean that is wrong with a chance of at most `alpha`.

    A gambler who doubts that the mean is m bets a part of the capital on each next value to be
    above m. If m is the mean, the game is fair, and the capital ever multiplies by 1 / alpha with
    a chance of at most alpha (Ville's inequality); so every m that made this gambler as rich is too
    small. The bets are those of Waudby-Smith and Ramdas (2024), eq. (26), with the variance of the
    past only.

    Args:
        x: independent values in [0, 1] with one mean, (n,), in the order in which they were drawn.
        alpha: chance of being wrong.
    """
    n = len(x)
    before = np.arange(n)
    number = np.maximum(before, 1)
    total, squares = np.cumsum(x) - x, np.cumsum(x * x) - x * x
    variance = np.maximum(squares / number - np.square(total / number), 0.0) + 1.0 / n
    bet = np.sqrt(2.0 * math.log(1.0 / alpha) / (n * variance))
    rich = math.log(1.0 / alpha)

    def doubted(m: float) -> bool:
        # The part at stake grows with the doubt, but never to ruin: 1 + bet (x - m) > 0.
        capital = np.cumsum(np.log1p(np.minimum(bet, BOLDNESS / m) * (x - m)))
        return bool(capital.max() >= rich)

    # The capital falls with m, so what is doubted ends at one place.
    low, high = 0.0, 1.0
    for _ in range(60):
        middle = (low + high) / 2.0
        low, high = (middle, high) if doubted(middle) else (low, middle)
    return low


def _arm(failed: NDArray[np.bool_], judged: NDArray[np.bool_], alpha: float) -> Arm:
    n, k = len(failed), int(failed.sum())
    low, _ = clopper_pearson(k, n, alpha)
    _, high = clopper_pearson(k + int((~judged).sum()), n, alpha)
    return Arm(n, k, k / n if n else None, low, high)


def clopper_pearson(failures: int, cases: int, alpha: float) -> tuple[float, float]:
    """Return the exact interval of a binomial share (Clopper and Pearson, 1934).

    Only for cases that were drawn independently: never for those that a sampler has chosen.
    """
    from scipy.stats import beta

    low, high = 0.0, 1.0
    if failures > 0:
        low = float(beta.ppf(alpha / 2.0, failures, cases - failures + 1))
    if failures < cases:
        high = float(beta.ppf(1.0 - alpha / 2.0, failures + 1, cases - failures))
    return low, high
