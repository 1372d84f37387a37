"""The surrogate of `coverage`: P(fail) of a case, from the outcomes so far.

Failing means that the signed gap at M, in units of the scenario's limit, is within 1: failures lie
where the gap changes its sign: where another car goes first. There the gap often jumps, and no test
between the two sides ever fails. Three experts give P(fail):

- a smooth process on the gap, and a rough one, which believe that it passes through 0;
- a process for the gap of either side, and who goes first: the gap may come down to a failure on
  one side and jump to the other from there, or jump over the failures.

A VUT that gives no trajectory has its margin learned instead, by the first two. Every expert is
judged by how well it predicted each case from all the others. Two things that no process knows are
learned with it. First, the odds of a case that is bracketed, the nearest safe case on either side
being nearer than any failure, are lowered by h / (h + w): h is the width of the bracket, w the
typical width of what fails. That bisects the curve where the order of merging flips, gives up
where it is a jump, and goes on along it where it is a strip of failures. Then a logistic
regression corrects the odds by the distances to the nearest failure and to that curve.

Where runs of a case differ, P(fail) is that of a run: the processes learn a noise of their own, and
all are judged by k failures of n runs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import expit, log_expit, logit

from merge_sumo.metrics.fmc import radius_for
from merge_sumo.metrics.prediction import NO_GAP
from merge_sumo.samplers.history import LevelHistory
from merge_sumo.samplers.surrogate import Branches, Margin, most_telling
from merge_sumo.scenario.case import FloatArray

MAX_LEARNED: Final = 500
"""Cases that a process learns from; bounds the time per batch in a long campaign. The FMC
after 1,100 cases of design2 at level 2 is .0207 and .0209 (seeds 1, 2); with 1000 .0208, .0214."""
BRANCH_FROM: Final = 20
"""Fewest cases of either merging order to learn the gap of each order by itself."""
NEAR: Final = 0.005
"""Distances below this count as this."""
CALIBRATION: Final = (np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.5, 1.0, 0.3, 0.3]))
"""Mean and standard deviation, before anything is known, of the weights by which the log odds, 1,
and the log distances to the nearest failure and to the curve add up to calibrated log odds."""
NEWTON_STEPS: Final = 6
WIDTHS: Final = np.geomspace(0.001, 0.5, 25)
LOG_PRIOR_WIDTH: Final = (np.log(0.02), 1.5)
"""Widths w that are tried, and mean and standard deviation of log w before anything is known."""
SURE: Final = 1e-3
"""Probabilities are clipped this far from 0 and 1; also the smallest Newton step."""
PREDICTED: Final = 100
"""Last cases that a surrogate without them predicts, to calibrate it."""
FAR: Final = 2.0
"""Distance from the nearest failure, in radii of the FMC, from which a case counts as far."""
JUDGED_FROM: Final = 3
"""Fewest failures, and fewest safe cases, for a published P(fail)."""


class Belief:
    """P(fail) at a level.

    Attributes:
        history: what it was learned from.
        groups: which cases failed, and which safe ones are on either side, each (N,).
        rotation: orthonormal, (d, d); the first column is the mean slope of the margin.
    """

    def __init__(self, history: LevelHistory, limit: float | None = None) -> None:
        """Learn from a history; with a `limit`, all cases up to that gap (margin) failed."""
        if limit is not None:
            failed = nearness(history) <= limit
            failures = np.where(failed, history.runs, 0)
            history = replace(history, failed=failed, failures=failures)
        learned = most_telling(history, MAX_LEARNED)
        self.groups = _groups(history)
        self.history = history
        values, low, high = what_is_learned(learned, limit)
        self._smooth, self._rough = (
            Margin(learned.points, values, low, high, rough=rough, noisy=history.varies)
            for rough in (False, True)
        )
        self.rotation = self._smooth.rotation
        self._branches: Branches | None = None
        positive = int((values >= 0.0).sum())
        if has_gaps(history) and min(positive, len(values) - positive) >= BRANCH_FROM:
            self._branches = Branches(learned.points, values, self._smooth, noisy=history.varies)
        self._weigh(learned)

    def of(self, cases: FloatArray) -> FloatArray:
        """Return P(fail) of a run of cases, (m, d), as (m,)."""
        dims = self.history.dims
        distances = [nearest(cases, self.history.points[group]) for group in self.groups]
        chances = [
            expit(_evidence(_lowered(chance, distances, width), distances, dims) @ calibration)
            for chance, (width, calibration) in zip(self._chances(cases), self._fitted, strict=True)
        ]
        return np.asarray(np.average(chances, axis=0, weights=self._weights), dtype=np.float64)

    def _chances(self, cases: FloatArray) -> list[FloatArray]:
        """Return P(fail) of cases, (m, d), by each expert; the smooth process is evaluated once."""
        smooth = self._smooth.process.at(cases)
        chances = [self._smooth.probability(*smooth), self._rough.at(cases)]
        return chances if self._branches is None else [*chances, self._branches.at(cases, smooth)]

    def _weigh(self, learned: LevelHistory) -> None:
        """Weigh the experts, and learn width and calibration, by how each predicted each case."""
        distances = [_nearest_other(learned.points, group) for group in _groups(learned)]
        log_prior = -0.5 * ((np.log(WIDTHS) - LOG_PRIOR_WIDTH[0]) / LOG_PRIOR_WIDTH[1]) ** 2
        self._fitted: list[tuple[float, FloatArray]] = []
        best: list[float] = []
        for expert in (self._smooth, self._rough, self._branches):
            if expert is None:
                continue
            chance = expert.left_out()
            lowered = _lowered(chance, distances, WIDTHS[:, None])
            evidence = _evidence(lowered, distances, learned.dims)
            calibrations, posteriors = _calibrated(evidence, learned.failures, learned.runs)
            posteriors = posteriors + log_prior
            place = int(posteriors.argmax())
            posterior, width, calibration = posteriors[place], WIDTHS[place], calibrations[place]
            self._fitted.append((float(width), calibration))
            best.append(float(posterior))
        self._weights = np.exp(np.array(best) - max(best))


class Calibration:
    """Correction of the bias of P(fail) among picked cases.

    Picks have a large P(fail), so P(fail) is biased upwards among them. The outcomes of the last
    picks give the bias.

    Attributes:
        factors: factors of P(fail), near failures and far from them, (2,).
    """

    def __init__(self, history: LevelHistory) -> None:
        """Compare the last outcomes with the expectation from those before them."""
        self._failing = history.points[history.ever_failed]
        self.factors = np.ones(2)
        first = len(history.points) - PREDICTED
        if first < PREDICTED // 2:
            return
        before, since = history.take(slice(first)), history.take(slice(first, None))
        far = is_far(since.points, before.points[before.ever_failed])
        predicted = np.bincount(far, since.runs * Belief(before).of(since.points), minlength=2)
        failed = np.bincount(far, since.failures, minlength=2)
        self.factors = np.minimum((failed + 1.0) / (predicted + 1.0), 1.0)

    def of(self, chance: FloatArray, cases: FloatArray) -> FloatArray:
        """Return a probability of cases, (m,), corrected; these are (m, d)."""
        corrected: FloatArray = chance * self.factors[is_far(cases, self._failing)]
        return corrected


def learn_chance(history: LevelHistory) -> Callable[[FloatArray], FloatArray] | None:
    """Return a function that gives P(fail), (n,), at points, (n, d), of the unit cube.

    None with too few failures or too few safe cases.
    """
    if min(history.failed.sum(), (~history.failed).sum()) < JUDGED_FROM:
        return None
    return Belief(history).of


def what_is_learned(
    history: LevelHistory, limit: float | None = None
) -> tuple[FloatArray, float, float]:
    """Return what is learned, (N,), and the interval of it that means failure.

    The signed gap in units of the limit, compressed like a logarithm where it is large: a
    gap of 100 m says little more about failures than one of 50 m. Without gaps, the badness in
    units of that at the limit.
    """
    if not has_gaps(history):
        return np.minimum(history.badness / (1.0 - (limit or 0.0)) - 1.0, 1.0), 0.0, np.inf
    gap = np.nan_to_num(history.gap, nan=NO_GAP) / (limit or 1.0)
    return np.arcsinh(gap) / np.arcsinh(1.0), -1.0, 1.0


def nearness(history: LevelHistory) -> FloatArray:
    """Return the size of the gap, or else the margin, (N,): the less, the nearer to a failure."""
    if not has_gaps(history):
        return history.margin
    return np.abs(np.nan_to_num(history.gap, nan=NO_GAP))


def has_gaps(history: LevelHistory) -> bool:
    """Return whether the VUT gives trajectories."""
    return not np.isnan(history.gap).all()


def _groups(history: LevelHistory) -> list[NDArray[np.bool_]]:
    """Return which cases failed in a run, and which safe ones are on either side, each (N,).

    The side is who goes first; without a trajectory a safe case is on both.
    """
    failed = history.ever_failed
    safe = ~failed
    if not has_gaps(history):
        return [failed, safe, safe]
    pov_first = np.nan_to_num(history.gap, nan=NO_GAP) >= 0.0
    return [failed, safe & ~pov_first, safe & pov_first]


def is_far(points: FloatArray, failing: FloatArray) -> NDArray[np.int64]:
    """Return for each point, (n,), 1 where no failure is near, else 0."""
    return (nearest(points, failing) > FAR * radius_for(points.shape[1])).astype(np.int64)


def nearest(points: FloatArray, others: FloatArray) -> FloatArray:
    """Return the distance of each point to the nearest of the others; 1 where there is none."""
    if not len(others):
        return np.ones(len(points))
    return np.asarray(cKDTree(others).query(points)[0], dtype=np.float64)


def _nearest_other(points: FloatArray, group: NDArray[np.bool_]) -> FloatArray:
    """Return the distance of each point to the nearest of a group but itself; at most 1."""
    distance = nearest(points, points[group])
    if group.sum() > 1:
        distance[group] = cKDTree(points[group]).query(points[group], k=2)[0][:, 1]
    else:
        distance[group] = 1.0
    return np.minimum(distance, 1.0)


def _lowered(
    probability: FloatArray, distances: list[FloatArray], typical_width: float | FloatArray
) -> FloatArray:
    """Return P(fail) with what a closed bracket of safe cases says against it.

    `distances` are those to the nearest failure and to the nearest safe case on either side. The
    result is (m,), or (W, m) for typical widths of shape (W, 1).
    """
    to_failing, before, behind = distances
    width = before + behind
    closed = to_failing > np.maximum(before, behind)
    return np.where(closed, probability * width / (width + typical_width), probability)


def _evidence(chance: FloatArray, distances: list[FloatArray], dims: int) -> FloatArray:
    """Return what speaks for and against failures, (..., m, 4), by P(fail), (..., m).

    See CALIBRATION.
    """
    to_failing, before, behind = distances
    radius = radius_for(dims)
    odds = _log_odds(chance)
    to_curve = np.maximum(before, behind)
    near = [np.log((distance + NEAR) / (radius + NEAR)) for distance in (to_failing, to_curve)]
    return np.stack(np.broadcast_arrays(odds, 1.0, *near), axis=-1)


def _log_odds(chance: FloatArray) -> FloatArray:
    return np.asarray(logit(np.clip(chance, SURE, 1.0 - SURE)), dtype=np.float64)


def _calibrated(
    evidence: FloatArray, failures: NDArray[np.integer | np.bool_], runs: NDArray[np.int64]
) -> tuple[FloatArray, FloatArray]:
    """Return the weights of the evidence, (W, 4), that predict best, and log posteriors, (W,).

    The evidence is of W kinds, (W, N, 4); failures of so many runs are (N,). Logistic regressions
    by Newton's method, all at once; a step that makes one worse is halved.
    """
    mean, deviation = CALIBRATION

    def posterior(evidence: FloatArray, weights: FloatArray) -> FloatArray:
        prior = -0.5 * np.square((weights - mean) / deviation).sum(axis=1)
        odds = (evidence @ weights[..., None])[..., 0]
        likelihood = failures * log_expit(odds) + (runs - failures) * log_expit(-odds)
        return np.asarray(likelihood.sum(axis=1) + prior, dtype=np.float64)

    weights = np.tile(mean, (len(evidence), 1))
    best = posterior(evidence, weights)
    open_ = np.arange(len(evidence))
    for _ in range(NEWTON_STEPS):
        of, now = evidence[open_], weights[open_]
        chance = expit((of @ now[..., None])[..., 0])
        slope = ((failures - runs * chance)[:, None] @ of)[:, 0] - (now - mean) / deviation**2
        spread = (of * (runs * chance * (1.0 - chance))[..., None]).transpose(0, 2, 1) @ of
        step = np.linalg.solve(spread + np.diag(deviation**-2.0), slope[..., None])[..., 0]
        reached = posterior(of, now + step)
        while (worse := (reached < best[open_]) & (np.abs(step).max(axis=1) > SURE)).any():
            step[worse] *= 0.5
            reached[worse] = posterior(of[worse], now[worse] + step[worse])
        better = reached > best[open_]
        open_, now, reached = open_[better], (now + step)[better], reached[better]
        if not len(open_):
            break
        weights[open_], best[open_] = now, reached
    return weights, best
