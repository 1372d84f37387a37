"""A batch at one level: candidates, their P(fail), and a greedy choice by expected new coverage."""

from __future__ import annotations

from typing import Final

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
from merge_sumo.samplers.failure_probability import FailureProbability, nearness
from merge_sumo.samplers.greedy import EVEN_IF_COVERED, PICKED, Proposal, covered_grid, greedy
from merge_sumo.samplers.history import LevelHistory
from merge_sumo.samplers.predictor import disagreement, failure_probability
from merge_sumo.scenario.case import FloatArray

FEWEST: Final = 2
"""Fewest cases for a surrogate."""
NEAREST: Final = 3
"""Fewest failures to aim at failures alone; otherwise as many nearest cases stand in for them."""
PATIENCE: Final = 40
"""Cases before near misses stand in for failures."""
BEST: Final = 150
REFINED_QUERIES: Final = 600
SHORTLIST: Final = 2000
"""Of the surrogate alone: the best candidates, others around these, and those to choose from."""
ANYWHERE: Final = 1000
ANYWHERE_ABOVE_3D: Final = 5000
ON_FACES: Final = 0.15
NEAR: Final = 300
BETWEEN: Final = 200
"""Candidates that one member screens: uniform with a share on the faces, near failures, and
between safe cases of the two merging orders. With more than three coordinates, where failures leave
many gaps, more are uniform (measured with design 2 on us23-traffic, one seed: after 400 and 800
cases a covered share of .86 and .98 at level 1, .89 and .95 at level 2; with 1,000 it is .77 and
.90, .78 and .88)."""
SURROGATE_CANDIDATES: Final = 1500
"""Candidates that the surrogate screens."""
SCREENED: Final = 80
OF_SURROGATE: Final = 40
AT_RANDOM: Final = 20
"""Candidates that all members predict: the best of one member, the best of the surrogate, and
uniform ones."""
ROUNDS: Final = 3
REFINED: Final = 60
"""Rounds of candidates around the best ones and around the batch that would be picked."""
EXPLORES_FROM: Final = 5
"""Size of a batch from which its last case is the most informative one."""


def near_miss_limit(history: LevelHistory) -> float | None:
    """Return the gap, or the margin, that the search aims at; None for that of a failure.

    With few failures, the nearest misses guide the search, as in subset simulation.
    """
    if (history.failures > 0).sum() >= NEAREST or len(history.points) < PATIENCE:
        return None
    return float(np.partition(nearness(history), NEAREST - 1)[NEAREST - 1])


