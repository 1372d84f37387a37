"""The mixture from which fresh cases are drawn.

    q = DEFENSIVE p + (1 - DEFENSIVE) g,    g in proportion to p sqrt(P(fail | surrogate)),

with p the stated distribution. The square root is what has the least variance where a case fails
with a chance (Kahn and Marshall, 1953); the defensive share bounds the weights p / q by
1 / DEFENSIVE (Hesterberg, 1995), however wrong the surrogate is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.samplers.belief import learn_chance
from merge_sumo.samplers.history import LevelHistory
from merge_sumo.values.case import FloatArray
from merge_sumo.values.scenario import LEVELS, US23, Scenario

DEFENSIVE: Final = 0.5
"""Share of the fresh cases that are drawn from the stated distribution itself."""
CELLS: Final = {2: 64, 3: 24, 4: 12, 5: 8, 6: 6}
"""Cells per coordinate, by their number, on which the proposal is constant."""
CHUNK: Final = 4096
"""Cells that are predicted at a time."""


@dataclass(frozen=True, slots=True)
class Draws:
    """Cases drawn independently from a proposal.

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


class Proposal:
    """The mixture q, relative to the stated distribution p, as a constant on each of many cells.

    The cells of a level are equally likely under p: they are boxes in the chances of its
    coordinates, where p is uniform.
    """

    def __init__(
        self,
        weights: Mapping[int, float],
        chance: Mapping[int, FloatArray],
        scenario: Scenario = US23,
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
        self._starts = np.cumsum([0, *map(len, masses)])

    @property
    def bound(self) -> float:
        """The greatest weight p / q anywhere."""
        return 1.0 / min(float(density.min()) for density in self._density)

    def total(self) -> float:
        """Return the integral of q, which is 1."""
        means = [density.mean() for density in self._density]
        return float(self._weights @ np.array(means))

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
            here = place == number
            per_side = CELLS[dims]
            aimed = here & ~plain
            corner = np.unravel_index(cell[aimed] - self._starts[number], (per_side,) * dims)
            chances[aimed, :dims] = (np.stack(corner, axis=1) + chances[aimed, :dims]) / per_side
            weight[here] = self.weight(level, chances[here, :dims])
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

    It may be as wrong as it likes: it costs width of the interval, not its validity.
    """
    chance = learn_chance(history)
    if chance is None:
        return np.zeros(len(points))
    parts = [points[first : first + CHUNK] for first in range(0, len(points), CHUNK)]
    return np.concatenate([chance(part) for part in parts])
