"""The largest ball that no point has entered: what a search has not looked at.

The distance from a place of the unit cube to the nearest point changes by no more than one walks.
So a box whose middle is at a distance d holds no place farther than d and half its diagonal: boxes
that cannot hold a farther one than is known are done, the others are halved along each axis, until
they are so small that what is left decides nothing. No randomness, and any number of coordinates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from merge_sumo.values.case import FloatArray

EXACT: Final = 1e-3
"""What the radius may be too small by, as a share of it, where boxes suffice."""
MOST_BOXES: Final = 200_000
"""Boxes at a time; where more are left the radius is still one of an empty ball."""


@dataclass(frozen=True, slots=True)
class EmptyBall:
    """A ball with its centre in the unit cube that no point is inside of.

    Attributes:
        centre: its centre, one number per coordinate.
        radius: its radius.
        at_most: no larger ball than this is empty.
    """

    centre: tuple[float, ...]
    radius: float
    at_most: float


def largest_empty_ball(points: FloatArray) -> EmptyBall | None:
    """Return the largest ball that none of n points, (n, d), is inside of; None without points."""
    if not len(points):
        return None
    dims = points.shape[1]
    tree = cKDTree(points)
    centres, half = np.full((1, dims), 0.5), 0.5
    halves = np.array(list(product((-0.5, 0.5), repeat=dims)))
    best, radius = centres[0], 0.0
    while True:
        distance, _ = tree.query(centres)
        # Of places as far the first one: boxes are in order.
        farthest = int(distance.argmax())
        if distance[farthest] > radius:
            best, radius = centres[farthest], float(distance[farthest])
        reach = distance + half * math.sqrt(dims)
        left = reach > radius * (1.0 + EXACT)
        if not left.any() or left.sum() * len(halves) > MOST_BOXES:
            at_most = max(radius, float(reach.max()))
            return EmptyBall(tuple(best.tolist()), radius, at_most)
        centres = (centres[left][:, None] + half * halves).reshape(-1, dims)
        half /= 2.0
