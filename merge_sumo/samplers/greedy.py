"""Greedy selection of a batch: each pick adds the most expected coverage to those before it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from merge_sumo.samplers.coverage_grid import CoverageGrid
from merge_sumo.samplers.history import LevelHistory
from merge_sumo.scenario.case import FloatArray

PICKED: Final = 0.8
"""Least share of a pick's ball that counts as covered for the later picks of the batch, and the
share of a pending case's ball that does."""
EVEN_IF_COVERED: Final = 1e-3
"""Worth of a covered ball: the likeliest failures still come before the others."""


@dataclass(frozen=True, slots=True)
class Proposal:
    """A batch, the most valuable case first.

    Attributes:
        points: cases in the unit cube, (n, d).
        gain: expected new coverage of each, in balls, (n,).
    """

    points: FloatArray
    gain: FloatArray


def covered_grid(history: LevelHistory, pending: FloatArray) -> CoverageGrid:
    """Return the grid that is covered by the failures of a history, and by pending cases, (m, d).

    A pending case is a pick of an earlier batch: most of its ball counts as covered.
    """
    grid = CoverageGrid(history.dims)
    grid.cover(grid.balls(history.points[history.failed]), 1.0)
    for ball in grid.balls(pending) if len(pending) else ():
        grid.cover(ball, PICKED)
    return grid


def greedy(
    grid: CoverageGrid,
    points: FloatArray,
    aim: FloatArray,
    probability: FloatArray,
    n: int,
    last: FloatArray | None = None,
) -> tuple[list[int], FloatArray]:
    """Return the indices of `n` candidates and their gains, (n,); covers the grid with them.

    Most of the ball of a pick counts as covered for the later picks: if the pick fails, the ball is
    covered, and if it does not, its neighbours would probably not have failed either. The aim may
    include near misses, but only a failure is a gain.

    Args:
        grid: coverage before the batch; changed in place.
        points: candidates, (m, d).
        aim: worth of the ball of each, (m,).
        probability: P(fail) of each, (m,).
        n: number of picks.
        last: worth that replaces `aim` for the last pick, (m,).
    """
    picks: list[int] = []
    gains: list[float] = []
    free = np.ones(len(points), dtype=bool)
    balls = grid.balls(points)
    new = grid.new(balls)
    for number in range(n):
        target = aim if last is None or number < n - 1 else last
        worth = np.where(free, target * (new + EVEN_IF_COVERED), -1.0)
        best = int(np.argmax(worth))
        free[best] = False
        picks.append(best)
        gains.append(float(probability[best] * new[best]))
        grid.cover(balls[best], max(PICKED, float(aim[best])))
        near = np.linalg.norm(points - points[best], axis=1) <= grid.overlap
        new[near] = grid.new(balls[near])
    return picks, np.array(gains)
