"""Ours: ask for what users want, the batch that maximises the expected new coverage.

A case is worth P(fail) times the share of its ball (radius rho of the FMC) that is not covered
yet. Failing means that the signed gap dx at M is within 6 m, so failures lie where the gap changes
its sign: where another car goes first. There the gap often jumps, and no test between the two
sides ever fails. Three experts give P(fail) from the cases so far:

- a smooth process on the gap, and a rough one, which believe that it passes through 0;
- a process for the gap of either side, and who goes first: the gap may come down to a failure on
  one side and jump to the other from there, or jump over the failures.

A VUT that gives no trajectory has its score learned instead, by the first two. Every expert is
judged by how well it foretold each case from all the others. Two things that no process knows are
learned with it. First, the odds of a case that is bracketed, the nearest safe case on either side
being nearer than any failure, are lowered by h / (h + w): h is the width of the bracket, w the
typical width of what fails. That bisects the curve where the order of merging flips, gives up
where it is a jump, and goes on along it where it is a strip of failures. Then a logistic
regression corrects the odds by the distances to the nearest failure and to that curve.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import expit, log_expit, logit

from merge_sumo.samplers.allocation import even_shares
from merge_sumo.samplers.base import LevelHistory, Sampler, uniform_points
from merge_sumo.samplers.ground import Ground
from merge_sumo.samplers.surrogate import Branches, Margin, most_telling
from merge_sumo.values.case import Case, FloatArray, dimensions
from merge_sumo.values.fmc import RADIUS
from merge_sumo.values.scenario import DX_CRASH_M
from merge_sumo.values.score import FAILURE_SCORE

UNIFORM_QUERIES: Final = 1500
LOCAL_QUERIES: Final = 600
BETWEEN_QUERIES: Final = 600
LINES: Final = 40
LINE_STEPS: Final = 120
REFINED_QUERIES: Final = 600
"""Candidates per batch: anywhere, within LOCAL_REACH of a failure, between safe cases on either
side, on lines across the cube along the slope of the margin, and around the best of all these."""
LOCAL_REACH: Final = 2.0 * RADIUS
BEST: Final = 150
REFINED_REACH: Final = 0.03
SHORTLIST: Final = 2000
"""Candidates from which the batch is picked."""
PICKED: Final = 0.8
"""Share of a pick's ball that counts as covered at least for the later picks of the batch."""
NO_GAP_M: Final = 200.0
"""Gap of a VUT that never arrives: the POV goes first, as far ahead as one can be."""
MAX_LEARNED: Final = 1000
"""Cases that a process learns from; what bounds the time per batch in a long campaign."""
BRANCH_FROM: Final = 20
"""Cases on either side that it takes to learn the gap of each side by itself."""
NEAR: Final = 0.005
"""Distances below this are not told apart."""
CALIBRATION: Final = (np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.5, 1.0, 0.3, 0.3]))
"""Mean and standard deviation, before anything is known, of the weights by which the log odds, 1,
and the log distances to the nearest failure and to the curve add up to calibrated log odds."""
NEWTON_STEPS: Final = 6
WIDTHS: Final = np.geomspace(0.001, 0.5, 25)
LOG_PRIOR_WIDTH: Final = (np.log(0.02), 1.5)
"""Widths w that are tried, and mean and standard deviation of log w before anything is known."""
SURE: Final = 1e-3
"""Probabilities nearer to 0 or 1 than this are not told apart, nor are weights of evidence."""
NEAREST: Final = 3
"""Failures that it takes to aim at failures alone, and else how many cases stand in for them."""
PATIENCE: Final = 40
"""Cases that are run before anything stands in for failures."""
JUDGED_FROM: Final = 3
"""Failures, and safe cases, that it takes to tell somebody else P(fail)."""
FORETOLD: Final = 100
"""Cases, the last ones, that a belief without them foretells, to see how far it can be trusted."""
EVEN_IF_COVERED: Final = 1e-3
"""Where all is covered, the likeliest failures still come before the others."""


@dataclass(frozen=True, slots=True)
class Proposal:
    """A greedy batch: points, (n, d), and the expected gain of each in balls, (n,)."""

    points: FloatArray
    gain: FloatArray


