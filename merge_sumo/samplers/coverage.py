"""Ours: ask for what users want, the batch that maximises the expected new coverage.

A case is worth P(fail) times the share of its ball (radius rho of the FMC) that is not covered
yet. P(fail) comes in two steps. A Gaussian process learns the signed gap dx at M, where failing
means |dx| < 6 m; a VUT that gives no trajectory has its score learned instead. Because dx jumps
where another car goes first, the odds that the process gives are wrong near jumps, by how much
differs from VUT to VUT, and the history tells: a logistic regression corrects the leave-one-out
odds of the cases that were run by their distances to the nearest failing and the nearest safe one
(the idea of Platt, 1999).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import expit

from merge_sumo.case import Case, FloatArray, dimensions, from_unit
from merge_sumo.fmc import RADIUS
from merge_sumo.samplers.allocation import even_shares
from merge_sumo.samplers.base import LevelHistory, Sampler, uniform_points
from merge_sumo.samplers.surrogate import Margin, evenly
from merge_sumo.scenario import DX_CRASH_M
from merge_sumo.score import FAILURE_SCORE

UNIFORM_QUERIES: Final = 1500
LOCAL_QUERIES: Final = 1500
"""Candidates per batch: anywhere, and within LOCAL_REACH of a failure."""
LOCAL_REACH: Final = 2.0 * RADIUS
MAX_GAP_M: Final = 40.0
"""Gaps are learned up to here: beyond, they say nothing about failures."""
MAX_LEARNED: Final = 1000
"""Cases that the process learns from; what bounds the time per batch in a long campaign."""
CALIBRATE_FROM: Final = 3
"""Failures that it takes to correct the odds."""
CELL: Final = {2: 0.01, 3: 0.0125}
"""Spacing of the grid, per dimension, on which coverage is counted."""
SOFTENING: Final = 0.01
"""Distances below this are not told apart."""


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
            for case in from_unit(proposals[level].points[:share], level, self.pool.v_vut0_mps)
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
            return Proposal(uniform_points(n, level, rng), np.ones(n))
        # One thread: rounding must not depend on the number of cores.
        with threadpool_limits(1):
            return _Search(history, level, rng, n).batch(n)

    def _shares(self, proposals: dict[int, Proposal], n: int) -> dict[int, int]:
        """Return how many cases each level gets: one each, the rest by the largest next gain."""
        told = {level: len(self.told(level)) for level in self.pool.levels}
        if min(told.values()) < 2:
            return even_shares(told, n)
        shares = even_shares(told, min(n, len(told)))
        for _ in range(n - sum(shares.values())):
            best = max(shares, key=lambda level: proposals[level].gain[shares[level]])
            shares[best] += 1
        return shares


class Ground:
    """The unit cube with a margin of one radius, as cells with the chance not to be covered."""

    def __init__(self, dims: int) -> None:
        """Prepare an uncovered ground of `dims` dimensions."""
        self._cell = CELL[dims]
        reach = int(RADIUS / self._cell) + 1
        side = round((1.0 + 2.0 * RADIUS) / self._cell) + 5
        self._strides = side ** np.arange(dims)[::-1]
        axes = np.meshgrid(*[np.arange(-reach, reach + 1)] * dims, indexing="ij")
        offsets = np.stack(axes, axis=-1).reshape(-1, dims)
        inside = np.square(offsets * self._cell).sum(axis=1) <= RADIUS**2
        self._ball = offsets[inside] @ self._strides
        self._open = np.ones(side**dims, dtype=np.float32)

    def balls(self, points: FloatArray) -> NDArray[np.int64]:
        """Return the cells of the ball around each point, (n, cells)."""
        corner = np.rint((points + RADIUS) / self._cell).astype(np.int64) + 2
        return np.asarray((corner @ self._strides)[:, None] + self._ball, dtype=np.int64)

    def new(self, balls: NDArray[np.int64]) -> FloatArray:
        """Return the expected share of each ball that is not covered, (n,)."""
        return np.asarray(self._open[balls].mean(axis=1), dtype=np.float64)

    def cover(self, balls: NDArray[np.int64], probability: float) -> None:
        """Cover balls with a probability."""
        self._open[balls] *= np.float32(1.0 - probability)

    def covered_balls(self) -> float:
        """Return the expected covered volume in balls."""
        return float((1.0 - self._open).sum()) / len(self._ball)


class _Search:
    """One batch at one level."""

    def __init__(self, history: LevelHistory, level: int, rng: np.random.Generator, n: int) -> None:
        learned = _learned_from(history)
        margin = learn_margin(learned)
        failing = history.points[history.failed]
        safe = history.points[~history.failed]
        self._candidates = _candidates(history, level, rng, n)
        self._to_failing = _nearest(self._candidates, failing)
        self._to_safe = _nearest(self._candidates, safe)
        self._odds = margin.at(self._candidates)
        self._ground = Ground(failing.shape[1])
        self._ground.cover(self._ground.balls(failing), 1.0)
        self._balls = self._ground.balls(self._candidates)
        self._correction = _correction(margin, learned)

    def batch(self, n: int) -> Proposal:
        """Return the greedy batch of `n` cases: each knows what is expected of the earlier ones."""
        picks: list[int] = []
        gains: list[float] = []
        taken = np.zeros(len(self._candidates), dtype=bool)
        for _ in range(n):
            probability = self._probability()
            value = probability * self._ground.new(self._balls)
            # Where all is covered, the likeliest failures still come before the others.
            best = int(np.argmax(np.where(taken, -1.0, value + 1e-3 * probability)))
            taken[best] = True
            picks.append(best)
            gains.append(float(value[best]))
            self._ground.cover(self._balls[best], float(probability[best]))
            self._odds.run(best)
            if probability[best] <= 0.5:
                # What it teaches if it is safe, as expected: others near it are, too.
                apart = np.linalg.norm(self._candidates - self._candidates[best], axis=1)
                self._to_safe = np.minimum(self._to_safe, apart)
        return Proposal(self._candidates[picks], np.array(gains))

    def _probability(self) -> FloatArray:
        """Return P(fail) of each candidate, (m,)."""
        odds = self._odds.log_odds()
        if self._correction is None:
            return np.asarray(expit(odds), dtype=np.float64)
        features = _features(odds, self._to_failing, self._to_safe)
        return np.asarray(self._correction.predict_proba(features)[:, 1], dtype=np.float64)


def learn_margin(history: LevelHistory) -> Margin:
    """Return the surrogate of the signed gap or, where there is none, of the score."""
    if np.isnan(history.dx_m).all():
        badness = history.score / FAILURE_SCORE - 1.0
        return Margin(history.points, np.minimum(badness, 1.0), 0.0, np.inf)
    # A VUT that never arrives lets the POV go first, as far ahead as one can be.
    gap_m = np.clip(np.nan_to_num(history.dx_m, nan=MAX_GAP_M), -MAX_GAP_M, MAX_GAP_M)
    return Margin(history.points, gap_m / DX_CRASH_M, -1.0, 1.0)


def _learned_from(history: LevelHistory) -> LevelHistory:
    """Return at most MAX_LEARNED cases: half of them the worst ones, half spread over the rest."""
    if len(history.points) <= MAX_LEARNED:
        return history
    order = np.argsort(history.score, kind="stable")
    half = MAX_LEARNED // 2
    rest = np.sort(order[half:])
    kept = np.sort(np.concatenate([order[:half], rest[evenly(len(rest), half)]]))
    return LevelHistory(
        points=history.points[kept],
        score=history.score[kept],
        failed=history.failed[kept],
        dx_m=history.dx_m[kept],
        batch=history.batch[kept],
    )


def _candidates(history: LevelHistory, level: int, rng: np.random.Generator, n: int) -> FloatArray:
    """Return more than `n` candidates, (m, d): anywhere, and around the worst cases."""
    worst = np.argsort(history.score, kind="stable")[: max(int(history.failed.sum()), 20)]
    around = history.points[history.failed if history.failed.any() else worst]
    centres = around[rng.integers(len(around), size=LOCAL_QUERIES)]
    direction = rng.standard_normal(centres.shape)
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    reach = LOCAL_REACH * np.sqrt(rng.random((len(centres), 1)))
    local = np.clip(centres + reach * direction, 0.0, 1.0)
    return np.concatenate([uniform_points(UNIFORM_QUERIES + n, level, rng), local])


def _nearest(points: FloatArray, others: FloatArray) -> FloatArray:
    """Return the distance of each point to the nearest of the others; 1 where there is none."""
    if not len(others):
        return np.ones(len(points))
    return np.asarray(cKDTree(others).query(points)[0], dtype=np.float64)


def _second_nearest(points: FloatArray) -> FloatArray:
    """Return the distance of each point to the nearest one but itself."""
    return np.asarray(cKDTree(points).query(points, k=2)[0][:, 1], dtype=np.float64)


def _features(odds: FloatArray, to_failing: FloatArray, to_safe: FloatArray) -> FloatArray:
    """Return what the correction sees of each case, (m, 3)."""
    logs = np.log(np.column_stack([to_failing, to_safe]) + SOFTENING)
    return np.column_stack([odds, logs])


def _correction(margin: Margin, history: LevelHistory) -> Any:
    """Return the regression that corrects the log odds, or None while there is too little."""
    from sklearn.linear_model import LogisticRegression

    failed, points = history.failed, history.points
    if min(failed.sum(), (~failed).sum()) < CALIBRATE_FROM:
        return None
    to_failing, to_safe = _nearest(points, points[failed]), _nearest(points, points[~failed])
    # A case is not its own neighbour.
    to_failing[failed] = _second_nearest(points[failed])
    to_safe[~failed] = _second_nearest(points[~failed])
    return LogisticRegression().fit(_features(margin.left_out(), to_failing, to_safe), failed)
