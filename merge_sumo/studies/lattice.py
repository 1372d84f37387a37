"""Covering lattices of the unit cube: points such that every ball of a radius contains one.

The points are those of a grid whose indices are all even or all odd: in two dimensions a centred
rectangular lattice, hexagonal but for a stretch of less than a step; in three the body-centred
cubic one. These cover space with the fewest points of all lattices (Kershner, 1939; Bambah, 1954).

What lies outside the pool cannot be run, and need not be. With n steps along an axis, both faces
of the cube stand on the grid. A mirror in the face 0 takes index i to -i, one in the face 1 takes
it to 2 n - i; both keep it even or odd, so the lattice is its own image. Fold space into the cube
by these mirrors: no two places get farther apart, places in the cube stay, and lattice points
become lattice points in the cube. So let c be in the cube, be it in a corner, and p the nearest
point of the infinite lattice, at most the covering radius away: p folded is a point of the lattice
in the cube that is no farther from c. The points in the closed cube alone cover it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from merge_sumo.errors import UserError
from merge_sumo.values.case import FloatArray

SLACK: Final = 1e-9
"""Share of the radius that is left for rounding."""
MOST_POINTS: Final = 3_000_000
"""What is run in an hour or so; a smaller radius takes more."""


@dataclass(frozen=True, slots=True)
class Covering:
    """A covering lattice of the unit cube; raises `UserError` for steps that make none.

    Attributes:
        steps: of the grid along each axis, 1 / steps apart; in three dimensions all the same.
    """

    steps: tuple[int, ...]

    def __post_init__(self) -> None:
        """Check the numbers."""
        same = len(self.steps) == 2 or len(set(self.steps)) == 1
        if len(self.steps) not in (2, 3) or min(self.steps) < 1 or not same:
            raise UserError(f"there is no covering lattice with steps {self.steps}")

    @property
    def radius(self) -> float:
        """The covering radius: no place of the cube is farther from a point.

        In the plane the nearest points are corners of triangles with two sides of squared length
        p^2 + h^2 and a base of 2 p, p <= h the distances of the grid: they are acute, so the place
        that is farthest from their corners is the centre of their circle, (p^2 + h^2) / (2 h). In
        space it is the corner of the truncated octahedron around a point, sqrt(5) / 4 times the
        edge of the cube, which is two steps long.
        """
        p, h = sorted(1.0 / n for n in self.steps[:2])
        return (p * p + h * h) / (2.0 * h) if len(self.steps) == 2 else math.sqrt(5.0) / 2.0 * p

    def __len__(self) -> int:
        """The number of points."""
        return self._evens + math.prod(self._shape(1))

    def points(self, first: int, end: int) -> FloatArray:
        """Return points `first` to `end` - 1, (n, d), as far as there are any."""
        numbers = np.arange(first, min(end, len(self)))
        parts = [
            np.stack(np.unravel_index(part, self._shape(odd)), axis=-1) * 2 + odd
            for odd, part in (
                (0, numbers[numbers < self._evens]),
                (1, numbers[numbers >= self._evens] - self._evens),
            )
        ]
        points: FloatArray = np.concatenate(parts) / np.array(self.steps, dtype=np.float64)
        return points

    @property
    def _evens(self) -> int:
        return math.prod(self._shape(0))

    def _shape(self, odd: int) -> tuple[int, ...]:
        """Return how many even, or odd, indices there are from 0 to the steps of each axis."""
        return tuple((n + 1) // 2 if odd else n // 2 + 1 for n in self.steps)


def covering(radius: float, dimensions: int) -> Covering:
    """Return the lattice with the fewest points that covers the unit square or cube.

    Raises `UserError` for a radius that is none, or that takes more than `MOST_POINTS`, and for
    more than three dimensions.
    """
    if dimensions not in (2, 3):
        raise UserError(
            f"the pool has {dimensions} coordinates: a covering lattice is known to be the best in "
            "two and three, and takes too many cases in more; narrow the scenario"
        )
    if not 0.0 < radius <= 0.5:
        raise UserError(f"--radius is {radius}: it is a share of the axes, above 0 and up to 0.5")
    least = 0.8 * (0.5 / radius) ** dimensions
    reach = radius * (1.0 - SLACK)
    if least > MOST_POINTS:
        raise _too_many(radius, least)
    if dimensions == 3:
        found = Covering((math.ceil(math.sqrt(5.0) / 2.0 / reach),) * 3)
    else:
        # From the steps of one axis follow those of the other: h^2 - 2 r h + p^2 <= 0.
        choices = []
        for n in range(math.ceil(1.0 / reach), 2 * math.ceil(1.0 / reach) + 1):
            highest = reach + math.sqrt(max(reach * reach - 1.0 / (n * n), 0.0))
            choices.append(Covering((n, math.ceil(1.0 / highest))))
        found = min(choices, key=len)
    if len(found) > MOST_POINTS:
        raise _too_many(radius, len(found))
    return found


def _too_many(radius: float, points: float) -> UserError:
    return UserError(
        f"--radius is {radius}: it takes {points:.2g} cases and more at a level, of which "
        f"{MOST_POINTS:,} are the most; choose a larger one"
    )
