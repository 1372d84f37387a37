"""Gaussian process regression with leave-one-out predictions.

The kernel is var * prod_j k_j(|z_j - z'_j| / l_j) in coordinates z = Q^T x. k_j is Matern 3/2; a
process that is `rough` has Matern 1/2 along the first axis, where values may jump. The rotation Q
turns that axis along the mean slope of the values: the merging order changes across a slanted
curve, and a process that may be short across it and long along it needs fewer cases.

Source: Rasmussen and Williams (2006), Gaussian Processes for Machine Learning.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize
from scipy.spatial import cKDTree

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
"""Prior mean and standard deviation of the logarithms of the parameters."""
VARIANCE_BOUNDS: Final = (1e-2, 1e3)
NOISE_BOUNDS: Final = (NOISE, 1e2)
LENGTH_BOUNDS: Final = (0.03, 10.0)
CLIPPED: Final = 2.0
"""Values are clipped at this for the slope, which is sought near the failures."""
ITERATIONS: Final = 25
BLOCK: Final = 128
"""Queries per block of covariances: so many fit into the cache of a core."""


class GaussianProcess:
    """A Gaussian process of mean 0 on values at points of the unit cube.

    Attributes:
        rotation: orthonormal, (d, d); the first column is the mean slope of the values.
    """

    def __init__(
        self, points: FloatArray, values: FloatArray, *, rough: bool = False, noisy: bool = False
    ) -> None:
        """Learn values at points.

        Args:
            points: (N, d).
            values: (N,).
            rough: whether values may jump along the first axis.
            noisy: whether values differ from run to run: then their noise is learned, too, and the
                value of a run is predicted.
        """
        self.rotation = _rotation(points, values)
        self._values, self._rough = values, rough
        self._points = points @ self.rotation
        subset = spaced(points, SPACING, LEARN_FROM)
        self._variance, self._lengths, noise = _learn_kernel(
            self._points[subset], values[subset], rough=rough, noisy=noisy
        )
        self._run_noise = noise if noisy else 0.0
        gram = self._covariance(self._points) + noise * np.eye(len(points))
        self._factor = cholesky(gram, lower=True, check_finite=False)
        self._alpha = cho_solve((self._factor, True), values, check_finite=False)

    def leave_one_out(self) -> tuple[FloatArray, FloatArray]:
        """Return mean and variance at each case, (N,), predicted from all others; eq. (5.12)."""
        inverse = _solve(self._factor, np.eye(len(self._factor)))
        precision = np.square(inverse).sum(axis=0)
        return self._values - self._alpha / precision, 1.0 / precision

    def predict(self, queries: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean and variance at queries, (m, d), as (m,)."""
        cross = self._covariance(queries @ self.rotation)
        explained = np.square(_solve(self._factor, cross)).sum(axis=0)
        return cross.T @ self._alpha, self._variance + self._run_noise - explained

    def _covariance(self, queries: FloatArray) -> FloatArray:
        covariance: FloatArray = np.empty((len(self._points), len(queries)))
        for first in range(0, len(queries), BLOCK):
            block = slice(first, first + BLOCK)
            scaled = _scaled_distances(self._points, queries[block], self._lengths, self._rough)
            covariance[:, block] = self._variance * _correlation(scaled, self._rough)
        return covariance


def spaced(points: FloatArray, spacing: float, most: int) -> NDArray[np.int64]:
    """Return the indices of at most `most` points, the first ones that lie `spacing` apart."""
    tree = cKDTree(points)
    free = np.ones(len(points), dtype=bool)
    kept: list[int] = []
    for index in range(len(points)):
        if free[index] and len(kept) < most:
            kept.append(index)
            free[tree.query_ball_point(points[index], spacing)] = False
    return np.array(kept, dtype=np.int64)


def _solve(factor: FloatArray, right: FloatArray) -> FloatArray:
    solution: FloatArray = solve_triangular(factor, right, lower=True, check_finite=False)
    return solution


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


def _scaled_distances(
    points: FloatArray, others: FloatArray, lengths: FloatArray, rough: bool
) -> list[FloatArray]:
    """Return for each coordinate the distances, (n, m), in units of its correlation."""
    factors = np.sqrt(3.0) / lengths
    if rough:
        factors[0] = 1.0 / lengths[0]
    scaled = []
    for axis, factor in enumerate(factors.tolist()):
        scaled.append(factor * np.abs(points[:, axis, None] - others[:, axis]))
    return scaled


def _correlation(scaled: list[FloatArray], rough: bool) -> FloatArray:
    """Return the product of the correlations, (n, m)."""
    total = scaled[0]
    for distance in scaled[1:]:
        total = total + distance
    correlation: FloatArray = np.exp(-total)
    for distance in scaled[rough:]:
        correlation *= 1.0 + distance
    return correlation


def _learn_kernel(
    points: FloatArray, values: FloatArray, *, rough: bool, noisy: bool
) -> tuple[float, FloatArray, float]:
    """Return variance, lengths, (d,), and noise of the largest posterior density.

    The noise of a process that is not `noisy` is NOISE.
    """
    n, dims = points.shape
    identity = np.eye(n)
    priors = np.array([LOG_PRIOR_VARIANCE, *[LOG_PRIOR_LENGTH] * dims, *[LOG_PRIOR_NOISE] * noisy])
    bounds = np.log([VARIANCE_BOUNDS, *[LENGTH_BOUNDS] * dims, *[NOISE_BOUNDS] * noisy])

    def loss(logs: FloatArray) -> tuple[float, FloatArray]:
        """Rasmussen and Williams (2006), eq. (2.30) and (5.9), with the prior."""
        scaled = _scaled_distances(points, points, np.exp(logs[1 : 1 + dims]), rough)
        covariance = np.exp(logs[0]) * _correlation(scaled, rough)
        noise = float(np.exp(logs[-1])) if noisy else NOISE
        factor = cholesky(covariance + noise * identity, lower=True, check_finite=False)
        alpha = cho_solve((factor, True), values, check_finite=False)
        inverse = cho_solve((factor, True), identity, check_finite=False)
        unexplained = inverse - np.outer(alpha, alpha)
        weights = unexplained * covariance
        slopes = [weights.sum()]
        for axis, u in enumerate(scaled):
            # d log k_j / d log l_j of Matern 1/2, and of Matern 3/2.
            slope = u if rough and axis == 0 else u * u / (1.0 + u)
            slopes.append((weights * slope).sum())
        if noisy:
            slopes.append(noise * np.trace(unexplained))
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
