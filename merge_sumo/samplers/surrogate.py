"""The Gaussian processes of `coverage`: P(fail) from a learned margin.

The kernel is var * prod_j k_j(|z_j - z'_j| / l_j) in coordinates z = Q^T x. The rotation Q turns
the first axis along the mean slope of the margin: who goes first changes across a slanted curve,
and a process that may be short across it and long along it needs fewer cases. k_j is Matern 3/2;
a process that is `rough` has Matern 1/2 along the first axis, where the margin may jump.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize
from scipy.spatial import cKDTree
from scipy.special import log_ndtr, ndtr

from merge_sumo.samplers.history import LevelHistory
from merge_sumo.scenario.case import FloatArray

LEARN_FROM: Final = 150
"""Most cases for the parameters of the kernel, SPACING apart."""
SPACING: Final = 0.02
"""Cases that close on both sides of a jump would make the whole field look rough."""
NOISE: Final = 1e-3
"""Variance of the observation noise: it keeps matrices with close cases invertible."""
LOG_PRIOR_VARIANCE: Final = (np.log(4.0), 1.5)
LOG_PRIOR_LENGTH: Final = (np.log(0.4), 1.0)
LOG_PRIOR_NOISE: Final = (np.log(0.1), 1.5)
"""Mean and standard deviation of the logarithms of the parameters before anything is known."""
VARIANCE_BOUNDS: Final = (1e-2, 1e3)
NOISE_BOUNDS: Final = (NOISE, 1e2)
LENGTH_BOUNDS: Final = (0.03, 10.0)
TREND: Final = 4.0
"""Prior variance of the plane to which a branch goes back."""
CLIPPED: Final = 2.0
"""Margins are clipped at this for the slope, which is sought near the failures."""
ITERATIONS: Final = 25
UNCHECKED: Final = {"check_finite": False}
"""For LAPACK: all matrices are of finite numbers."""
BLOCK: Final = 128
"""Queries per block of covariances: so many fit into the cache of a core."""


class Process:
    """A Gaussian process on values, with leave-one-out predictions."""

    def __init__(
        self,
        points: FloatArray,
        values: FloatArray,
        rotation: FloatArray,
        *,
        rough: bool = False,
        trend: float = 0.0,
        noisy: bool = False,
    ) -> None:
        """Learn `values`, (N,), at `points`, (N, d).

        `trend` is the prior variance of a plane to which the process goes back far from all cases.
        The values of one that is `noisy` differ from run to run: it learns their noise, too, and
        predicts the value of a run.
        """
        self._rotation, self._rough, self._trend = rotation, rough, trend
        self._values = values
        self._points = points @ rotation
        some = spaced(points, SPACING, LEARN_FROM)
        seen = self._points[some]
        plane = trend * (1.0 + seen @ seen.T)
        self._variance, self._lengths, noise = _learn_kernel(
            seen, values[some], plane, rough, noisy=noisy
        )
        self._of_runs = noise if noisy else 0.0
        gram = self._covariance(self._points) + noise * np.eye(len(points))
        self._factor = cholesky(gram, lower=True, **UNCHECKED)
        self._alpha = cho_solve((self._factor, True), values, **UNCHECKED)

    def left_out(self) -> tuple[FloatArray, FloatArray]:
        """Return mean and variance at each case, (N,), as seen by all the others.

        Leave-one-out predictions in closed form: Rasmussen and Williams (2006), eq. (5.12).
        """
        inverse = solve_triangular(self._factor, np.eye(len(self._factor)), lower=True, **UNCHECKED)
        precision = np.square(inverse).sum(axis=0)
        return self._values - self._alpha / precision, 1.0 / precision

    def at(self, queries: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean and variance at queries, (m, d), as (m,)."""
        turned = queries @ self._rotation
        cross = self._covariance(turned)
        explained = solve_triangular(self._factor, cross, lower=True, **UNCHECKED)
        prior = self._variance + self._trend * (1.0 + np.square(turned).sum(axis=1))
        prior = prior + self._of_runs
        return cross.T @ self._alpha, prior - np.square(explained).sum(axis=0)

    def _covariance(self, others: FloatArray) -> FloatArray:
        covariance: FloatArray = np.empty((len(self._points), len(others)))
        for first in range(0, len(others), BLOCK):
            block = slice(first, first + BLOCK)
            apart = _apart(self._points, others[block])
            correlation, _ = _correlation(apart, self._lengths, self._rough)
            covariance[:, block] = self._variance * correlation
        if self._trend:
            covariance += self._trend * (1.0 + self._points @ others.T)
        return covariance


