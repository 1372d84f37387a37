"""The Gaussian process of `coverage`: a margin that is learned, and what it says of failing."""

from __future__ import annotations

import warnings
from typing import Any, Final

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.special import ndtr

from merge_sumo.case import FloatArray

LEARN_FROM: Final = 150
"""Cases from which the parameters of the kernel are learned, spread evenly over the history."""
NOISE: Final = 1e-4
"""Variance of the observation noise: it keeps matrices with close cases invertible."""
LENGTH_BOUNDS: Final = (0.05, 5.0)
TINY: Final = 1e-5
"""Probabilities nearer to 0 or 1 than this are not told apart."""


class Margin:
    """A Gaussian process (Matern 3/2) on a margin of which an interval means failure."""

    def __init__(self, points: FloatArray, values: FloatArray, low: float, high: float) -> None:
        """Learn `values`, (N,), at `points`, (N, d); between `low` and `high` a case fails."""
        self._interval = low, high
        self._points = points
        self._kernel = _learn_kernel(points, values)
        gram = self._kernel(points) + NOISE * np.eye(len(points))
        self._factor = cholesky(gram, lower=True)
        self._alpha = cho_solve((self._factor, True), values)
        self._values = values

    def left_out(self) -> FloatArray:
        """Return for each case, (N,), the log odds of failing as seen by all the others.

        Leave-one-out predictions in closed form: Rasmussen and Williams (2006), eq. (5.12).
        """
        inverse = solve_triangular(self._factor, np.eye(len(self._factor)), lower=True)
        precision = np.square(inverse).sum(axis=0)
        return self._log_odds(self._values - self._alpha / precision, 1.0 / precision)

    def at(self, queries: FloatArray) -> Queries:
        """Return the posterior at queries, (m, d)."""
        return Queries(self, queries)

    def _log_odds(self, mean: FloatArray, variance: FloatArray) -> FloatArray:
        low, high = self._interval
        deviation = np.sqrt(np.maximum(variance, 1e-12))
        p = ndtr((high - mean) / deviation) - ndtr((low - mean) / deviation)
        p = np.clip(p, TINY, 1.0 - TINY)
        return np.asarray(np.log(p / (1.0 - p)), dtype=np.float64)


class Queries:
    """The posterior of a margin at queries, that can be conditioned on queries to be run."""

    def __init__(self, margin: Margin, queries: FloatArray) -> None:
        """Predict at `queries`, (m, d)."""
        self._margin = margin
        self._queries = queries
        cross = margin._kernel(margin._points, queries)
        self._explained = solve_triangular(margin._factor, cross, lower=True)
        self._mean = cross.T @ margin._alpha
        self._variance = margin._kernel.diag(queries) - np.square(self._explained).sum(axis=0)
        self._steps = np.empty((0, len(queries)))

    def log_odds(self) -> FloatArray:
        """Return the log odds of failing, (m,)."""
        return self._margin._log_odds(self._mean, self._variance)

    def run(self, query: int) -> None:
        """Take a query as run with the result that is expected: the mean stays where it is."""
        covariance = self._margin._kernel(self._queries[[query]], self._queries)[0]
        covariance -= self._explained[:, query] @ self._explained
        covariance -= self._steps[:, query] @ self._steps
        step = covariance / np.sqrt(max(self._variance[query], 0.0) + NOISE)
        self._steps = np.vstack([self._steps, step])
        self._variance = self._variance - np.square(step)


def _learn_kernel(points: FloatArray, values: FloatArray) -> Any:
    """Return the kernel with the parameters of maximum likelihood."""
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import ConstantKernel, Matern

    lengths = np.full(points.shape[1], 0.5)
    kernel = ConstantKernel(10.0, (1e-2, 1e3)) * Matern(lengths, LENGTH_BOUNDS, nu=1.5)
    some = evenly(len(points), LEARN_FROM)
    with warnings.catch_warnings():
        # A length scale at its bound is expected where the margin jumps or is flat.
        warnings.simplefilter("ignore", ConvergenceWarning)
        process = GaussianProcessRegressor(kernel, alpha=NOISE).fit(points[some], values[some])
    return process.kernel_


def evenly(n: int, most: int) -> Any:
    """Return at most `most` of the places 0 to n - 1, evenly spread."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(np.int64))
