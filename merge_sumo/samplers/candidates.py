"""Candidate cases: uniform, near failures, between safe cases, on the faces of the unit cube."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from merge_sumo.metrics.fmc import radius_for
from merge_sumo.samplers.failure_probability import FailureProbability
from merge_sumo.scenario.case import FloatArray

UNIFORM_QUERIES: Final = 1500
LOCAL_QUERIES: Final = 600
BETWEEN_QUERIES: Final = 600
WORST: Final = 20
LINES: Final = 40
LINE_STEPS: Final = 120
"""Candidates of the surrogate: uniform, within LOCAL_REACH of a failure (or of the WORST cases),
between safe cases of the two merging orders, and on lines across the cube along the slope of what
is learned."""
LOCAL_REACH: Final = 2.0
"""Reach of candidates around a failure, in radii of the FMC."""
REFINED_REACH: Final = 0.6
"""Reach of candidates around the best candidates, in radii of the FMC."""


def surrogate_candidates(
    surrogate: FailureProbability, n: int, rng: np.random.Generator
) -> FloatArray:
    """Return more than `n` candidates, (m, d), of the surrogate alone."""
    history = surrogate.history
    centres = history.points[history.failed]
    if not len(centres):
        centres = history.points[np.argsort(history.margin, kind="stable")[:WORST]]
    steps = np.linspace(-1.0, 1.0, LINE_STEPS) + rng.uniform(-0.01, 0.01, (LINES, LINE_STEPS))
    lines = rng.random((LINES, 1, history.dims)) + steps[..., None] * surrogate.slope
    lines = lines.reshape(-1, history.dims)
    return np.concatenate(
        [
            rng.random((UNIFORM_QUERIES + n, history.dims)),
            around(centres, LOCAL_QUERIES, LOCAL_REACH * radius_for(history.dims), rng),
            between(surrogate, BETWEEN_QUERIES, rng),
            lines[((lines >= 0.0) & (lines <= 1.0)).all(axis=1)],
        ]
    )


def around(points: FloatArray, n: int, reach: float, rng: np.random.Generator) -> FloatArray:
    """Return `n` points of the unit cube, (n, d), within `reach` of some of the points."""
    centres = points[rng.integers(len(points), size=n)]
    direction = rng.standard_normal(centres.shape)
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    return np.clip(centres + reach * np.sqrt(rng.random((n, 1))) * direction, 0.0, 1.0)


def between(surrogate: FailureProbability, n: int, rng: np.random.Generator) -> FloatArray:
    """Return `n` points, (n, d), between safe cases of the two orders, most in narrow brackets.

    Empty, (0, d), without safe cases of both orders.
    """
    points = surrogate.history.points
    _, before, behind = (points[group] for group in surrogate.groups)
    if not (len(before) and len(behind)):
        return np.empty((0, points.shape[1]))
    near = [*range(1, 1 + min(3, len(before), len(behind)))]
    pairs = np.concatenate([_pairs(before, behind, near), _pairs(behind, before, near)[:, ::-1]])
    first, second = before[pairs[:, 0]], behind[pairs[:, 1]]
    reach = REFINED_REACH * radius_for(points.shape[1])
    weight = (np.linalg.norm(first - second, axis=1) + reach) ** -2.0
    chosen = rng.choice(len(pairs), size=n, p=weight / weight.sum())
    part = rng.random((n, 1))
    return np.asarray(first[chosen] * (1.0 - part) + second[chosen] * part, dtype=np.float64)


def spread_out(n: int, dims: int, rng: np.random.Generator) -> FloatArray:
    """Return `n` points, (n, d), of a scrambled Halton sequence."""
    from scipy.stats.qmc import Halton

    return np.asarray(Halton(dims, seed=rng).random(n), dtype=np.float64)


def anywhere(n: int, dims: int, on_faces: float, rng: np.random.Generator) -> FloatArray:
    """Return `n` points of the unit cube, (n, d), a share of them on its faces and edges."""
    points = rng.random((n, dims))
    on_face = rng.random(points.shape) < on_faces / dims
    return np.where(on_face, rng.integers(0, 2, points.shape), points)


def _pairs(points: FloatArray, others: FloatArray, near: list[int]) -> NDArray[np.int64]:
    """Return pairs (index, index of one of its nearest neighbours), (m, 2)."""
    _, place = cKDTree(others).query(points, k=near)
    return np.column_stack([np.repeat(np.arange(len(points)), len(near)), place.ravel()])