class Margin:
    """A process on a margin of which an interval means failure."""

    def __init__(
        self,
        points: FloatArray,
        values: FloatArray,
        low: float,
        high: float,
        *,
        rough: bool,
        noisy: bool = False,
    ) -> None:
        """Learn `values`, (N,), at `points`, (N, d); between `low` and `high` a case fails."""
        self._interval = low, high
        self.rotation = _rotation(points, values)
        self.process = Process(points, values, self.rotation, rough=rough, noisy=noisy)

    def left_out(self) -> FloatArray:
        """Return for each case, (N,), its probability of failing as seen by all the others."""
        return self.probability(*self.process.left_out())

    def at(self, queries: FloatArray) -> FloatArray:
        """Return the probability of failing at queries, (m, d)."""
        return self.probability(*self.process.at(queries))

    def probability(self, mean: FloatArray, variance: FloatArray) -> FloatArray:
        """Return the probability of failing, (m,), where the process has that mean and variance."""
        low, high = self._interval
        deviation = _deviation(variance)
        return np.asarray(
            ndtr((high - mean) / deviation) - ndtr((low - mean) / deviation), dtype=np.float64
        )


class Branches:
    """Two processes on the margin, one for each sign of it: the margin may jump in between.

    A process over both signs tells which one a case has. There it fails where the size of the
    margin, which the cases of this sign predict, is below 1. So a failure is expected where a
    branch comes down to the failing interval before the other one takes over, and none where the
    margin jumps over it.
    """

    def __init__(
        self, points: FloatArray, values: FloatArray, both: Margin, *, noisy: bool = False
    ) -> None:
        """Learn `values`, (N,), at `points`, (N, d), as `both` has: from -1 to 1 a case fails."""
        self._points, self._positive, self._both = points, values >= 0.0, both.process
        self._branches = [
            Process(points[of], np.abs(values[of]), both.rotation, trend=TREND, noisy=noisy)
            for of in (~self._positive, self._positive)
        ]

    def left_out(self) -> FloatArray:
        """Return for each case, (N,), its probability of failing as seen by all the others."""
        failing = []
        for branch, of in zip(self._branches, (~self._positive, self._positive), strict=True):
            chance = np.empty(len(self._points))
            chance[of] = _below_one(*branch.left_out())
            chance[~of] = _below_one(*branch.at(self._points[~of]))
            failing.append(chance)
        return self._mixed(failing, self._both.left_out())

    def at(
        self, queries: FloatArray, sign: tuple[FloatArray, FloatArray] | None = None
    ) -> FloatArray:
        """Return the probability of failing at queries, (m, d).

        `sign` is what the process over both signs says of them, where that is known.
        """
        failing = [_below_one(*branch.at(queries)) for branch in self._branches]
        return self._mixed(failing, self._both.at(queries) if sign is None else sign)

    def _mixed(self, failing: list[FloatArray], sign: tuple[FloatArray, FloatArray]) -> FloatArray:
        mean, variance = sign
        positive = ndtr(mean / _deviation(variance))
        return np.asarray((1.0 - positive) * failing[0] + positive * failing[1], dtype=np.float64)


def _deviation(variance: FloatArray) -> FloatArray:
    return np.sqrt(np.maximum(variance, 1e-12))


def _below_one(mean: FloatArray, variance: FloatArray) -> FloatArray:
    """Return P(g < 1) of a normal g that is known to be positive."""
    deviation = _deviation(variance)
    above = log_ndtr((mean - 1.0) / deviation) - log_ndtr(mean / deviation)
    return np.asarray(-np.expm1(above), dtype=np.float64)


def spaced(points: FloatArray, spacing: float, most: int) -> NDArray[np.int64]:
    """Return the places of at most `most` points, the first ones that lie `spacing` apart."""
    tree = cKDTree(points)
    free = np.ones(len(points), dtype=bool)
    kept: list[int] = []
    for place in range(len(points)):
        if free[place] and len(kept) < most:
            kept.append(place)
            free[tree.query_ball_point(points[place], spacing)] = False
    return np.array(kept, dtype=np.int64)


