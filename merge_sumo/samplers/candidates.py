"""Candidate cases: uniform, near failures, between safe cases, on the faces of the unit cube."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from merge_sumo.metrics.fmc import IntArray, radius_for
from merge_sumo.samplers.surrogate import Surrogate
from merge_sumo.scenario.case import FloatArray

# Reach of candidates around a failure, and around the best candidates, in radii of the FMC.
LOCAL_REACH = 2.0
REFINED_REACH = 0.6


def surrogate_candidates(surrogate: Surrogate, n: int, rng: np.random.Generator) -> FloatArray:
    """Draw candidates by the surrogate alone.

    Args:
        surrogate: surrogate of the level.
        n: size of the batch.
        rng: random generator.

    Returns:
        Points, (m, d), more than `n`.
    """
    history = surrogate.history
    centres = history.failing
    if not len(centres):
        # The worst cases stand in for failures.
        centres = history.points[np.argsort(history.margin, kind="stable")[:20]]
    # 40 lines of 120 points across the cube along the mean slope of the learned values.
    steps = np.linspace(-1.0, 1.0, 120) + rng.uniform(-0.01, 0.01, (40, 120))
    lines = rng.random((40, 1, history.dims)) + steps[..., None] * surrogate.gap_axis
    lines = lines.reshape(-1, history.dims)
    uniform = rng.random((1500 + n, history.dims))
    near = around(centres, 600, LOCAL_REACH * radius_for(history.dims), rng)
    inside = lines[((lines >= 0.0) & (lines <= 1.0)).all(axis=1)]
    return np.concatenate([uniform, near, between(surrogate, 600, rng), inside])


def around(points: FloatArray, n: int, reach: float, rng: np.random.Generator) -> FloatArray:
    """Draw points near others.

    Args:
        points: centres, (m, d).
        n: number of points.
        reach: largest distance from a centre.
        rng: random generator.

    Returns:
        Points of the unit cube, (n, d).
    """
    centres = points[rng.integers(len(points), size=n)]
    direction = rng.standard_normal(centres.shape)
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    return np.clip(centres + reach * np.sqrt(rng.random((n, 1))) * direction, 0.0, 1.0)


def between(surrogate: Surrogate, n: int, rng: np.random.Generator) -> FloatArray:
    """Draw points between safe cases of the two merging orders, most in narrow brackets.

    Args:
        surrogate: surrogate of the level, which knows the safe cases of either order.
        n: number of points.
        rng: random generator.

    Returns:
        Points, (n, d); (0, d) without safe cases of both orders.
    """
    points = surrogate.history.points
    _, vut_first, pov_first = surrogate.groups
    before, after = points[vut_first], points[pov_first]
    if not (len(before) and len(after)):
        return np.empty((0, points.shape[1]))
    near = range(1, 1 + min(3, len(before), len(after)))
    pairs = np.concatenate([_pairs(before, after, near), _pairs(after, before, near)[:, ::-1]])
    first, second = before[pairs[:, 0]], after[pairs[:, 1]]
    reach = REFINED_REACH * radius_for(points.shape[1])
    weight = (np.linalg.norm(first - second, axis=1) + reach) ** -2.0
    chosen = rng.choice(len(pairs), size=n, p=weight / weight.sum())
    part = rng.random((n, 1))
    points_between: FloatArray = first[chosen] * (1.0 - part) + second[chosen] * part
    return points_between


def spread_out(n: int, dims: int, rng: np.random.Generator) -> FloatArray:
    """Draw the first points of a scrambled Halton sequence.

    Args:
        n: number of points.
        dims: their number of coordinates, d.
        rng: generator of the scrambling.

    Returns:
        Points, (n, d).
    """
    from scipy.stats.qmc import Halton

    points: FloatArray = Halton(dims, seed=rng).random(n)
    return points


def anywhere(n: int, dims: int, rng: np.random.Generator) -> FloatArray:
    """Draw uniform points, 15 % of them on the faces and edges of the unit cube.

    Args:
        n: number of points.
        dims: their number of coordinates, d.
        rng: random generator.

    Returns:
        Points, (n, d).
    """
    points = rng.random((n, dims))
    on_face = rng.random(points.shape) < 0.15 / dims
    return np.where(on_face, rng.integers(0, 2, points.shape), points)


def _pairs(points: FloatArray, others: FloatArray, near: Sequence[int]) -> IntArray:
    """Return pairs (index of a point, index of its k-th nearest neighbour), (m, 2), for each k."""
    _, index = cKDTree(others).query(points, k=list(near))
    return np.column_stack([np.repeat(np.arange(len(points)), len(near)), index.ravel()])
