"""Search for a batch at one level: candidates, their P(fail), and a greedy choice."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from merge_sumo.metrics.fmc import IntArray, radius_for
from merge_sumo.samplers.candidates import (
    LOCAL_REACH,
    REFINED_REACH,
    anywhere,
    around,
    between,
    spread_out,
    surrogate_candidates,
)
from merge_sumo.samplers.coverage_grid import CoverageGrid
from merge_sumo.samplers.history import LevelHistory
from merge_sumo.samplers.predictions import chance_by_gaps, disagreement
from merge_sumo.samplers.surrogate import Surrogate, signed_gaps
from merge_sumo.scenario.case import FloatArray

# With fewer failures than NEAREST after PATIENCE cases, the nearest misses count as failures, too.
NEAREST = 3
PATIENCE = 40
# Covered share of the ball of a pending case, and least covered share of the ball of a pick.
PICKED = 0.8
# Value of a covered ball: likely failures are still preferred.
EVEN_IF_COVERED = 1e-3


def near_miss_limit(history: LevelHistory) -> float | None:
    """Return the size of the signed gap up to which a case is treated as a failure.

    With few failures the nearest misses guide the search, as in subset simulation.

    Args:
        history: outcomes of the level.

    Returns:
        The gap of the third nearest miss; None, the limit of the criterion, with three failures, or
        before 40 cases.
    """
    if (history.failures > 0).sum() >= NEAREST or len(history.points) < PATIENCE:
        return None
    return float(np.sort(np.abs(signed_gaps(history)))[NEAREST - 1])


class Proposal(NamedTuple):
    """A batch, the most valuable case first.

    Attributes:
        points: cases in the unit cube, (n, d).
        gain: expected new coverage of each, in balls, (n,).
    """

    points: FloatArray
    gain: FloatArray


def greedy(
    grid: CoverageGrid,
    points: FloatArray,
    chance: FloatArray,
    n: int,
    *,
    aim: FloatArray | None = None,
    last: FloatArray | None = None,
) -> tuple[list[int], FloatArray]:
    """Choose candidates one by one, each with the most expected new coverage.

    Most of the ball of a pick counts as covered for the later picks: if the pick fails, the ball is
    covered, and if it does not, its neighbours would probably not have failed either.

    Args:
        grid: coverage before the batch; changed in place.
        points: candidates, (m, d).
        chance: P(fail) of each candidate, (m,).
        n: number of picks.
        aim: worth of the ball of each candidate, (m,); P(fail) by default.
        last: worth for the last pick, (m,); `aim` by default.

    Returns:
        Indices of the picks, and their expected new coverage in balls, (n,).
    """
    picks: list[int] = []
    gains: list[float] = []
    free = np.ones(len(points), dtype=bool)
    balls = grid.balls(points)
    new = grid.new(balls)
    if aim is None:
        aim = chance
    for number in range(n):
        target = aim
        if last is not None and number == n - 1:
            target = last
        worth = np.where(free, target * (new + EVEN_IF_COVERED), -1.0)
        best = int(np.argmax(worth))
        free[best] = False
        picks.append(best)
        gains.append(float(chance[best] * new[best]))
        grid.cover(balls[best], max(PICKED, float(aim[best])))
        near = np.linalg.norm(points - points[best], axis=1) <= grid.overlap
        new[near] = grid.new(balls[near])
    return picks, np.array(gains)


class LevelSearch:
    """Searches for the batch of a level.

    The model of the controller predicts the gaps of the candidates of all levels together, so the
    sampler calls it between the steps of the searches: `screening_candidates` for one member of the
    model, `shortlist` and rounds of `refinement_candidates` for all members, each of these followed
    by `add`, and at last `batch`. Without the model, `surrogate_batch` does all.

    Example:
        screened = search.screening_candidates()
        points = search.shortlist(screened, predict_by_one_member(screened), n=5)
        search.add(points, predict_by_all_members(points))
        proposal = search.batch(5)

    Attributes:
        history: outcomes of the level.
        pending: cases that run and have no outcome yet, (m, d).
        surrogate: P(fail) by the outcomes of the level; None with fewer than two.
        points: candidates, (m, d).
        gaps: gaps of the candidates that the members of the model predict, (M, m).
        chance: P(fail) of the candidates, (m,).
    """

    def __init__(
        self, history: LevelHistory, pending: FloatArray, weight: float, rng: np.random.Generator
    ) -> None:
        """Learn the surrogate.

        Args:
            history: outcomes of the level.
            pending: cases that run and have no outcome yet, (m, d).
            weight: weight of the model of the controller, from 0 to 1; the surrogate has the rest.
            rng: generator of the candidates.
        """
        self.history, self.pending = history, pending
        self.surrogate = Surrogate(history) if len(history.points) >= 2 else None
        self._weight, self._rng = weight, rng
        self._grid = CoverageGrid(history.dims)
        self._grid.cover(self._grid.balls(history.failing), 1.0)
        # A pending case is a pick of an earlier batch.
        for ball in self._grid.balls(pending):
            self._grid.cover(ball, PICKED)
        self.points: FloatArray = np.empty((0, history.dims))
        self.gaps: FloatArray = np.empty((0, 0))
        self.chance: FloatArray = np.empty(0)

    def chances(self, points: FloatArray, gaps: FloatArray) -> FloatArray:
        """Return P(fail) of cases by the model, by the surrogate, and by both.

        Args:
            points: cases, (n, d).
            gaps: their predicted gaps, (M, n).

        Returns:
            Probabilities, (3, n).
        """
        by_model = by_surrogate = chance_by_gaps(gaps)
        if self.surrogate is not None:
            by_surrogate = self.surrogate.predict(points)
        by_both = self._weight * by_model + (1.0 - self._weight) * by_surrogate
        return np.array([by_model, by_surrogate, by_both])

    def screening_candidates(self) -> FloatArray:
        """Return candidates, (m, d), for one member of the model."""
        history, rng = self.history, self._rng
        # With more than three coordinates failures leave many gaps, so more candidates are uniform.
        # Measured with design 2 on us23-traffic, one seed, after 400 and 800 cases: a covered share
        # of .86 and .98 at level 1, .89 and .95 at level 2; with 1,000 .77 and .90, .78 and .88.
        count = 5000 if history.dims > 3 else 1000
        screened = [anywhere(count, history.dims, rng)]
        if self.surrogate is not None:
            screened.append(between(self.surrogate, 200, rng))
        if len(history.failing):
            screened.append(
                around(history.failing, 300, LOCAL_REACH * radius_for(history.dims), rng)
            )
        return np.concatenate(screened)

    def shortlist(self, screened: FloatArray, gaps: FloatArray, n: int) -> FloatArray:
        """Return the first candidates that all members predict.

        Args:
            screened: screening candidates, (k, d).
            gaps: their gaps as one member predicts them, (1, k).
            n: size of the batch.

        Returns:
            Candidates, (m, d).
        """
        # 20 uniform ones, the best 80 of the member, and the best 40 of the surrogate.
        best = self._ranked(screened, chance_by_gaps(gaps), 80)
        chosen = [screened[:20], screened[best]]
        if self.surrogate is not None:
            own = self._rng.permutation(surrogate_candidates(self.surrogate, n, self._rng))[:1500]
            chosen.append(own[self._ranked(own, self.surrogate.predict(own), 40)])
        return np.concatenate(chosen)

    def add(self, points: FloatArray, gaps: FloatArray) -> None:
        """Add candidates to those of the batch.

        Args:
            points: candidates, (m, d).
            gaps: their gaps as all members predict them, (M, m).
        """
        chance = self.chances(points, gaps)[2]
        if len(self.points):
            points = np.concatenate([self.points, points])
            gaps = np.concatenate([self.gaps, gaps], axis=1)
            chance = np.concatenate([self.chance, chance])
        self.points, self.gaps, self.chance = points, gaps, chance

    def refinement_candidates(self, n: int) -> FloatArray:
        """Return 60 candidates around the best ones and around a batch chosen among all.

        Args:
            n: size of the batch.

        Returns:
            Candidates, (60, d).
        """
        picks, _ = greedy(self._grid.copy(), self.points, self.chance, n)
        best = self._ranked(self.points, self.chance, n)
        centres = self.points[np.concatenate([best, picks])]
        return around(centres, 60, REFINED_REACH * radius_for(self.history.dims), self._rng)

    def batch(self, n: int) -> Proposal:
        """Choose the batch among the candidates; without a surrogate, half fills the cube evenly.

        Args:
            n: size of the batch.
        """
        spread: FloatArray = np.empty((0, self.history.dims))
        if self.surrogate is None:
            spread = spread_out(n - n // 2, self.history.dims, self._rng)
            self._grid.cover(self._grid.balls(spread), PICKED)
        # The last case of a batch of five and more is the most informative one.
        last = disagreement(self.gaps) if n >= 5 else None
        picks, gain = greedy(self._grid, self.points, self.chance, n - len(spread), last=last)
        points = np.concatenate([spread, self.points[picks]])
        return Proposal(points, np.concatenate([np.ones(len(spread)), gain]))

    def surrogate_batch(self, n: int) -> Proposal:
        """Choose a batch by the surrogate alone.

        Args:
            n: size of the batch.
        """
        history, surrogate = self.history, self.surrogate
        assert surrogate is not None, "there are outcomes"  # noqa: S101
        limit = near_miss_limit(history)
        aimed = surrogate if limit is None else Surrogate(history, limit)
        points = surrogate_candidates(aimed, n, self._rng)
        aim = aimed.predict(points)
        best = points[self._ranked(points, aim, 150)]
        refined = around(best, 600, REFINED_REACH * radius_for(history.dims), self._rng)
        points = np.concatenate([points, refined])
        aim = np.concatenate([aim, aimed.predict(refined)])
        shortlist = self._ranked(points, aim, max(2000, n))
        points, aim = points[shortlist], aim[shortlist]
        chance = aim if limit is None else surrogate.predict(points)
        picks, gain = greedy(self._grid, points, chance, n, aim=aim)
        return Proposal(points[picks], gain)

    def _ranked(self, points: FloatArray, chance: FloatArray, most: int) -> IntArray:
        """Return the indices of the points with the largest gains of their own, `most` at most."""
        worth = chance * (self._grid.new(self._grid.balls(points)) + EVEN_IF_COVERED)
        return np.argsort(-worth, kind="stable")[:most]
