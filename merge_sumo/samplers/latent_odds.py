"""A correction of P(fail) where chance decides: k failures in n runs of a case.

The log odds of a failure in a run are m(x) + h(x): m is what is believed without h, and h is a
Gaussian process of mean 0. The failures of a case are binomial. So a case that failed in its only
run is weak evidence, and P(fail) near .3 is possible where 3 runs of 10 failed.

Source: Rasmussen and Williams (2006), section 3.4, the Laplace approximation, with a binomial
likelihood and a mean.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.spatial.distance import cdist
from scipy.special import expit, log_expit, logit, ndtr

from merge_sumo.scenario.case import FloatArray

IntArray = NDArray[np.int64]

VARIANCES: Final = (0.1, 0.5, 2.0, 8.0)
LENGTHS: Final = (0.05, 0.15, 0.45)
"""Variances of h, and lengths over which it changes, that are tried."""
NEWTON_STEPS: Final = 20
ENOUGH: Final = 1e-4
"""Newton's method ends where a step changes no log odds by more."""
LARGEST_STEP: Final = 3.0
"""Of a log odds, in one step of Newton's method."""


@dataclass(frozen=True, slots=True)
class _Mode:
    """The mode of h at the cases under one kernel.

    Attributes:
        slope: of the log likelihood over h, (N,).
        root: square root of its negative curvature, (N,).
        factor: Cholesky factor of I + root K root, (N, N).
        evidence: log marginal likelihood.
    """

    slope: FloatArray
    root: FloatArray
    factor: FloatArray
    evidence: float


class LatentOdds:
    """The log odds of failing of a run, learned from k of n."""

    def __init__(
        self, points: FloatArray, runs: IntArray, failures: IntArray, mean: FloatArray
    ) -> None:
        """Learn from cases, (N, d), with their runs and failures, (N,), around log odds, (N,)."""
        self._points = points
        apart = cdist(points, points)
        modes = {
            kernel: _mode(_covariance(apart, *kernel), runs, failures, mean)
            for kernel in product(VARIANCES, LENGTHS)
        }
        self._kernel = max(modes, key=lambda kernel: modes[kernel].evidence)
        self._mode = modes[self._kernel]

    def at(self, queries: FloatArray, mean: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean and variance of the log odds at queries, (m, d), as (m,), (m,).

        `mean`, (m,), is what is believed of them without the correction.
        """
        cross = _covariance(cdist(self._points, queries), *self._kernel)
        explained = solve_triangular(
            self._mode.factor, self._mode.root[:, None] * cross, lower=True
        )
        variance = self._kernel[0] - np.square(explained).sum(axis=0)
        return mean + cross.T @ self._mode.slope, np.maximum(variance, 1e-9)


def mean_chance(mean: FloatArray, variance: FloatArray) -> FloatArray:
    """Return E[P(fail)], (m,), for normal log odds; MacKay (1992), eq. (10)."""
    return np.asarray(expit(mean / np.sqrt(1.0 + math.pi * variance / 8.0)), dtype=np.float64)


def chance_above(mean: FloatArray, variance: FloatArray, tolerated: float) -> FloatArray:
    """Return P(P(fail) > tolerated), (m,), for normal log odds; `tolerated` is above 0."""
    return np.asarray(ndtr((mean - logit(tolerated)) / np.sqrt(variance)), dtype=np.float64)


def _covariance(apart: FloatArray, variance: float, length: float) -> FloatArray:
    """Return the Matern 3/2 covariance at distances, (n, m)."""
    scaled = math.sqrt(3.0) / length * apart
    return np.asarray(variance * (1.0 + scaled) * np.exp(-scaled), dtype=np.float64)


def _mode(covariance: FloatArray, runs: IntArray, failures: IntArray, mean: FloatArray) -> _Mode:
    """Return the mode of h, by Newton's method: Rasmussen and Williams (2006), algorithm 3.1."""
    h = np.zeros(len(mean))
    identity = np.eye(len(mean))
    for _ in range(NEWTON_STEPS):
        chance = expit(mean + h)
        slope = failures - runs * chance
        root = np.sqrt(np.maximum(runs * chance * (1.0 - chance), 1e-9))
        factor = cholesky(identity + root[:, None] * covariance * root, lower=True)
        wanted = np.square(root) * h + slope
        inner = solve_triangular(factor, root * (covariance @ wanted), lower=True)
        weights = wanted - root * solve_triangular(factor, inner, lower=True, trans=1)
        step = np.clip(covariance @ weights - h, -LARGEST_STEP, LARGEST_STEP)
        h = h + step
        if np.abs(step).max() < ENOUGH:
            break
    odds = mean + h
    likelihood = failures @ log_expit(odds) + (runs - failures) @ log_expit(-odds)
    evidence = likelihood - 0.5 * (weights @ h) - np.log(np.diag(factor)).sum()
    return _Mode(slope, root, factor, float(evidence))
