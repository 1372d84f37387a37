"""AK-MCS: active learning for reliability with the Gaussian processes of `openturns`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from merge_sumo.samplers.base import LevelwiseSampler
from merge_sumo.samplers.history import LevelHistory
from merge_sumo.scenario.case import FloatArray

DESIGN: Final = 12
"""Cases of a level before the first process is fitted, as in the paper."""
POPULATION: Final = 4000
NEAREST: Final = 200
"""Points of the population with the least U, among which a batch is chosen."""
CERTAIN: Final = 2.0
"""Where U is at least this, the class of a point is wrong with a chance below .023."""
FAR: Final = 10.0
"""Gaps beyond this one are all the same: safe, and far from the limit."""
NUGGET: Final = 1e-4
"""Share of the variance that is added to the diagonal, so that near points do no harm."""
LENGTHS: Final = (0.02, 5.0)
"""Bounds of the length scales in the unit cube."""


class AkMcsSampler(LevelwiseSampler):
    """Classifies a Monte Carlo population by the sign of a Gaussian process, least certain first.

    Source: Echard, Gayton, Lemaire, "AK-MCS: An active learning reliability method combining
    Kriging and Monte Carlo Simulation" (2011), with a Matern kernel, as for a rough limit state.
    A batch is chosen one point at a time: the process then believes its own mean there (kriging
    believer). Where no point of the population is uncertain any more, the method would stop; the
    sampler then continues where the deviation is largest, in half of the batches among the points
    that are to fail, in the others anywhere.

    The limit state is sqrt|dx| - sqrt(6 m), with the gap dx at M, negative where a case fails: the
    score jumps there, and the signed gap jumps where the order of the cars changes.
    """

    about = "classifies a Monte Carlo population by kriging (openturns, AK-MCS)"
    colour = "#0072B2"

    def batch_size(self) -> int:
        """Return few cases first: 5 a level, and 10 when 50 a level are known."""
        per_level = 5 if self.proposed() < 50 * len(self.pool.levels) else 10
        return per_level * len(self.pool.levels)

    def propose(
        self, history: LevelHistory, n: int, rng: np.random.Generator, level: int
    ) -> FloatArray:
        """Return the `n` points whose class is least certain, (n, d)."""
        if len(history.points) < DESIGN:
            from scipy.stats.qmc import LatinHypercube

            return np.asarray(LatinHypercube(history.dims, rng=rng).random(n), dtype=np.float64)
        population = rng.random((POPULATION, history.dims))
        process = _fitted(history.points, _limit_state(history))
        mean, deviation = process.predict(population)
        certain = bool((np.abs(mean) >= CERTAIN * deviation).all())
        failing: FloatArray = population[mean < 0.0]
        if certain and len(failing) >= n and rng.random() < 0.5:
            population = failing
        else:
            order = np.argsort(_rank(mean, deviation, certain=certain), kind="stable")
            population = population[order]
        near: FloatArray = population[: max(NEAREST, n)]
        picks: list[int] = []
        for _ in range(n):
            mean, deviation = process.predict(near)
            rank = _rank(mean, deviation, certain=certain)
            rank[picks] = np.inf
            picks.append(int(np.argmin(rank)))
            process = process.believing(near[picks[-1:]], mean[picks[-1:]])
        return near[picks]


def _rank(mean: FloatArray, deviation: FloatArray, *, certain: bool) -> FloatArray:
    """Return a number that is least at the most useful point: U, or less deviation, (m,)."""
    return -deviation if certain else np.abs(mean) / deviation


def _limit_state(history: LevelHistory) -> FloatArray:
    """Return a number that is negative where a case fails, (N,), with a scale of 1."""
    gap = np.minimum(np.nan_to_num(np.abs(history.gap), nan=FAR), FAR)
    limit_state = np.sqrt(gap) - 1.0
    return np.asarray(limit_state / max(float(limit_state.std()), 1e-6), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class _Process:
    """A Gaussian process with known parameters.

    Attributes:
        points: where values are known, (N, d).
        values: the values, (N,).
        covariance: `openturns.CovarianceModel`.
        trend: `openturns.Function`, the mean of the process before any value is known.
    """

    points: FloatArray
    values: FloatArray
    covariance: Any
    trend: Any

    def predict(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean and standard deviation at points, (m,) each."""
        import openturns as ot

        known = ot.Sample(self.points), ot.Sample(self.values[:, None])
        regression = ot.GaussianProcessRegression(*known, self.covariance, self.trend)
        regression.run()
        posterior = ot.GaussianProcessConditionalCovariance(regression.getResult())
        asked = ot.Sample(points)
        mean = np.asarray(posterior.getConditionalMean(asked)).ravel()
        variance = np.asarray(posterior.getConditionalMarginalVariance(asked)).ravel()
        return mean, np.sqrt(np.maximum(variance, 1e-12))

    def believing(self, points: FloatArray, values: FloatArray) -> _Process:
        """Return the process with more values and the same parameters."""
        more = np.concatenate([self.points, points]), np.concatenate([self.values, values])
        return _Process(*more, self.covariance, self.trend)


def _fitted(points: FloatArray, values: FloatArray) -> _Process:
    """Return the process with the parameters of maximum likelihood, and a constant trend."""
    import openturns as ot

    dims = points.shape[1]
    kernel = ot.MaternModel([0.3] * dims, [1.0], 2.5)
    kernel.setNuggetFactor(NUGGET)
    # Cobyla reports where it stops early; its result is good enough then.
    ot.Log.Show(ot.Log.NONE)
    fitter = ot.GaussianProcessFitter(
        ot.Sample(points), ot.Sample(values[:, None]), kernel, ot.ConstantBasisFactory(dims).build()
    )
    fitter.setOptimizationBounds(ot.Interval(*([bound] * dims for bound in LENGTHS)))
    fitter.run()
    result = fitter.getResult()
    (constant,) = result.getTrendCoefficients()
    trend = ot.SymbolicFunction([f"x{axis}" for axis in range(dims)], [repr(float(constant))])
    return _Process(points, values, result.getCovarianceModel(), trend)