class CoverageSampler(Sampler):
    """Maximises the expected new coverage, over the levels too.

    Gains are in balls, not in volumes: a volume of two dimensions does not compare with one of
    three, and level 2 would never be asked.
    """

    def ask(self, n: int) -> list[Case]:
        """Return the next `n` cases, level by level."""
        proposals = self._proposals(n)
        return [
            case
            for level, share in self._shares(proposals, n).items()
            for case in self.pool.cases(proposals[level].points[:share], level)
        ]

    def allocate(self, n: int) -> dict[int, int]:
        """Return the number of cases for each level; they add up to `n`."""
        return self._shares(self._proposals(n), n)

    def expected_gain(self, n: int) -> float:
        """Return the expected new coverage of the next `n` cases as a share of that so far.

        Infinite while no failure is known: then nobody can say that the search is over.
        """
        proposals = self._proposals(n)
        shares = self._shares(proposals, n)
        gain = sum(float(proposals[level].gain[:share].sum()) for level, share in shares.items())
        covered = 0.0
        for level in self.pool.levels:
            history = self.history(level)
            ground = Ground(len(dimensions(level)))
            ground.cover(ground.balls(history.points[history.failed]), 1.0)
            covered += ground.covered_balls()
        return gain / covered if covered > 0.0 else np.inf

    def _proposals(self, n: int) -> dict[int, Proposal]:
        """Return the batch that each level would get on its own."""
        return {level: self._propose(level, n) for level in self.pool.levels}

    def _propose(self, level: int, n: int) -> Proposal:
        from threadpoolctl import threadpool_limits

        history, rng = self.history(level), self.rng(level)
        if len(history.points) < 2:
            return Proposal(_spread_out(n, len(dimensions(level)), rng), np.ones(n))
        # One thread: rounding must not depend on the number of cores.
        with threadpool_limits(1):
            return _Search(history, level, rng, n).batch(n)

    def _shares(self, proposals: dict[int, Proposal], n: int) -> dict[int, int]:
        """Return how many cases each level gets: half of them evenly, the rest by the next gain.

        A level whose failures are rare promises next to nothing until one of them is found.
        """
        proposed = {level: self.proposed(level) for level in self.pool.levels}
        if min(len(self.told(level)) for level in self.pool.levels) < 2:
            return even_shares(proposed, n)
        shares = even_shares(proposed, max(min(n, len(proposed)), n // 2))
        for _ in range(n - sum(shares.values())):
            best = max(shares, key=lambda level: proposals[level].gain[shares[level]])
            shares[best] += 1
        return shares


class _Belief:
    """P(fail) at a level, from its history; `limit` is below what a case fails (`_limit`)."""

    def __init__(self, history: LevelHistory, limit: float | None = None) -> None:
        if limit is not None:
            history = _as_if(history, limit)
        learned = most_telling(history, MAX_LEARNED)
        self._groups = _groups(history)
        self._history = history
        values, low, high = margin_of(learned, limit)
        smooth, rough = (
            Margin(learned.points, values, low, high, rough=rough) for rough in (False, True)
        )
        self.rotation = smooth.rotation
        self._experts: list[Margin | Branches] = [smooth, rough]
        positive = int((values >= 0.0).sum())
        if _has_gaps(history) and min(positive, len(values) - positive) >= BRANCH_FROM:
            self._experts.append(Branches(learned.points, values, smooth))
        self._judge(learned)

    def of(self, cases: FloatArray) -> FloatArray:
        """Return P(fail) of cases, (m, d)."""
        distances = [_nearest(cases, self._history.points[group]) for group in self._groups]
        chances = [
            expit(_evidence(_lowered(expert.at(cases), distances, width), distances) @ calibration)
            for expert, (width, calibration) in zip(self._experts, self._judged, strict=True)
        ]
        return np.asarray(np.average(chances, axis=0, weights=self._weights), dtype=np.float64)

    def between(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Return `n` places, (n, d), or none, between safe cases on either side, most in narrow
        brackets.
        """
        _, before, behind = (self._history.points[group] for group in self._groups)
        if not (len(before) and len(behind)):
            return np.empty((0, self._history.points.shape[1]))
        near = [*range(1, 1 + min(3, len(before), len(behind)))]
        pairs = np.concatenate(
            [
                _pairs(before, behind, near),
                _pairs(behind, before, near)[:, ::-1],
            ]
        )
        first, second = before[pairs[:, 0]], behind[pairs[:, 1]]
        weight = (np.linalg.norm(first - second, axis=1) + REFINED_REACH) ** -2.0
        chosen = rng.choice(len(pairs), size=n, p=weight / weight.sum())
        part = rng.random((n, 1))
        return np.asarray(first[chosen] * (1.0 - part) + second[chosen] * part, dtype=np.float64)

    def _judge(self, learned: LevelHistory) -> None:
        """Weigh the experts, and learn width and calibration, by how each foretold each case."""
        distances = [_nearest_other(learned.points, group) for group in _groups(learned)]
        log_prior = -0.5 * ((np.log(WIDTHS) - LOG_PRIOR_WIDTH[0]) / LOG_PRIOR_WIDTH[1]) ** 2
        self._judged: list[tuple[float, FloatArray]] = []
        best = []
        for expert in self._experts:
            chance = expert.left_out()
            found = []
            for width, prior in zip(WIDTHS.tolist(), log_prior.tolist(), strict=True):
                evidence = _evidence(_lowered(chance, distances, width), distances)
                calibration, posterior = _calibrated(evidence, learned.failed)
                found.append((posterior + prior, width, calibration))
            posterior, width, calibration = max(found, key=lambda one: one[0])
            self._judged.append((width, calibration))
            best.append(posterior)
        self._weights = np.exp(np.array(best) - max(best))


class _Search:
    """One batch at one level."""

    def __init__(self, history: LevelHistory, level: int, rng: np.random.Generator, n: int) -> None:
        failing = history.points[history.failed]
        self._ground = Ground(failing.shape[1])
        self._ground.cover(self._ground.balls(failing), 1.0)
        limit, trust = _limit(history), _trust(history)
        belief = _Belief(history, limit)

        def trusted(of: _Belief, cases: FloatArray) -> FloatArray:
            return of.of(cases) * trust[_far(cases, failing)]

        candidates = _candidates(history, belief, level, rng, n)
        probability = trusted(belief, candidates)
        worth = probability * self._ground.new(self._ground.balls(candidates))
        best = candidates[np.argsort(-worth, kind="stable")[:BEST]]
        refined = _around(best, REFINED_QUERIES, REFINED_REACH, rng)
        candidates = np.concatenate([candidates, refined])
        probability = np.concatenate([probability, trusted(belief, refined)])
        worth = probability * (self._ground.new(self._ground.balls(candidates)) + EVEN_IF_COVERED)
        kept = np.argsort(-worth, kind="stable")[: max(SHORTLIST, n)]
        self._candidates, self._aim = candidates[kept], probability[kept]
        self._probability = (
            self._aim if limit is None else trusted(_Belief(history), self._candidates)
        )

    def batch(self, n: int) -> Proposal:
        """Return the greedy batch of `n` cases.

        Most of the ball of a pick counts as covered for the later ones: if the pick fails, it is
        covered, and if it does not, picks near it would mostly have been as wrong. What is aimed
        at may be a near miss, but only a failure is a gain.
        """
        balls = self._ground.balls(self._candidates)
        picks: list[int] = []
        gains: list[float] = []
        free = np.ones(len(balls), dtype=bool)
        for _ in range(n):
            new = self._ground.new(balls)
            worth = np.where(free, self._aim * (new + EVEN_IF_COVERED), -1.0)
            best = int(np.argmax(worth))
            free[best] = False
            picks.append(best)
            gains.append(float(self._probability[best] * new[best]))
            self._ground.cover(balls[best], max(PICKED, float(self._aim[best])))
        return Proposal(self._candidates[picks], np.array(gains))


def _far(points: FloatArray, failing: FloatArray) -> NDArray[np.int64]:
    """Return for each point, (n,), 1 where no failure is within LOCAL_REACH, else 0."""
    return (_nearest(points, failing) > LOCAL_REACH).astype(np.int64)


def _trust(history: LevelHistory) -> FloatArray:
    """Return what P(fail) is multiplied by, near failures and far from them, (2,).

    Cases are picked where P(fail) is large, so among them it is too large more often than not.
    What came of the last picks tells by how much.
    """
    first = len(history.points) - FORETOLD
    if first < FORETOLD // 2:
        return np.ones(2)
    before, since = history.take(slice(first)), history.take(slice(first, None))
    failing = before.points[before.failed]
    chance = _Belief(before).of(since.points)
    far = _far(since.points, failing)
    foretold = np.bincount(far, chance, minlength=2)
    failed = np.bincount(far, since.failed, minlength=2)
    return np.minimum((failed + 1.0) / (foretold + 1.0), 1.0)


def learn_chance(history: LevelHistory) -> Callable[[FloatArray], FloatArray] | None:
    """Return a function that gives P(fail), (n,), at points, (n, d), of the unit cube.

    None while too few cases failed, or too few did not, to judge it by.
    """
    if min(history.failed.sum(), (~history.failed).sum()) < JUDGED_FROM:
        return None
    return _Belief(history).of


def margin_of(history: LevelHistory, limit: float | None = None) -> tuple[FloatArray, float, float]:
    """Return what is learned, (N,), and the interval of it that means failure.

    The signed gap in units of the limit (6 m), compressed like a logarithm where it is large: a
    gap of 100 m says little more about failures than one of 50 m. Without gaps, the score in
    units of the limit (lambda).
    """
    if not _has_gaps(history):
        return np.minimum(history.score / (limit or FAILURE_SCORE) - 1.0, 1.0), 0.0, np.inf
    gap = np.nan_to_num(history.dx_m, nan=NO_GAP_M) / (limit or DX_CRASH_M)
    return np.arcsinh(gap) / np.arcsinh(1.0), -1.0, 1.0


def _limit(history: LevelHistory) -> float | None:
    """Return the gap, in m, or the score that is aimed at; None for that of a failure.

    Where failures are rare, the cases that came nearest show the way, as in subset simulation.
    """
    if history.failed.sum() >= NEAREST or len(history.score) < PATIENCE:
        return None
    nearness = _gap_m(history) if _has_gaps(history) else history.score
    return float(np.partition(nearness, NEAREST - 1)[NEAREST - 1])


def _as_if(history: LevelHistory, limit: float) -> LevelHistory:
    """Return the history as if all cases up to a limit had failed."""
    nearness = _gap_m(history) if _has_gaps(history) else history.score
    return replace(history, failed=nearness <= limit)


def _gap_m(history: LevelHistory) -> FloatArray:
    return np.abs(np.nan_to_num(history.dx_m, nan=NO_GAP_M))


def _has_gaps(history: LevelHistory) -> bool:
    """Return whether the VUT gives trajectories."""
    return not np.isnan(history.dx_m).all()


def _groups(history: LevelHistory) -> list[NDArray[np.bool_]]:
    """Return which cases failed, and which safe ones are on either side, each (N,).

    The side is who goes first; without a trajectory a safe case is on both.
    """
    safe = ~history.failed
    if not _has_gaps(history):
        return [history.failed, safe, safe]
    pov_first = np.nan_to_num(history.dx_m, nan=NO_GAP_M) >= 0.0
    return [history.failed, safe & ~pov_first, safe & pov_first]


def _spread_out(n: int, dims: int, rng: np.random.Generator) -> FloatArray:
    """Return `n` points, (n, d), of a scrambled Halton sequence: no two of them close by chance."""
    from scipy.stats.qmc import Halton

    return np.asarray(Halton(dims, seed=rng).random(n), dtype=np.float64)


def _candidates(
    history: LevelHistory, belief: _Belief, level: int, rng: np.random.Generator, n: int
) -> FloatArray:
    """Return more than `n` candidates, (m, d)."""
    worst = history.points[np.argsort(history.score, kind="stable")[:20]]
    failing = history.points[history.failed]
    along = np.linspace(-1.0, 1.0, LINE_STEPS) + rng.uniform(-0.01, 0.01, (LINES, LINE_STEPS))
    base = uniform_points(LINES, level, rng)
    lines = base[:, None] + along[..., None] * belief.rotation[:, 0]
    lines = lines.reshape(-1, base.shape[1])
    return np.concatenate(
        [
            uniform_points(UNIFORM_QUERIES + n, level, rng),
            _around(failing if len(failing) else worst, LOCAL_QUERIES, LOCAL_REACH, rng),
            belief.between(BETWEEN_QUERIES, rng),
            lines[((lines >= 0.0) & (lines <= 1.0)).all(axis=1)],
        ]
    )


def _around(points: FloatArray, n: int, reach: float, rng: np.random.Generator) -> FloatArray:
    """Return `n` places of the unit cube, (n, d), within reach of some of the points."""
    centres = points[rng.integers(len(points), size=n)]
    direction = rng.standard_normal(centres.shape)
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    return np.clip(centres + reach * np.sqrt(rng.random((n, 1))) * direction, 0.0, 1.0)


def _pairs(points: FloatArray, others: FloatArray, near: list[int]) -> NDArray[np.int64]:
    """Return pairs (place, place of one of its nearest others), (m, 2)."""
    _, place = cKDTree(others).query(points, k=near)
    return np.column_stack([np.repeat(np.arange(len(points)), len(near)), place.ravel()])


def _nearest(points: FloatArray, others: FloatArray) -> FloatArray:
    """Return the distance of each point to the nearest of the others; 1 where there is none."""
    if not len(others):
        return np.ones(len(points))
    return np.asarray(cKDTree(others).query(points)[0], dtype=np.float64)


def _nearest_other(points: FloatArray, group: NDArray[np.bool_]) -> FloatArray:
    """Return the distance of each point to the nearest of a group but itself; at most 1."""
    distance = _nearest(points, points[group])
    if group.sum() > 1:
        distance[group] = cKDTree(points[group]).query(points[group], k=2)[0][:, 1]
    else:
        distance[group] = 1.0
    return np.minimum(distance, 1.0)


def _lowered(
    probability: FloatArray, distances: list[FloatArray], typical_width: float
) -> FloatArray:
    """Return P(fail) with what a closed bracket of safe cases says against it.

    `distances` are those to the nearest failure and to the nearest safe case on either side.
    """
    to_failing, before, behind = distances
    width = before + behind
    closed = to_failing > np.maximum(before, behind)
    return np.where(closed, probability * width / (width + typical_width), probability)


def _evidence(chance: FloatArray, distances: list[FloatArray]) -> FloatArray:
    """Return what speaks for and against failures, (m, 4): see CALIBRATION."""
    to_failing, before, behind = distances
    odds = logit(np.clip(chance, SURE, 1.0 - SURE))
    to_curve = np.maximum(before, behind)
    near = [np.log((distance + NEAR) / (RADIUS + NEAR)) for distance in (to_failing, to_curve)]
    return np.column_stack([odds, np.ones(len(chance)), *near])


def _calibrated(evidence: FloatArray, failed: NDArray[np.bool_]) -> tuple[FloatArray, float]:
    """Return the weights of the evidence, (4,), that foretell best, and their log posterior.

    Logistic regression by Newton's method; a step that makes it worse is halved.
    """
    mean, deviation = CALIBRATION
    signs = np.where(failed, 1.0, -1.0)

    def posterior(weights: FloatArray) -> float:
        prior = -0.5 * np.square((weights - mean) / deviation).sum()
        return float(log_expit(signs * (evidence @ weights)).sum() + prior)

    weights, best = mean, posterior(mean)
    for _ in range(NEWTON_STEPS):
        chance = expit(evidence @ weights)
        slope = evidence.T @ (failed - chance) - (weights - mean) / deviation**2
        spread = (evidence.T * (chance * (1.0 - chance))) @ evidence + np.diag(deviation**-2.0)
        step = np.linalg.solve(spread, slope)
        while (reached := posterior(weights + step)) < best and np.abs(step).max() > SURE:
            step = 0.5 * step
        if reached <= best:
            break
        weights, best = weights + step, reached
    return weights, best
