"""Gaussian-process sampling: Wang et al., Algorithm 1."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular

from merge_sumo.samplers.base import LevelwiseSampler
from merge_sumo.samplers.coverage_grid import CoverageGrid
from merge_sumo.samplers.history import LevelHistory, most_informative
from merge_sumo.scenario.case import FloatArray

# p, the uniform queries among which a batch is chosen.
QUERIES = 4000
# epsilon = EPSILON0 ALPHA^(i-1) is the share of exploring picks in batch i.
EPSILON0 = 0.05
ALPHA = 0.95
# Powers (z1, z2) and (z3, z4) of the predicted badness and of its variance.
Z_EXPLOIT = (4.0, 1.0)
Z_EXPLORE = (1.0, 2.0)
# Value of a query with a covered ball.
FLOOR = 1e-3
# Variance of the observation noise: the badness has a jump, which a smooth surrogate can only fit
# as noise.
NOISE = 1e-2
# Bounds of the kernel's length scales in the unit cube. Far below the FMC's radius a surrogate
# explains a jump by forgetting its neighbours.
LENGTH_BOUNDS = (0.035, 5.0)


class GprSampler(LevelwiseSampler):
    """Chooses cases epsilon-greedily by a Gaussian process on the badness.

    The badness of a margin m is 1 - m, which is P / lambda under the paper's criterion. The process
    has mean zero and a squared-exponential kernel. A query has the value q = mu^z1 Var^z2, times
    the share of its ball (radius rho of the FMC) that no failure and no pick covers. Each pick of a
    batch lowers the variance for the later ones, which spreads the batch out.
    """

    about = "the paper's Algorithm 1: predicts the margin by a Gaussian process"
    colour = "#0072B2"
    overlaps = True

    def allocate(self, n: int) -> dict[int, int]:
        """Return equal numbers at first, then numbers by the softmax of the last failure shares.

        Args:
            n: number of cases of the batch.
        """
        weights = {}
        for level in self.pool.levels:
            # In proportion to exp(xi U_k), with xi = 3.
            weights[level] = math.exp(3.0 * self.failure_share(level))
        return self.shares(n, weights)

    def failure_share(self, level: int) -> float:
        """Return U(i, k), the share of failures in the last batch with cases of a level.

        Args:
            level: level of the POV, k.
        """
        outcomes = self.observed(level)
        if not outcomes:
            return 0.0
        last = max(outcome.batch for outcome in outcomes)
        verdicts = [outcome.failed for outcome in outcomes if outcome.batch == last]
        return sum(verdicts) / len(verdicts)

    def propose(
        self, history: LevelHistory, n: int, rng: np.random.Generator, level: int
    ) -> FloatArray:
        """Return points, (n, d), by lines 1 to 9 of Algorithm 1; without outcomes uniform ones.

        Args:
            history: outcomes of the level.
            n: number of points.
            rng: random generator.
            level: level of the POV.
        """
        if not len(history.points):
            return rng.random((n, history.dims))
        queries = rng.random((QUERIES, history.dims))
        epsilon = EPSILON0 * ALPHA ** len(np.unique(history.batch))
        exploiting = n - round(epsilon * n)
        posterior = _Posterior(history, queries, self.pending(level))
        picks = []
        for number in range(n):
            powers = Z_EXPLOIT if number < exploiting else Z_EXPLORE
            picks.append(posterior.pick(*powers))
        return queries[picks]


class _Posterior:
    """The fitted surrogate at the queries, with a variance conditioned on the picks of the batch.

    Pending cases, (m, d), are picks of earlier batches.
    """

    def __init__(self, history: LevelHistory, queries: FloatArray, pending: FloatArray) -> None:
        first = len(queries)
        queries = np.concatenate([queries, pending])
        self._queries = queries
        failures = history.failing
        # The most cases to learn from: they bound the time for a batch in a long campaign.
        history = most_informative(history, 600)
        process = _fit(history)
        self._kernel, self._noise = process.kernel_, float(np.max(_noise(history)))
        cross = self._kernel(history.points, queries)
        self._explained = solve_triangular(process.L_, cross, lower=True)
        # A floor keeps every query reachable where the surrogate predicts no badness at all.
        self._badness = np.maximum(cross.T @ process.alpha_, 0.0) + 1e-6
        self._variance = self._kernel.diag(queries) - np.square(self._explained).sum(axis=0)
        self._taken = np.zeros(len(queries), dtype=bool)
        self._grid = CoverageGrid(queries.shape[1], coarse=True)
        self._grid.cover(self._grid.balls(failures), 1.0)
        self._balls = self._grid.balls(queries)
        for query in range(first, len(queries)):
            self._take(query)

    def pick(self, z_badness: float, z_variance: float) -> int:
        """Take the query that maximises badness^z variance^z new, and condition on it."""
        variance = np.maximum(self._variance, 1e-12)
        quality = z_badness * np.log(self._badness) + z_variance * np.log(variance)
        quality += np.log(self._grid.new(self._balls) + FLOOR)
        quality[self._taken] = -np.inf
        best = int(np.argmax(quality))
        self._take(best)
        return best

    def _take(self, best: int) -> None:
        """Condition on a query, and cover its ball."""
        variance = max(float(self._variance[best]), 1e-12)
        self._taken[best] = True
        self._grid.cover(self._balls[best], 1.0)
        covariance = self._kernel(self._queries[[best]], self._queries)[0]
        covariance -= self._explained[:, best] @ self._explained
        step = covariance / np.sqrt(variance + self._noise)
        self._explained = np.vstack([self._explained, step])
        self._variance = self._variance - np.square(step)


def _fit(history: LevelHistory) -> Any:
    """Return the process with maximum-likelihood parameters; line 11 of Algorithm 1."""
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel
    from threadpoolctl import threadpool_limits

    dims = history.points.shape[1]
    kernel = ConstantKernel(1.0, (1e-3, 1e3)) * RBF(np.full(dims, 0.3), LENGTH_BOUNDS)
    process = GaussianProcessRegressor(kernel, alpha=_noise(history))
    # One thread: rounding must not depend on the number of cores, and small matrices gain nothing.
    with threadpool_limits(1), warnings.catch_warnings():
        # A length scale at its bound is expected where P hardly depends on a coordinate.
        warnings.simplefilter("ignore", ConvergenceWarning)
        return process.fit(history.points, 1.0 - history.margin)


def _noise(history: LevelHistory) -> FloatArray | float:
    """Return the variance of the noise of each case, (N,).

    Where runs of a case differ, a run has the mean variance of the cases with several runs; more
    runs lower it.
    """
    if not history.varies or np.isnan(history.variance).all():
        return NOISE
    of_a_run = float(np.nanmean(history.variance))
    return NOISE + of_a_run / history.runs


def predicted_margin(history: LevelHistory, points: FloatArray) -> FloatArray:
    """Predict margins by the surrogate.

    Args:
        history: outcomes of a level, at least one.
        points: points of the unit cube, (m, d).

    Returns:
        Margins, (m,).
    """
    margin: FloatArray = 1.0 - _fit(history).predict(points)
    return margin
