"""Ours: ask for what users want, the batch that maximises the expected new coverage.

A case is worth P(fail) (`belief.py`) times the share of its ball (radius rho of the FMC) that is
not covered yet. Candidates are places anywhere, near failures, and where another car goes first;
the batch is picked from them greedily.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from merge_sumo.samplers.allocation import even_shares
from merge_sumo.samplers.base import LevelHistory, Sampler
from merge_sumo.samplers.belief import Belief, gap_m, has_gaps, nearest
from merge_sumo.samplers.ground import Ground
from merge_sumo.values.case import Case, FloatArray
from merge_sumo.values.fmc import radius_for

UNIFORM_QUERIES: Final = 1500
LOCAL_QUERIES: Final = 600
BETWEEN_QUERIES: Final = 600
LINES: Final = 40
LINE_STEPS: Final = 120
REFINED_QUERIES: Final = 600
"""Candidates per batch: anywhere, within LOCAL_REACH of a failure, between safe cases on either
side, on lines across the cube along the slope of the margin, and around the best of all these."""
LOCAL_REACH: Final = 2.0
BEST: Final = 150
REFINED_REACH: Final = 0.6
"""Reaches are in radii of the FMC."""
SHORTLIST: Final = 2000
"""Candidates from which the batch is picked."""
PICKED: Final = 0.8
"""Share of a pick's ball that counts as covered at least for the later picks of the batch."""
NEAREST: Final = 3
"""Failures that it takes to aim at failures alone, and else how many cases stand in for them."""
PATIENCE: Final = 40
"""Cases that are run before anything stands in for failures."""
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
            ground = Ground(history.dims)
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
            return Proposal(_spread_out(n, history.dims, rng), np.ones(n))
        # One thread: rounding must not depend on the number of cores.
        with threadpool_limits(1):
            return _Search(history, rng, n).batch(n)

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


class _Search:
    """One batch at one level."""

    def __init__(self, history: LevelHistory, rng: np.random.Generator, n: int) -> None:
        failing = history.points[history.failed]
        self._ground = Ground(history.dims)
        self._ground.cover(self._ground.balls(failing), 1.0)
        limit, trust = _limit(history), _trust(history)
        belief = Belief(history, limit)

        def trusted(of: Belief, cases: FloatArray) -> FloatArray:
            return of.of(cases) * trust[_far(cases, failing)]

        candidates = _candidates(history, belief, rng, n)
        probability, balls = trusted(belief, candidates), self._ground.balls(candidates)
        worth = probability * self._ground.new(balls)
        best = candidates[np.argsort(-worth, kind="stable")[:BEST]]
        refined = _around(best, REFINED_QUERIES, REFINED_REACH * radius_for(history.dims), rng)
        candidates = np.concatenate([candidates, refined])
        probability = np.concatenate([probability, trusted(belief, refined)])
        balls = np.concatenate([balls, self._ground.balls(refined)])
        worth = probability * (self._ground.new(balls) + EVEN_IF_COVERED)
        kept = np.argsort(-worth, kind="stable")[: max(SHORTLIST, n)]
        self._candidates, self._aim = candidates[kept], probability[kept]
        self._balls = balls[kept]
        self._probability = (
            self._aim if limit is None else trusted(Belief(history), self._candidates)
        )

    def batch(self, n: int) -> Proposal:
        """Return the greedy batch of `n` cases.

        Most of the ball of a pick counts as covered for the later ones: if the pick fails, it is
        covered, and if it does not, picks near it would mostly have been as wrong. What is aimed
        at may be a near miss, but only a failure is a gain.
        """
        balls = self._balls
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
    reach = LOCAL_REACH * radius_for(points.shape[1])
    return (nearest(points, failing) > reach).astype(np.int64)


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
    chance = Belief(before).of(since.points)
    far = _far(since.points, failing)
    foretold = np.bincount(far, chance, minlength=2)
    failed = np.bincount(far, since.failed, minlength=2)
    return np.minimum((failed + 1.0) / (foretold + 1.0), 1.0)


def _limit(history: LevelHistory) -> float | None:
    """Return the gap, in m, or the score that is aimed at; None for that of a failure.

    Where failures are rare, the cases that came nearest show the way, as in subset simulation.
    """
    if history.failed.sum() >= NEAREST or len(history.score) < PATIENCE:
        return None
    nearness = gap_m(history) if has_gaps(history) else history.score
    return float(np.partition(nearness, NEAREST - 1)[NEAREST - 1])


def _spread_out(n: int, dims: int, rng: np.random.Generator) -> FloatArray:
    """Return `n` points, (n, d), of a scrambled Halton sequence: no two of them close by chance."""
    from scipy.stats.qmc import Halton

    return np.asarray(Halton(dims, seed=rng).random(n), dtype=np.float64)


def _candidates(
    history: LevelHistory, belief: Belief, rng: np.random.Generator, n: int
) -> FloatArray:
    """Return more than `n` candidates, (m, d)."""
    worst = history.points[np.argsort(history.score, kind="stable")[:20]]
    failing = history.points[history.failed]
    local_reach = LOCAL_REACH * radius_for(history.dims)
    along = np.linspace(-1.0, 1.0, LINE_STEPS) + rng.uniform(-0.01, 0.01, (LINES, LINE_STEPS))
    base = rng.random((LINES, history.dims))
    lines = base[:, None] + along[..., None] * belief.rotation[:, 0]
    lines = lines.reshape(-1, history.dims)
    return np.concatenate(
        [
            rng.random((UNIFORM_QUERIES + n, history.dims)),
            _around(failing if len(failing) else worst, LOCAL_QUERIES, local_reach, rng),
            _between(belief, BETWEEN_QUERIES, rng),
            lines[((lines >= 0.0) & (lines <= 1.0)).all(axis=1)],
        ]
    )


def _between(belief: Belief, n: int, rng: np.random.Generator) -> FloatArray:
    """Return `n` places, (n, d), or none, between safe cases on either side, most in narrow
    brackets.
    """
    points = belief.history.points
    _, before, behind = (points[group] for group in belief.groups)
    if not (len(before) and len(behind)):
        return np.empty((0, points.shape[1]))
    near = [*range(1, 1 + min(3, len(before), len(behind)))]
    pairs = np.concatenate([_pairs(before, behind, near), _pairs(behind, before, near)[:, ::-1]])
    first, second = before[pairs[:, 0]], behind[pairs[:, 1]]
    reach = REFINED_REACH * radius_for(points.shape[1])
    weight = (np.linalg.norm(first - second, axis=1) + reach) ** -2.0
    chosen = rng.choice(len(pairs), size=n, p=weight / weight.sum())
    part = rng.random((n, 1))
    return np.asarray(first[chosen] * (1.0 - part) + second[chosen] * part, dtype=np.float64)


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
