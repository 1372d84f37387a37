"""Gaussian process regression with leave-one-out predictions.

Source: Rasmussen and Williams (2006), Gaussian Processes for Machine Learning.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from merge_sumo.metrics.fmc import IntArray
from merge_sumo.scenario.case import FloatArray

# Variance of the observation noise: it keeps matrices with close cases invertible.
NOISE = 1e-3


class GaussianProcess:
    """A Gaussian process of mean 0 on values at points of the unit cube.

    The kernel is var * prod_j k_j(|z_j - z'_j| / l_j) in coordinates z = Q^T x. k_j is Matern 3/2;
    a process that is `rough` has Matern 1/2 along the first axis, where values may jump. The
    rotation Q turns that axis along the mean slope of the values: the merging order changes across
    a slanted curve, and a process with a short length across it and a long one along it needs fewer
    cases.

    Attributes:
        rotation: Q, orthonormal, (d, d); the first column is the direction of the mean slope of the
            values.

    Example:
        mean, variance = GaussianProcess(points, values).predict(queries)
    """

    def __init__(
        self, points: FloatArray, values: FloatArray, *, rough: bool = False, noisy: bool = False
    ) -> None:
        """Learn values at points.

        Args:
            points: points of the unit cube, (N, d).
            values: values of any unit, (N,).
            rough: whether values may jump along the first axis.
            noisy: whether values differ from run to run. Then the variance of their noise is
                learned, too, and `predict` predicts a run.
        """
        self.rotation = _rotation(points, values)
        self._values, self._rough = values, rough
        self._points = points @ self.rotation
        # The parameters of the kernel follow from at most 150 cases, .02 apart: close cases on both
        # sides of a jump would make the whole field look rough.
        subset = spaced(points, 0.02, 150)
        self._variance, self._lengths, noise = _learn_kernel(
            self._points[subset], values[subset], rough=rough, noisy=noisy
        )
        self._run_noise = noise if noisy else 0.0
        gram = self._covariance(self._points) + noise * np.eye(len(points))
        self._factor = cholesky(gram, lower=True, check_finite=False)
        self._alpha = cho_solve((self._factor, True), values, check_finite=False)

    def leave_one_out(self) -> tuple[FloatArray, FloatArray]:
        """Predict the value at each point from all other points; eq. (5.12).

        Returns:
            Means and variances, (N,) each.
        """
        identity = np.eye(len(self._factor))
        inverse = solve_triangular(self._factor, identity, lower=True, check_finite=False)
        precision = np.square(inverse).sum(axis=0)
        return self._values - self._alpha / precision, 1.0 / precision

    def predict(self, queries: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Predict values.

        Args:
            queries: points of the unit cube, (m, d).

        Returns:
            Means and variances, (m,) each.
        """
        cross = self._covariance(queries @ self.rotation)
        root = solve_triangular(self._factor, cross, lower=True, check_finite=False)
        explained = np.square(root).sum(axis=0)
        return cross.T @ self._alpha, self._variance + self._run_noise - explained

    def _covariance(self, queries: FloatArray) -> FloatArray:
        covariance: FloatArray = np.empty((len(self._points), len(queries)))
        # Blocks of 128 queries fit into the cache of a core.
        for first in range(0, len(queries), 128):
            block = slice(first, first + 128)
            scaled = _scaled_distances(self._points, queries[block], self._lengths, self._rough)
            covariance[:, block] = self._variance * _correlation(scaled, self._rough)
        return covariance


def spaced(points: FloatArray, spacing: float, most: int) -> IntArray:
    """Choose the first points that lie apart.

    Args:
        points: points in the order of preference, (N, d).
        spacing: least distance of two chosen points.
        most: largest number of points.

    Returns:
        Indices of the chosen points in rising order.
    """
    tree = cKDTree(points)
    free = np.ones(len(points), dtype=bool)
    kept: list[int] = []
    for index in range(len(points)):
        if free[index] and len(kept) < most:
            kept.append(index)
            free[tree.query_ball_point(points[index], spacing)] = False
    return np.array(kept, dtype=np.int64)


def _rotation(points: FloatArray, values: FloatArray) -> FloatArray:
    """Return an orthonormal matrix, (d, d), whose first column is the mean slope of the values."""
    dims = points.shape[1]
    centred = points - points.mean(axis=0)
    # The slope near failures counts.
    clipped = np.clip(values, -2.0, 2.0)
    gram = centred.T @ centred + 1e-3 * len(points) * np.eye(dims)
    slope = np.linalg.solve(gram, centred.T @ (clipped - clipped.mean()))
    steepness = float(np.linalg.norm(slope))
    if steepness < 1e-9:
        return np.eye(dims)
    axes, _ = np.linalg.qr(np.column_stack([slope / steepness, np.eye(dims)]))
    return axes[:, :dims]


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
    # Prior medians of the parameters, prior standard deviations of their logarithms, and bounds.
    settings = [(4.0, 1.5, 1e-2, 1e3), *[(0.4, 1.0, 0.03, 10.0)] * dims]
    if noisy:
        settings.append((0.1, 1.5, NOISE, 1e2))
    median, deviation, low, high = np.array(settings).T
    mean = np.log(median)

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
        off = (logs - mean) / deviation
        value = 0.5 * (values @ alpha + off @ off) + np.log(np.diag(factor)).sum()
        return float(value), 0.5 * np.array(slopes) + off / deviation

    bounds = np.log(np.column_stack([low, high]))
    options = {"maxiter": 25}
    optimum = minimize(loss, mean, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    variance, *lengths = np.exp(optimum.x).tolist()
    noise = lengths.pop() if noisy else NOISE
    return variance, np.array(lengths), noise