def most_telling(history: LevelHistory, most: int) -> LevelHistory:
    """Return at most `most` cases: half of them the worst ones, half spread over the rest."""
    if len(history.points) <= most:
        return history
    order = np.argsort(history.margin, kind="stable")
    half = most // 2
    rest = np.sort(order[half:])
    evenly = np.linspace(0, len(rest) - 1, half).round().astype(np.int64)
    return history.take(np.sort(np.concatenate([order[:half], rest[evenly]])))


def _rotation(points: FloatArray, values: FloatArray) -> FloatArray:
    """Return an orthonormal matrix, (d, d), whose first column is the mean slope of the values."""
    dims = points.shape[1]
    centred = points - points.mean(axis=0)
    clipped = np.clip(values, -CLIPPED, CLIPPED)
    gram = centred.T @ centred + 1e-3 * len(points) * np.eye(dims)
    slope = np.linalg.solve(gram, centred.T @ (clipped - clipped.mean()))
    steepness = float(np.linalg.norm(slope))
    if steepness < 1e-9:
        return np.eye(dims)
    axes, _ = np.linalg.qr(np.column_stack([slope / steepness, np.eye(dims)]))
    return np.asarray(axes[:, :dims], dtype=np.float64)


def _apart(points: FloatArray, others: FloatArray) -> list[FloatArray]:
    """Return for each coordinate how far points are apart, (n, m)."""
    return [np.abs(mine[:, None] - theirs) for mine, theirs in zip(points.T, others.T, strict=True)]


def _correlation(
    apart: Sequence[FloatArray], lengths: FloatArray, rough: bool
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the correlations, (n, m), and for each coordinate the scaled distances, (n, m)."""
    roots = np.where(rough & (np.arange(len(lengths)) == 0), 1.0, np.sqrt(3.0))
    factors = (roots / lengths).tolist()
    scaled = [factor * distance for factor, distance in zip(factors, apart, strict=True)]
    correlation: FloatArray = np.exp(-reduce(np.add, scaled))
    for distance in scaled[rough:]:
        correlation *= 1.0 + distance
    return correlation, scaled


def _learn_kernel(
    points: FloatArray, values: FloatArray, plane: FloatArray, rough: bool, *, noisy: bool
) -> tuple[float, FloatArray, float]:
    """Return variance, lengths, (d,), and noise of the largest posterior density.

    `plane` is the covariance, (n, n), of the prior plane. The noise of a process that is not
    `noisy` is NOISE.
    """
    n, dims = points.shape
    fixed, identity, apart = plane + NOISE * np.eye(n), np.eye(n), _apart(points, points)
    priors = np.array([LOG_PRIOR_VARIANCE, *[LOG_PRIOR_LENGTH] * dims, *[LOG_PRIOR_NOISE] * noisy])
    bounds = np.log([VARIANCE_BOUNDS, *[LENGTH_BOUNDS] * dims, *[NOISE_BOUNDS] * noisy])

    def loss(logs: FloatArray) -> tuple[float, FloatArray]:
        """Rasmussen and Williams (2006), eq. (2.30) and (5.9), with the prior."""
        correlation, scaled = _correlation(apart, np.exp(logs[1 : 1 + dims]), rough)
        covariance = np.exp(logs[0]) * correlation
        with_noise = plane + np.exp(logs[-1]) * identity if noisy else fixed
        factor = cholesky(covariance + with_noise, lower=True, **UNCHECKED)
        alpha = cho_solve((factor, True), values, **UNCHECKED)
        inverse = cho_solve((factor, True), identity, **UNCHECKED)
        unexplained = inverse - np.outer(alpha, alpha)
        weights = unexplained * covariance
        # d log k_j / d log l_j: u of Matern 1/2, u^2 / (1 + u) of Matern 3/2.
        steep = [u if rough and axis == 0 else u * u / (1.0 + u) for axis, u in enumerate(scaled)]
        slopes = [weights.sum(), *((weights * slope).sum() for slope in steep)]
        if noisy:
            slopes.append(np.exp(logs[-1]) * np.trace(unexplained))
        off = (logs - priors[:, 0]) / priors[:, 1]
        value = 0.5 * (values @ alpha + off @ off) + np.log(np.diag(factor)).sum()
        return float(value), 0.5 * np.array(slopes) + off / priors[:, 1]

    optimum = minimize(
        loss,
        priors[:, 0],
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": ITERATIONS},
    )
    parameters = np.exp(optimum.x)
    noise = float(parameters[-1]) if noisy else NOISE
    return float(parameters[0]), np.asarray(parameters[1 : 1 + dims], dtype=np.float64), noise
