"""Importance sampling of failures: a defensive mixture to draw from, and an interval that holds.

Fresh cases are drawn from the mixture

    q = DEFENSIVE p + (1 - DEFENSIVE) g,    g in proportion to p sqrt(P(fail | surrogate)),

with p the stated distribution. The square root has the least variance where a case fails with a
chance (Kahn and Marshall, 1953); the defensive share bounds the weights p / q by 1 / DEFENSIVE
(Hesterberg, 1995), however wrong the surrogate is.

The weighted failures are independent and bounded, and the interval for their mean is by betting
(Waudby-Smith and Ramdas, 2024): valid for every number of cases, without any law of large numbers.
The cases from the defensive part are a sample of p on their own, the uniform arm. Its
Clopper-Pearson interval is shown for comparison. The choice between the two must not depend on
the result, so the first is reported.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.samplers.belief import learn_chance
from merge_sumo.samplers.history import LevelHistory
from merge_sumo.values.case import FloatArray
from merge_sumo.values.scenario import LEVELS, Scenario

DEFENSIVE: Final = 0.5
"""Share of the fresh cases that are drawn from the stated distribution. Chosen, not tuned."""
CELLS: Final = {2: 64, 3: 24, 4: 12, 5: 8, 6: 6}
"""Cells per coordinate on which the mixture is constant, by the number of coordinates."""
CHUNK: Final = 4096
"""Cells that are predicted at a time."""
BOLDNESS: Final = 0.9
"""The most that a bet may lose: 1 would be ruin by a single case. Chosen, not tuned."""


@dataclass(frozen=True, slots=True)
class Draws:
    """Cases drawn independently from a mixture.

    Attributes:
        level: (n,).
        chances: place of each in the distribution, (n, d), with d of the level that has the most
            coordinates; below level 2 the last is not used.
        weight: p / q, (n,).
        plain: whether it was drawn from the stated distribution itself, (n,).
    """

    level: NDArray[np.int64]
    chances: FloatArray
    weight: FloatArray
    plain: NDArray[np.bool_]


class DefensiveMixture:
    """The mixture q, relative to the stated distribution p, as a constant on each of many cells.

    The cells of a level are equally likely under p: they are boxes in the chances of its
    coordinates, where p is uniform.
    """

    def __init__(
        self, weights: Mapping[int, float], chance: Mapping[int, FloatArray], scenario: Scenario
    ) -> None:
        """Take level weights, and P(fail) as expected in each cell of `cells(d)`, (c,)."""
        self._levels = list(weights)
        self._dims = [len(scenario.dimensions(level)) for level in self._levels]
        self._drawn = len(scenario.dimensions(LEVELS[-1]))
        self._weights = np.array(list(weights.values()))
        wanted = [np.sqrt(chance[level]) for level in self._levels]
        mean = float(sum(w * s.mean() for w, s in zip(self._weights, wanted, strict=True)))
        # Where nothing is expected to fail anywhere, there is nothing to prefer.
        preferred = [s / mean if mean > 0.0 else np.ones_like(s) for s in wanted]
        self._density = [DEFENSIVE + (1.0 - DEFENSIVE) * s for s in preferred]
        """q / p in each cell of each level."""
        masses = [w * s / len(s) for w, s in zip(self._weights, preferred, strict=True)]
        self._mass = np.concatenate(masses)
        self._starts = np.cumsum([0, *(len(mass) for mass in masses)])

    @property
    def bound(self) -> float:
        """The greatest weight p / q anywhere."""
        return 1.0 / min(float(density.min()) for density in self._density)

    def draw(self, n: int, rng: np.random.Generator) -> Draws:
        """Return `n` independent draws."""
        plain = rng.random(n) < DEFENSIVE
        cell = rng.choice(len(self._mass), size=n, p=self._mass / self._mass.sum())
        place = np.where(
            plain,
            rng.choice(len(self._levels), size=n, p=self._weights),
            np.searchsorted(self._starts, cell, side="right") - 1,
        )
        chances = rng.random((n, self._drawn))
        weight = np.empty(n)
        for number, (level, dims) in enumerate(zip(self._levels, self._dims, strict=True)):
            of_level = place == number
            per_side = CELLS[dims]
            aimed = of_level & ~plain
            corner = np.unravel_index(cell[aimed] - self._starts[number], (per_side,) * dims)
            chances[aimed, :dims] = (np.stack(corner, axis=1) + chances[aimed, :dims]) / per_side
            weight[of_level] = self.weight(level, chances[of_level, :dims])
        return Draws(np.array(self._levels)[place], chances, weight, plain)

    def weight(self, level: int, chances: FloatArray) -> FloatArray:
        """Return p / q, (n,), at chances, (n, d), of a level."""
        dims = chances.shape[1]
        per_side = CELLS[dims]
        corner = np.minimum((chances * per_side).astype(np.int64), per_side - 1)
        cell = np.ravel_multi_index(tuple(corner.T), (per_side,) * dims)
        return np.asarray(1.0 / self._density[self._levels.index(level)][cell], dtype=np.float64)


def cells(dims: int) -> FloatArray:
    """Return the middle of each cell of a level with so many coordinates, in chances, (c, d)."""
    middle = (np.arange(CELLS[dims]) + 0.5) / CELLS[dims]
    return np.stack(np.meshgrid(*[middle] * dims, indexing="ij"), axis=-1).reshape(-1, dims)


def expected_chance(history: LevelHistory, points: FloatArray) -> FloatArray:
    """Return P(fail), (m,), that a surrogate expects at points, (m, d), from what has run.

    A wrong surrogate costs width of the interval, not its validity.
    """
    chance = learn_chance(history)
    if chance is None:
        return np.zeros(len(points))
    parts = [points[first : first + CHUNK] for first in range(0, len(points), CHUNK)]
    return np.concatenate([chance(part) for part in parts])


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
    """Return the estimate from draws.

    Args:
        draws: n draws from a mixture.
        failed: whether each failed, (n,).
        judged: whether each had a verdict, (n,).
        bound: the greatest weight that a draw can have.
        confidence: chance that the interval holds the probability.
    """
    alpha = 1.0 - confidence
    certain, possible = draws.weight * failed, draws.weight * (failed | ~judged)
    low = bound * mean_at_least(certain / bound, alpha / 2.0)
    high = bound * (1.0 - mean_at_least(1.0 - possible / bound, alpha / 2.0))
    return Estimate(
        probability=float(certain.mean()),
        low=low,
        high=min(high, 1.0),
        confidence=confidence,
        cases=len(failed),
        failures=int(failed.sum()),
        without_verdict=int((~judged).sum()),
        weight_bound=bound,
        uniform_arm=_uniform_arm(failed[draws.plain], judged[draws.plain], alpha),
    )


def mean_at_least(x: FloatArray, alpha: float) -> float:
    """Return a lower bound of a mean that is wrong with a chance of at most `alpha`.

    A gambler bets that the next value is above m, again and again. If m is the mean, the game is
    fair, and the capital ever multiplies by 1 / alpha with a chance of at most alpha (Ville's
    inequality); so every m at which the gambler became as rich is too small. The bets are those of
    Waudby-Smith and Ramdas (2024), eq. (26), with the variance of the past only.

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

    def rejected(m: float) -> bool:
        # The part at stake grows as m falls, but never to ruin: 1 + bet (x - m) > 0.
        capital = np.cumsum(np.log1p(np.minimum(bet, BOLDNESS / m) * (x - m)))
        return bool(capital.max() >= rich)

    # The capital falls with m, so the rejected values end at one place.
    low, high = 0.0, 1.0
    for _ in range(60):
        middle = (low + high) / 2.0
        low, high = (middle, high) if rejected(middle) else (low, middle)
    return low


def _uniform_arm(failed: NDArray[np.bool_], judged: NDArray[np.bool_], alpha: float) -> Arm:
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
