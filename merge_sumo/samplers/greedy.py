"""A batch is picked case by case: each is the one that adds the most to those before it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from merge_sumo.samplers.coverage_grid import CoverageGrid
from merge_sumo.values.case import FloatArray
from merge_sumo.values.prediction import Prediction

PICKED: Final = 0.8
"""Share of a pick's ball that counts as covered at least for the later picks of the batch."""
EVEN_IF_COVERED: Final = 1e-3
"""Where all is covered, the likeliest failures still come before the others."""


@dataclass(frozen=True, slots=True)
class Proposal:
    """A batch in the order of its worth.

    Attributes:
        points: places in the unit cube, (n, d).
        gain: expected gain of each in balls, (n,).
        probability: P(fail) of each, (n,).
        predictions: of each case; None without a predictor.
    """

    points: FloatArray
    gain: FloatArray
    probability: FloatArray
    predictions: tuple[Prediction | None, ...]


def greedy(
    ground: CoverageGrid,
    points: FloatArray,
    aim: FloatArray,
    probability: FloatArray,
    n: int,
    last: FloatArray | None = None,
) -> tuple[list[int], FloatArray]:
    """Return the places of `n` candidates and their gains, (n,); covers the ground with them.

    Most of the ball of a pick counts as covered for the later ones: if the pick fails, it is
    covered, and if it does not, picks near it would mostly have been as wrong. What is aimed at may
    be a near miss, but only a failure is a gain.

    Args:
        ground: what is covered before.
        points: m candidates, (m, d).
        aim: what their balls are worth, (m,).
        probability: that they fail, (m,).
        n: how many are picked.
        last: what is aimed at instead by the last one of a batch, (m,).
    """
    picks: list[int] = []
    gains: list[float] = []
    free = np.ones(len(points), dtype=bool)
    balls = ground.balls(points)
    new = ground.new(balls)
    for number in range(n):
        for_this = aim if last is None or number < n - 1 else last
        worth = np.where(free, for_this * (new + EVEN_IF_COVERED), -1.0)
        best = int(np.argmax(worth))
        free[best] = False
        picks.append(best)
        gains.append(float(probability[best] * new[best]))
        ground.cover(balls[best], max(PICKED, float(aim[best])))
        near = np.linalg.norm(points - points[best], axis=1) <= ground.overlap
        new[near] = ground.new(balls[near])
    return picks, np.array(gains)
