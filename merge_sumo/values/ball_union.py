"""Volume of a union of unit balls in four dimensions and more, where no closed form is at hand.

Each point of the union belongs to its nearest centre. So the union falls apart into one piece for
each centre, its ball cut off by its Voronoi cell, and the piece is star-shaped around the centre:
in direction u it ends where the nearest of the other centres takes over, or at the surface of the
ball. The volume of a piece is that of a ball times the mean of (distance to its end)^d over the
directions. The radial part is exact, and what is left to integrate is continuous: a lone ball is
exact, and quasi-Monte Carlo over the directions does well (`star_volume`).

Where there are thousands of centres, or a heap of them, most lie deep inside and have next to
nothing of their own. Then cells of space are looked at instead: those inside or outside of the
union are told by the distance of their middle to the nearest centre, those at its surface are
halved for a while and then sampled (`cell_volume`).

Lengths are in radii. All of it is deterministic.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

FloatArray = NDArray[np.float64]

MOST_STARS: Final = 4000
"""Up to so many centres directions are integrated over, and cells looked at beyond."""
GOOD: Final = 1e-3
"""Standard error, as a share of the volume, with which directions are content."""
SCRAMBLINGS: Final = 8
"""Independent estimates, of which the mean is taken and the error seen."""
DIRECTIONS: Final = 1 << 15
"""Directions of each estimate, in all; each of them is looked at both ways."""
MOST_DIRECTIONS: Final = 1 << 12
"""The same, of one centre."""
NEIGHBOURS: Final = 17
"""Centres, with the one itself, that are looked at first; the nearest cut off most directions."""
FIRST_SIDE: Final = 2.0
"""Of the first cells: a ball then reaches into the cells next to that of its centre alone."""
CELLS: Final = 1 << 16
"""Cells at the surface beyond which they are not halved any more; as many points sample them."""
SEED: Final = 20210909
_SLACK: Final = 1e-9  # a centre nearer by less than this is the same one, found again


def ball_volume(dimension: int) -> float:
    """Return the volume of a ball of radius 1."""
    return math.exp(dimension / 2.0 * math.log(math.pi) - math.lgamma(dimension / 2.0 + 1.0))


def union_volume(centres: FloatArray) -> tuple[float, float]:
    """Return the volume of the union of unit balls and its standard error.

    Args:
        centres: distinct ones, (n, d), n > 0.
    """
    if len(centres) > MOST_STARS:
        return _mean(cell_volume(centres))
    volume, error = _mean(star_volume(centres))
    if error <= GOOD * volume:
        return volume, error
    # A heap: most of it is inside, as where there are many.
    return min((volume, error), _mean(cell_volume(centres)), key=lambda one: one[1])


def _mean(volumes: FloatArray) -> tuple[float, float]:
    return float(volumes.mean()), float(volumes.std(ddof=1)) / math.sqrt(len(volumes))


def star_volume(centres: FloatArray) -> FloatArray:
    """Return independent estimates, (SCRAMBLINGS,), of the volume of the union."""
    from scipy.special import ndtri
    from scipy.stats.qmc import Sobol

    n, dimension = centres.shape
    tree = cKDTree(centres)
    each = min(1 << max(DIRECTIONS // n, 1).bit_length() - 1, MOST_DIRECTIONS)
    # More than the power of two that a sequence likes, unless n is one: each centre has its own
    # stretch of it, which is balanced.
    rounded_up = 1 << (n * each - 1).bit_length()
    volumes = []
    for scrambling in range(SCRAMBLINGS):
        sequence = Sobol(dimension, seed=np.random.default_rng([SEED, scrambling]))
        uniform = sequence.random(rounded_up)[: n * each]
        # A point at 0 or 1 has no direction.
        normal = ndtri(0.5 + (1.0 - 1e-10) * (uniform - 0.5)).reshape(n, each, dimension)
        directions = normal / np.linalg.norm(normal, axis=2, keepdims=True)
        reach = _reaches(centres, tree, directions)
        volumes.append(ball_volume(dimension) * float((reach**dimension).mean(axis=1).sum()))
    return np.array(volumes)


def _reaches(centres: FloatArray, tree: cKDTree, directions: FloatArray) -> FloatArray:
    """Return how far each piece goes, at most 1, in directions and in the opposite ones, (n, 2m).

    Args:
        centres: (n, d).
        tree: of the centres.
        directions: m unit vectors for each, (n, m, d).
    """
    n = len(centres)
    near = np.arange(1, min(NEIGHBOURS, n) + 1)  # the first one is the centre itself
    # Balls 2 apart touch at most. Missing neighbours get the index n, and an infinite distance.
    distance, neighbour = tree.query(centres, k=near, distance_upper_bound=2.0)
    absent = neighbour == n
    apart = centres[np.where(absent, 0, neighbour)] - centres[:, None]
    # The bisector of two centres d apart is reached at |d|^2 / (2 d u).
    squared = np.where(absent | (distance == 0.0), np.inf, np.square(distance))
    along = directions @ (2.0 * apart / squared[..., None]).transpose(0, 2, 1)
    ends = [along.max(axis=2, initial=1.0), (-along).max(axis=2, initial=1.0)]
    reach = 1.0 / np.concatenate(ends, axis=1)
    # A centre further away than twice the end does not come before it.
    complete = absent[:, -1] | (len(near) == n)
    known = np.where(complete, np.inf, distance[:, -1])
    piece, column = np.nonzero(reach > known[:, None] / 2.0)
    both = np.concatenate([directions, -directions], axis=1)[piece, column]
    reach[piece, column] = _cut_off(centres, tree, piece, both, reach[piece, column])
    return reach


def _cut_off(
    centres: FloatArray, tree: cKDTree, piece: NDArray[np.int64], u: FloatArray, reach: FloatArray
) -> FloatArray:
    """Return where pieces end in directions, (q,), given places, (q,), before which they do not.

    While another centre is nearer to the place than that of the piece, the end is at their bisector
    or before it.
    """
    reach = reach.copy()
    open_ = np.arange(len(piece))
    while len(open_):
        places = centres[piece[open_]] + reach[open_, None] * u[open_]
        distance, nearest = tree.query(places)
        nearer = distance < reach[open_] * (1.0 - _SLACK)
        open_ = open_[nearer]
        apart = centres[nearest[nearer]] - centres[piece[open_]]
        reach[open_] = np.square(apart).sum(axis=1) / (2.0 * (apart * u[open_]).sum(axis=1))
    return reach


def cell_volume(centres: FloatArray) -> FloatArray:
    """Return estimates, (SCRAMBLINGS,), of the volume of the union: the same but for the surface.

    Each samples the cells at the surface anew, with as many points in each (stratified sampling).
    """
    dimension = centres.shape[1]
    tree = cKDTree(centres)
    corners = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * dimension, indexing="ij"), axis=-1)
    halves = np.stack(np.meshgrid(*[[-0.25, 0.25]] * dimension, indexing="ij"), axis=-1)
    side = FIRST_SIDE
    occupied = np.unique(np.floor(centres / side), axis=0)[:, None] + corners.reshape(-1, dimension)
    middles = (np.unique(occupied.reshape(-1, dimension), axis=0) + 0.5) * side
    inside = 0.0
    while True:
        half_diagonal = side * math.sqrt(dimension) / 2.0
        distance, _ = tree.query(middles, distance_upper_bound=1.0 + half_diagonal)
        inside += side**dimension * float((distance <= 1.0 - half_diagonal).sum())
        middles = middles[np.abs(distance - 1.0) < half_diagonal]
        if len(middles) << dimension > 2 * CELLS:
            break
        middles = (middles[:, None] + side * halves.reshape(-1, dimension)).reshape(-1, dimension)
        side /= 2.0
    each = max(1, CELLS // len(middles))
    volumes = []
    for scrambling in range(SCRAMBLINGS):
        rng = np.random.default_rng([SEED, scrambling])
        covered = 0
        for _ in range(each):
            places = middles + side * (rng.random(middles.shape) - 0.5)
            distance, _ = tree.query(places, distance_upper_bound=1.0)
            covered += int((distance < 1.0).sum())
        volumes.append(inside + side**dimension * covered / each)
    return np.array(volumes)