class LevelSearch:
    """Search for the batch of a level: candidates with P(fail), and a greedy choice among them.

    The model of the controller rolls the candidates of all levels out together, so the sampler asks
    it, and a search takes its answers.

    Attributes:
        history: outcomes of the level.
        pending: cases that run and have no outcome yet, (m, d).
        surrogate: P(fail) by the outcomes of the level; None with fewer than `FEWEST`.
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
            weight: that of the model of the controller; the surrogate has the rest.
            rng: generator of the candidates.
        """
        self.history, self.pending = history, pending
        self.surrogate = FailureProbability(history) if len(history.points) >= FEWEST else None
        self._weight, self._rng = weight, rng
        self._grid = covered_grid(history, pending)
        self.points: FloatArray = np.empty((0, history.dims))
        self.gaps: FloatArray = np.empty((0, 0))
        self.chance: FloatArray = np.empty(0)

    def chances(self, points: FloatArray, gaps: FloatArray) -> FloatArray:
        """Return P(fail) of cases, (3, n), by the model, by the surrogate, and by both.

        Args:
            points: cases, (n, d).
            gaps: their predicted gaps, (M, n).
        """
        by_model = by_surrogate = failure_probability(gaps)
        if self.surrogate is not None:
            by_surrogate = self.surrogate.predict(points)
        by_both = self._weight * by_model + (1.0 - self._weight) * by_surrogate
        return np.array([by_model, by_surrogate, by_both])

    def screened(self) -> FloatArray:
        """Return candidates, (m, d), for one member of the model."""
        history, rng = self.history, self._rng
        count = ANYWHERE_ABOVE_3D if history.dims > 3 else ANYWHERE
        screened = [anywhere(count, history.dims, ON_FACES, rng)]
        if self.surrogate is not None:
            screened.append(between(self.surrogate, BETWEEN, rng))
        failing = history.points[history.failed]
        if len(failing):
            screened.append(around(failing, NEAR, LOCAL_REACH * radius_for(history.dims), rng))
        return np.concatenate(screened)

    def first(self, screened: FloatArray, gaps: FloatArray, n: int) -> FloatArray:
        """Return the first candidates, (m, d), for all members.

        Args:
            screened: candidates of one member, (k, d).
            gaps: its predictions, (1, k).
            n: size of the batch.
        """
        best = self._ranked(screened, failure_probability(gaps), SCREENED)
        chosen = [screened[:AT_RANDOM], screened[best]]
        if self.surrogate is not None:
            own = self._rng.permutation(surrogate_candidates(self.surrogate, n, self._rng))
            own = own[:SURROGATE_CANDIDATES]
            chosen.append(own[self._ranked(own, self.surrogate.predict(own), OF_SURROGATE)])
        return np.concatenate(chosen)

    def add(self, points: FloatArray, gaps: FloatArray) -> None:
        """Take candidates, (m, d), with the gaps that all members predict, (M, m)."""
        chance = self.chances(points, gaps)[2]
        if len(self.points):
            points = np.concatenate([self.points, points])
            gaps = np.concatenate([self.gaps, gaps], axis=1)
            chance = np.concatenate([self.chance, chance])
        self.points, self.gaps, self.chance = points, gaps, chance

    def refined(self, n: int) -> FloatArray:
        """Return candidates, (m, d), around the best ones and around a batch of `n`."""
        picks, _ = greedy(self._grid.copy(), self.points, self.chance, self.chance, n)
        best = self._ranked(self.points, self.chance, n)
        centres = self.points[np.concatenate([best, picks])]
        return around(centres, REFINED, REFINED_REACH * radius_for(self.history.dims), self._rng)

    def batch(self, n: int) -> Proposal:
        """Return the batch of `n` candidates; without a surrogate half is spread over the cube."""
        spread: FloatArray = np.empty((0, self.history.dims))
        if self.surrogate is None:
            spread = spread_out(n - n // 2, self.history.dims, self._rng)
            self._grid.cover(self._grid.balls(spread), PICKED)
        last = disagreement(self.gaps) if n >= EXPLORES_FROM else None
        picks, gain = greedy(
            self._grid, self.points, self.chance, self.chance, n - len(spread), last
        )
        return Proposal(
            np.concatenate([spread, self.points[picks]]),
            np.concatenate([np.ones(len(spread)), gain]),
        )

    def surrogate_batch(self, n: int) -> Proposal:
        """Return a batch of `n` cases by the surrogate alone."""
        history, surrogate = self.history, self.surrogate
        assert surrogate is not None, "there are outcomes"  # noqa: S101
        limit = near_miss_limit(history)
        aimed = surrogate if limit is None else FailureProbability(history, limit)
        points = surrogate_candidates(aimed, n, self._rng)
        aim = aimed.predict(points)
        best = points[self._ranked(points, aim, BEST)]
        reach = REFINED_REACH * radius_for(history.dims)
        refined = around(best, REFINED_QUERIES, reach, self._rng)
        points = np.concatenate([points, refined])
        aim = np.concatenate([aim, aimed.predict(refined)])
        shortlist = self._ranked(points, aim, max(SHORTLIST, n))
        points, aim = points[shortlist], aim[shortlist]
        chance = aim if limit is None else surrogate.predict(points)
        picks, gain = greedy(self._grid, points, aim, chance, n)
        return Proposal(points[picks], gain)

    def _ranked(self, points: FloatArray, chance: FloatArray, most: int) -> IntArray:
        """Return the indices of the `most` points with the largest expected gain of their own."""
        worth = chance * (self._grid.new(self._grid.balls(points)) + EVEN_IF_COVERED)
        return np.argsort(-worth, kind="stable")[:most]
