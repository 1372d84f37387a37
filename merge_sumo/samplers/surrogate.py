"""The surrogate of `coverage`: P(fail) of a case, learned from the outcomes.

A case fails where the signed gap at M, in units of the scenario's limit, is within 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import expit, log_expit, logit, ndtr

from merge_sumo.metrics.fmc import BoolArray, IntArray, radius_for
from merge_sumo.metrics.outcome import NO_GAP
from merge_sumo.samplers.gaussian_process import GaussianProcess
from merge_sumo.samplers.history import LevelHistory, most_informative
from merge_sumo.scenario.case import FloatArray

# Prior mean and standard deviation of the four weights of the logistic regression: of the log odds,
# the intercept, and the log distances to the nearest failure and to the curve where the merging
# order changes.
PRIOR_WEIGHTS = (np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.5, 1.0, 0.3, 0.3]))
# Candidate widths w of failing intervals.
WIDTHS = np.geomspace(0.001, 0.5, 25)
# Distance of probabilities from 0 and 1, at least; also the smallest Newton step.
SURE = 1e-3
# Fewest failures, and fewest safe cases, for a published P(fail).
JUDGED_FROM = 3


class Surrogate:
    """P(fail) of the cases of a level.

    Failures lie where the gap changes its sign, that is, where the merging order changes. There the
    gap may also jump, so that no case between the two sides fails.

    Two Gaussian processes learn the gap: a smooth and a rough one, weighted by their predictions of
    each case from all others. Two corrections are fitted to these predictions:

    - A case is bracketed where the nearest safe case of either merging order is nearer than any
      failure. Its P(fail) is multiplied by h / (h + w), with the width h of the bracket and the
      typical width w of failing intervals. That bisects the curve where the order changes, and
      leaves it where the gap jumps.
    - A logistic regression corrects the odds by the distances to the nearest failure and to that
      curve.

    Where runs of a case differ, P(fail) is that of a run: the processes learn a noise, too, and the
    corrections are fitted to k failures of n runs.

    Attributes:
        history: the outcomes.
        groups: which cases failed, and which safe ones are of either merging order, each (N,).
        gap_axis: direction of the mean slope of the gap, (d,), of length 1.

    Example:
        chance = Surrogate(sampler.history(level=1)).predict(points)
    """

    def __init__(self, history: LevelHistory, limit: float | None = None) -> None:
        """Learn from a history.

        Args:
            history: outcomes of the level.
            limit: size of the signed gap up to which a case counts as failed; None for the verdicts
                of the history.
        """
        if limit is not None:
            failed = np.abs(signed_gaps(history)) <= limit
            history = replace(history, failed=failed, failures=np.where(failed, history.runs, 0))
        self.history = history
        self.groups = _groups(history)
        # 500 cases bound the time for a batch in a long campaign. The FMC after 1,100 cases of
        # design2 at level 2 is .0207 and .0209 (seeds 1, 2); with 1,000 .0208 and .0214.
        learned = most_informative(history, 500)
        values = learned_values(learned, limit)
        distances = [_nearest_other(learned.points, group) for group in _groups(learned)]
        log_prior = -0.5 * (np.log(WIDTHS / 0.02) / 1.5) ** 2
        self._fitted: list[tuple[GaussianProcess, float, FloatArray]] = []
        posteriors = []
        for rough in (False, True):
            process = GaussianProcess(learned.points, values, rough=rough, noisy=history.varies)
            chance = _chance_within(*process.leave_one_out())
            lowered = _bracketed(chance, distances, WIDTHS[:, None])
            inputs = _regression_inputs(lowered, distances, history.dims)
            weights, posterior = fit_logistic(inputs, learned.failures, learned.runs)
            best = int((posterior + log_prior).argmax())
            self._fitted.append((process, float(WIDTHS[best]), weights[best]))
            posteriors.append((posterior + log_prior)[best])
        self._process_weights = np.exp(np.array(posteriors) - max(posteriors))
        self.gap_axis = process.rotation[:, 0]

    def predict(self, points: FloatArray) -> FloatArray:
        """Predict P(fail) of a run of each case.

        Args:
            points: cases of the unit cube, (m, d).

        Returns:
            Probabilities, (m,).
        """
        distances = [nearest(points, self.history.points[group]) for group in self.groups]
        chances = []
        for process, width, weights in self._fitted:
            chance = _bracketed(_chance_within(*process.predict(points)), distances, width)
            inputs = _regression_inputs(chance, distances, self.history.dims)
            chances.append(expit(inputs @ weights))
        return np.average(chances, axis=0, weights=self._process_weights)


def learn_chance(history: LevelHistory) -> Callable[[FloatArray], FloatArray] | None:
    """Learn P(fail) for publication.

    Args:
        history: outcomes of a level.

    Returns:
        A function from points, (n, d), of the unit cube to P(fail), (n,); None with fewer than
        three failures or three safe cases.
    """
    if min(history.failed.sum(), (~history.failed).sum()) < JUDGED_FROM:
        return None
    return Surrogate(history).predict


def learned_values(history: LevelHistory, limit: float | None = None) -> FloatArray:
    """Return the values that the processes learn.

    The scale is logarithmic where gaps are large: a gap of 100 m says little more about failures
    than one of 50 m.

    Args:
        history: outcomes of a level.
        limit: size of the signed gap up to which a case counts as failed; None for 1.

    Returns:
        Values, (N,), of which those from -1 to 1 are failures.
    """
    values: FloatArray = np.arcsinh(signed_gaps(history) / (limit or 1.0)) / np.arcsinh(1.0)
    return values


def signed_gaps(history: LevelHistory) -> FloatArray:
    """Return the signed gaps, (N,); `NO_GAP` for a VUT that never arrived.

    Args:
        history: outcomes of a level.
    """
    return np.nan_to_num(history.gap, nan=NO_GAP)


def nearest(points: FloatArray, others: FloatArray) -> FloatArray:
    """Return the distance of each point to the nearest of other points.

    Args:
        points: (n, d).
        others: (m, d).

    Returns:
        Distances, (n,); 1 without other points.
    """
    if not len(others):
        return np.ones(len(points))
    distance: FloatArray = cKDTree(others).query(points)[0]
    return distance


def _groups(history: LevelHistory) -> list[BoolArray]:
    """Return which cases failed in a run, and which safe ones are of either order, each (N,)."""
    failed = history.failures > 0
    pov_first = signed_gaps(history) >= 0.0
    return [failed, ~failed & ~pov_first, ~failed & pov_first]


def _chance_within(mean: FloatArray, variance: FloatArray) -> FloatArray:
    """Return the probability that a normal value is from -1 to 1, (m,)."""
    deviation = np.sqrt(np.maximum(variance, 1e-12))
    chance: FloatArray = ndtr((1.0 - mean) / deviation) - ndtr((-1.0 - mean) / deviation)
    return chance


def _nearest_other(points: FloatArray, group: BoolArray) -> FloatArray:
    """Return the distance of each point to the nearest of a group but itself; at most 1."""
    distance = nearest(points, points[group])
    if group.sum() > 1:
        distance[group] = cKDTree(points[group]).query(points[group], k=2)[0][:, 1]
    else:
        distance[group] = 1.0
    return np.minimum(distance, 1.0)


def _bracketed(
    chance: FloatArray, distances: list[FloatArray], width: float | FloatArray
) -> FloatArray:
    """Return P(fail), lowered in a closed bracket of safe cases; (m,), or (W, m) for W widths."""
    to_failing, before, behind = distances
    bracket = before + behind
    closed = to_failing > np.maximum(before, behind)
    return np.where(closed, chance * bracket / (bracket + width), chance)


def _regression_inputs(chance: FloatArray, distances: list[FloatArray], dims: int) -> FloatArray:
    """Return the inputs of the regression, (..., m, 4), by P(fail), (..., m)."""
    to_failing, before, behind = distances
    radius = radius_for(dims)
    odds = logit(np.clip(chance, SURE, 1.0 - SURE))
    columns = [odds, np.ones_like(odds)]
    for distance in (to_failing, np.maximum(before, behind)):
        # Smaller distances than .005 hardly differ.
        log_distance = np.log((distance + 0.005) / (radius + 0.005))
        columns.append(np.broadcast_to(log_distance, odds.shape))
    return np.stack(columns, axis=-1)


def fit_logistic(
    inputs: FloatArray, failures: IntArray, runs: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Fit W logistic regressions at once, by Newton's method; a step that worsens one is halved.

    Args:
        inputs: inputs of each regression, (W, N, 4).
        failures: number of failures of each case, (N,).
        runs: number of its runs, (N,).

    Returns:
        Weights, (W, 4), and log posterior densities, (W,).
    """
    mean, deviation = PRIOR_WEIGHTS

    def log_posterior(inputs: FloatArray, weights: FloatArray) -> FloatArray:
        prior = -0.5 * np.square((weights - mean) / deviation).sum(axis=1)
        odds = (inputs @ weights[..., None])[..., 0]
        likelihood = failures * log_expit(odds) + (runs - failures) * log_expit(-odds)
        density: FloatArray = likelihood.sum(axis=1) + prior
        return density

    weights = np.tile(mean, (len(inputs), 1))
    best = log_posterior(inputs, weights)
    # Regressions that have not converged.
    active = np.arange(len(inputs))
    for _ in range(6):
        x, w = inputs[active], weights[active]
        chance = expit((x @ w[..., None])[..., 0])
        residual = failures - runs * chance
        gradient = (residual[:, None] @ x)[:, 0] - (w - mean) / deviation**2
        hessian = (x * (runs * chance * (1.0 - chance))[..., None]).transpose(0, 2, 1) @ x
        step = np.linalg.solve(hessian + np.diag(deviation**-2.0), gradient[..., None])[..., 0]
        reached = log_posterior(x, w + step)
        while True:
            worse = (reached < best[active]) & (np.abs(step).max(axis=1) > SURE)
            if not worse.any():
                break
            step[worse] *= 0.5
            reached[worse] = log_posterior(x[worse], w[worse] + step[worse])
        better = reached > best[active]
        active = active[better]
        if not len(active):
            break
        weights[active], best[active] = (w + step)[better], reached[better]
    return weights, best
