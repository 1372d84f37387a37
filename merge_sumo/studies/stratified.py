"""Stratified estimation of a failure probability, with an interval that is exact.

The stated distribution p is cut into three strata by the P(fail) that a surrogate expects: expected
to be safe, in doubt, expected to fail. Strata are unions of cells that are equally likely under p,
so their shares W_h are known exactly. In each, n_h cases are drawn independently from p within the
stratum, k_h of them fail, and the estimate is

    T = sum_h W_h k_h / n_h.

The upper end is that of Buehler (1957): the largest sum_h W_h p_h with P(T <= what was found) of at
least alpha, over all failure probabilities p_h of the strata; the lower end is its mirror image. No
law of large numbers and no trust in the surrogate is needed: a wrong one costs width alone. With a
single stratum, T counts failures, and the interval is that of Clopper and Pearson (1934).

What is gained: where the surrogate is right nearly all cases may look for failures in the stratum
that is expected to be safe, and the variance is that of the stratum in doubt alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.special import bdtr, rel_entr

from merge_sumo.values.case import FloatArray
from merge_sumo.values.chance import clopper_pearson
from merge_sumo.values.scenario import LEVELS, Scenario

IntArray = NDArray[np.int64]

CELLS: Final = {2: 192, 3: 40, 4: 16, 5: 8, 6: 6}
"""Cells per coordinate, each of which is in one stratum, by the number of coordinates."""
SPLIT: Final = {2: 4, 3: 2, 4: 2, 5: 1, 6: 1}
"""Cells along each coordinate for which one prediction suffices where nothing is in doubt."""
DOUBTED: Final = 0.05
"""P(fail) nearby from which a block of cells is in doubt, and so is one below the complement."""
SAFE_BELOW: Final = (0.03, 0.1, 0.3)
FAILING_FROM: Final = (0.7, 0.9, 0.97)
"""P(fail) up to which a cell may count as safe, and from which it may count as failing."""
DEFENSIVE: Final = 0.9
"""Least cases of a stratum, as a share of what plain sampling would give it: if the surrogate knows
nothing, the interval is wider than that of plain cases by a factor of 1 / sqrt(DEFENSIVE)."""
UPPER_RISK: Final = 0.75
"""Share of the chance of being wrong that the upper end has, where there is more than one stratum.
The lower end rests on the strata where failures are seen, and is sharp."""
SHARES: Final = 20
"""Steps in which cases are shared out over strata."""
OWN_RISK: Final = 0.1
"""Share of the risk of an end that excludes values of single strata (Berger and Boos, 1994)."""
POINTS: Final = 40
ROUNDS: Final = 5
"""Grid of an upper end: points per stratum, and how often it is refined."""
EXACT: Final = 0.002
"""What an upper end may be too large by, as a share of its distance from the estimate."""
ROUNDING: Final = 1e-9
NEVER: Final = 1e-11
"""Chance of numbers of failures that are left out; their sum is far below ROUNDING."""
LEAST_FORCE, MOST_FORCE, FORCE_STEPS = 1e-6, 1e12, 45
"""Where mu of a Chernoff bound is looked for, and in how many steps."""


@dataclass(frozen=True, slots=True)
class Draws:
    """Cases drawn independently, each from its stratum.

    Attributes:
        level: (n,).
        chances: place of each in the distribution, (n, d), with d of the level that has the most
            coordinates; below level 2 the last is not used.
        stratum: (n,).
        weight: W_h n / n_h, (n,): the mean of the weighted failures is the estimate.
    """

    level: IntArray
    chances: FloatArray
    stratum: IntArray
    weight: FloatArray


class Strata:
    """The stated distribution in up to three strata, and how many cases each gets.

    Attributes:
        share: probability of each stratum, (H,).
        expected: P(fail) that the surrogate expects in it, (H,).
        cases: cases that are drawn from it, (H,).
    """

    def __init__(
        self,
        weights: Mapping[int, float],
        chance: Mapping[int, FloatArray],
        scenario: Scenario,
        cases: int,
        confidence: float,
    ) -> None:
        """Take level weights, and P(fail) as expected in each cell of `cells(d)`, (c,)."""
        self._levels = list(weights)
        self._dims = [len(scenario.dimensions(level)) for level in self._levels]
        self._drawn = len(scenario.dimensions(LEVELS[-1]))
        sizes = [len(chance[level]) for level in self._levels]
        self._starts = np.cumsum([0, *sizes])
        expected = np.concatenate([chance[level] for level in self._levels])
        mass = np.concatenate(
            [np.full(n, w / n) for n, w in zip(sizes, weights.values(), strict=True)]
        )
        best = math.inf
        for limits in [(), *product(SAFE_BELOW, FAILING_FROM)]:
            of_cell = np.searchsorted(limits, expected, side="right")
            share = _sums_by(of_cell, mass, len(limits) + 1)
            share = share / share.sum()
            some = share > 0.0
            if limits and some.sum() == 1:
                continue
            mean = _sums_by(of_cell, mass * expected, len(share))[some] / share[some]
            mean = np.clip(mean, 0.0, 1.0)
            numbers, width = allocated(share[some], mean, cases, confidence)
            if width < best:
                best = width
                self.share, self.expected, self.cases = share[some], mean, numbers
                self._of_cell = (np.cumsum(some) - 1)[of_cell]
        self._mass = mass

    def draw(self, rng: np.random.Generator) -> Draws:
        """Return the cases of all strata, stratum by stratum."""
        stratum = np.repeat(np.arange(len(self.cases)), self.cases)
        drawn = []
        for h, n in enumerate(self.cases):
            inside = np.flatnonzero(self._of_cell == h)
            mass = self._mass[inside]
            drawn.append(inside[rng.choice(len(inside), size=n, p=mass / mass.sum())])
        cell = np.concatenate(drawn)
        place = np.searchsorted(self._starts, cell, side="right") - 1
        chances = rng.random((len(cell), self._drawn))
        for number, dims in enumerate(self._dims):
            of_level = place == number
            per_side = CELLS[dims]
            corner = np.unravel_index(cell[of_level] - self._starts[number], (per_side,) * dims)
            within = np.stack(corner, axis=1) + chances[of_level, :dims]
            chances[of_level, :dims] = within / per_side
        weight = (self.share * len(cell) / self.cases)[stratum]
        return Draws(np.array(self._levels)[place], chances, stratum, weight)


def _sums_by(group: IntArray, values: FloatArray, groups: int) -> FloatArray:
    """Return the sum of the values of each group, (groups,)."""
    return np.bincount(group, values, groups).astype(np.float64)


def cells(dims: int, split: int = 1) -> FloatArray:
    """Return the middle of each cell of a level with so many coordinates, in chances, (c, d).

    `split` is how many cells are taken together along each coordinate.
    """
    count = CELLS[dims] // split
    middle = (np.arange(count) + 0.5) / count
    return np.stack(np.meshgrid(*[middle] * dims, indexing="ij"), axis=-1).reshape(-1, dims)


def of_cells(dims: int, expected: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Return P(fail) in each cell of `cells(dims)`, (c,), by a function of chances, (n, d).

    Blocks of cells are asked for first, and single cells where failures are near, or safe cases
    near failures.
    """
    split, count = SPLIT[dims], CELLS[dims]
    coarse = expected(cells(dims, split)).reshape((count // split,) * dims)
    doubted = (maximum_filter(coarse, 3) > DOUBTED) & (minimum_filter(coarse, 3) < 1.0 - DOUBTED)
    fine, single = coarse, doubted
    for axis in range(dims):
        fine, single = np.repeat(fine, split, axis), np.repeat(single, split, axis)
    fine, single = fine.ravel().copy(), single.ravel()
    if single.any():
        fine[single] = expected(cells(dims)[single])
    return fine


@dataclass(frozen=True, slots=True)
class Stratum:
    """What was drawn from a stratum.

    Attributes:
        share: its probability under the stated distribution.
        expected: P(fail) in it as the surrogate expected it.
        cases: cases that were drawn from it.
        failures: how many of them fail.
        without_verdict: how many ended as VUT_ERROR or SIM_ERROR.
    """

    share: float
    expected: float
    cases: int
    failures: int
    without_verdict: int


@dataclass(frozen=True, slots=True)
class Interval:
    """Both ends of an interval."""

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
        low_risk: chance that `low` is above it, at most.
        high_risk: chance that `high` is below it, at most.
        cases: fresh cases.
        failures: failures among them.
        without_verdict: cases that ended as VUT_ERROR or SIM_ERROR.
        strata: what was drawn from each stratum.
        plain: for comparison, the interval of Clopper and Pearson if as many cases had been drawn
            without strata, and the same share of them had failed.
    """

    probability: float
    low: float
    high: float
    confidence: float
    low_risk: float
    high_risk: float
    cases: int
    failures: int
    without_verdict: int
    strata: tuple[Stratum, ...]
    plain: Interval


def estimate(
    strata: Strata,
    draws: Draws,
    failed: NDArray[np.bool_],
    judged: NDArray[np.bool_],
    confidence: float,
    risk: tuple[float, float] | None = None,
) -> Estimate:
    """Return the estimate from the draws of all strata, (n,): which failed, and had a verdict.

    `risk` is how likely the lower and the upper end may be wrong, by default that of `risks`.
    """
    found = [
        Stratum(
            float(share),
            float(expected),
            int(cases),
            int(failed[draws.stratum == h].sum()),
            int((~judged[draws.stratum == h]).sum()),
        )
        for h, (share, expected, cases) in enumerate(
            zip(strata.share, strata.expected, strata.cases, strict=True)
        )
    ]
    certain = np.array([one.failures for one in found])
    possible = certain + [one.without_verdict for one in found]
    n, (low_risk, high_risk) = len(failed), risk or risks(len(found), confidence)
    probability = float(strata.share @ (certain / strata.cases))
    likely = round(probability * n)
    plain = clopper_pearson(likely, n, (1.0 - confidence) / 2.0)
    return Estimate(
        probability=probability,
        low=1.0 - upper_end(strata.share, strata.cases, strata.cases - certain, low_risk),
        high=upper_end(strata.share, strata.cases, possible, high_risk),
        confidence=confidence,
        low_risk=low_risk,
        high_risk=high_risk,
        cases=n,
        failures=int(certain.sum()),
        without_verdict=int((~judged).sum()),
        strata=tuple(found),
        plain=Interval(*plain),
    )


def risks(strata: int, confidence: float) -> tuple[float, float]:
    """Return the chances that the lower and that the upper end may be wrong."""
    upper = 0.5 if strata == 1 else UPPER_RISK
    return (1.0 - upper) * (1.0 - confidence), upper * (1.0 - confidence)


def allocated(
    share: FloatArray, expected: FloatArray, cases: int, confidence: float
) -> tuple[IntArray, float]:
    """Return how many cases each stratum gets, (H,), and the width that is expected then.

    The width is that between Chernoff's bounds, which are quick and not much wider than the exact
    ends.
    """
    strata = len(share)
    if strata == 1:
        numbers = np.array([[float(cases)]])
    else:
        least = np.maximum(np.floor(DEFENSIVE * share * cases), 1.0)
        steps = product(range(SHARES + 1), repeat=strata - 1)
        first = np.array([step for step in steps if sum(step) <= SHARES]) / SHARES
        shares = np.column_stack([first, 1.0 - first.sum(axis=1)])
        numbers = np.floor(least + max(cases - least.sum(), 0.0) * shares)
        numbers[:, 0] += cases - numbers.sum(axis=1)
        numbers = numbers[numbers[:, 0] >= 1.0]
    if not len(numbers):
        return np.ones(strata, dtype=np.int64), math.inf
    low, high = risks(strata, confidence)
    # The sum of both distances: that of the lower end is the upper one's for what does not fail.
    up = _chernoff(share, expected * numbers, numbers, high)
    down = _chernoff(share, (1.0 - expected) * numbers, numbers, low)
    width = up + down - 1.0
    best = int(width.argmin())
    return numbers[best].astype(np.int64), float(width[best])


def _chernoff(
    share: FloatArray, failures: FloatArray, cases: FloatArray, risk: float
) -> FloatArray:
    """Return Chernoff's upper bound of sum_h W_h p_h, (m,), for failures in cases, both (m, H).

    It is the largest sum with sum_h n_h KL(k_h / n_h, p_h) <= log(1 / risk). There W_h mu =
    n_h (p_h - k_h / n_h) / (p_h (1 - p_h)) for one mu, which is found by bisecting its logarithm.
    """
    budget, mean = math.log(1.0 / risk), failures / cases
    low, high = np.full(len(cases), np.log(LEAST_FORCE)), np.full(len(cases), np.log(MOST_FORCE))
    p = mean
    for _ in range(FORCE_STEPS):
        middle = (low + high) / 2.0
        force = share * np.exp(middle)[:, None]
        b = force - cases
        p = (b + np.sqrt(b * b + 4.0 * force * np.maximum(failures, 0.0))) / (2.0 * force)
        p = np.minimum(np.maximum(p, mean), 1.0)
        spent = (cases * (rel_entr(mean, p) + rel_entr(1.0 - mean, 1.0 - p))).sum(axis=1) > budget
        low, high = np.where(spent, low, middle), np.where(spent, middle, high)
    return np.asarray(p @ share, dtype=np.float64)


def upper_end(share: FloatArray, cases: IntArray, failures: IntArray, risk: float) -> float:
    """Return an upper bound of sum_h W_h p_h that is wrong with a chance of at most `risk`.

    Args:
        share: W_h of up to three strata, (H,).
        cases: n_h independent cases of each, (H,).
        failures: how many of them fail, (H,).
        risk: chance of being wrong.

    First, values of p_h that are excluded by the cases of a stratum alone are left out, at part of
    the risk (Berger and Boos, 1994). The rest is cut into boxes. P(U <= u), with u the Chernoff
    bound U that was found, falls with each p_h; so a box has no candidate if its lowest corner is
    none, and else its highest corner bounds it. Boxes are refined where the bound may be.
    """
    if (failures == cases).all():
        return 1.0
    if len(share) == 1:
        return clopper_pearson(int(failures[0]), int(cases[0]), risk)[1]
    own, rest = OWN_RISK * risk / (2 * len(share)), (1.0 - OWN_RISK) * risk
    ends = [clopper_pearson(int(k), int(n), own) for k, n in zip(failures, cases, strict=True)]
    order = _Order(share, cases, failures, rest, ends)
    grids = [np.linspace(low, high, POINTS) for low, high in ends]
    estimate = float(share @ (failures / cases))
    limit = 1.0
    for _ in range(ROUNDS):
        below = [grid[:-1] for grid in grids]
        able = order.chance(below) >= rest - ROUNDING
        reached = _sums(share, below)[able].max()
        bounds = np.where(able, _sums(share, [grid[1:] for grid in grids]), -1.0)
        limit = float(bounds.max())
        if limit - reached <= EXACT * (limit - estimate):
            break
        left = np.nonzero(bounds >= reached)
        grids = [
            np.linspace(grid[places.min()], grid[places.max() + 1], POINTS)
            for grid, places in zip(grids, left, strict=True)
        ]
    return min(max(limit, estimate), 1.0)


def _sums(share: FloatArray, grids: Sequence[FloatArray]) -> FloatArray:
    """Return sum_h W_h p_h of all combinations of probabilities of the strata."""
    axes = np.meshgrid(*grids, indexing="ij", sparse=True)
    return np.asarray(sum(w * axis for w, axis in zip(share, axes, strict=True)))


class _Order:
    """The results (K_1, ..., K_H) whose Chernoff bound is at most the one that was found.

    They are kept as the largest K of the last stratum, by the K of the others: the bound grows with
    each of them.
    """

    def __init__(
        self,
        share: FloatArray,
        cases: IntArray,
        failures: IntArray,
        risk: float,
        ends: Sequence[tuple[float, float]],
    ) -> None:
        """Take what was found, and between which p_h chances will be asked for."""
        from scipy.stats import binom

        self._cases = cases
        counts = np.array([failures, cases], dtype=np.float64)
        found = _chernoff(share, counts[:1], counts[1:], risk)[0]
        self._numbers = [
            # Other numbers have no chance worth speaking of.
            np.arange(max(binom.ppf(NEVER, n, low), 0.0), binom.isf(NEVER, n, high) + 1.0)
            for n, (low, high) in zip(cases[:-1], ends, strict=False)
        ]
        axes = [axis.ravel() for axis in np.meshgrid(*self._numbers, indexing="ij")]
        low, high = np.full(len(axes[0]), -1.0), np.full(len(axes[0]), float(cases[-1]))
        while (low < high).any():
            middle = np.ceil((low + high) / 2.0)
            numbers = np.column_stack([*axes, middle])
            bound = _chernoff(share, numbers, np.broadcast_to(cases, numbers.shape), risk)
            fits = bound <= found * (1.0 + ROUNDING)
            low, high = np.where(fits, middle, low), np.where(fits, high, middle - 1.0)
        self._most = low.reshape([len(numbers) for numbers in self._numbers])

    def chance(self, grids: Sequence[FloatArray]) -> FloatArray:
        """Return the chance of such a result for all probabilities of the grids."""
        from scipy.stats import binom

        result = np.empty([len(grid) for grid in grids])
        chances = [
            binom.pmf(numbers, n, grid[:, None])
            for numbers, n, grid in zip(self._numbers, self._cases, grids, strict=False)
        ]
        known, place = np.unique(np.maximum(self._most, 0.0), return_inverse=True)
        for number, p in enumerate(grids[-1]):
            below = bdtr(known, self._cases[-1], p)[place].reshape(self._most.shape)
            chance = np.where(self._most >= 0.0, below, 0.0)
            for of_number in chances:  # the first axis that is left becomes one of the grid
                chance = np.tensordot(chance, of_number, axes=(0, 1))
            result[..., number] = chance
        return result
