"""An oracle of the search for failures: it knows all of them and takes the most useful first."""

from __future__ import annotations

from collections.abc import Mapping
from heapq import heappop, heapreplace
from typing import Final

import numpy as np

from merge_sumo.analysis.truth import Truth
from merge_sumo.metrics.fmc import fmc
from merge_sumo.samplers.coverage_grid import CoverageGrid
from merge_sumo.scenario.case import FloatArray

ORACLE_STEP: Final = 5
"""Cases between two points of the oracle's curve; divides all batch sizes that samplers choose."""


def oracle(truths: Mapping[int, Truth], cases: int, batch: int | None) -> dict[int, float]:
    """Return the coverage of an oracle by number of cases, summed over the levels.

    It knows the failures of the truth and takes, one after the other, the one whose ball adds the
    most volume: greedy maximum coverage, which no order beats by more than a factor of e / (e - 1)
    (Nemhauser, Wolsey and Fisher, 1978). A sampler may still pass its end, the truth's FMC: it may
    fail in places that the truth's cases have missed.

    Returns:
        FMC after every case of the first batch, and then after every batch, up to `cases`.
        Without a `batch`, samplers choose, and every ORACLE_STEP cases are shown.
    """
    batch = batch or ORACLE_STEP
    greedy = {level: greedy_cover(truth.failures, cases) for level, truth in truths.items()}
    ball = {level: fmc(np.zeros((1, truth.points.shape[1]))) for level, truth in truths.items()}
    gains = [(-g * ball[level], level) for level, (_, gain) in greedy.items() for g in gain]
    order = [level for _, level in sorted(gains)]
    shown = sorted({*range(min(batch, cases) + 1), *range(0, cases, batch), cases})
    return {
        n: sum(fmc(points[: order[:n].count(level)]) for level, (points, _) in greedy.items())
        for n in shown
    }


def greedy_cover(points: FloatArray, most: int) -> tuple[FloatArray, FloatArray]:
    """Return at most so many points, (m, d), in greedy order and what each adds, in balls.

    What a point adds never grows. So the best is one that still adds as much as it once did, if no
    other one ever did more (Minoux, 1978); of points that add the same it is the first.
    """
    grid = CoverageGrid(points.shape[1])
    queue = [(-1.0, place) for place in range(len(points))]
    order: list[int] = []
    gains: list[float] = []
    while queue and len(order) < most:
        once, place = queue[0]
        ball = grid.balls(points[[place]])
        new = float(grid.new(ball)[0])
        if new < -once:
            heapreplace(queue, (-new, place))
            continue
        heappop(queue)
        grid.cover(ball[0], 1.0)
        order.append(place)
        gains.append(new)
    return points[order], np.array(gains)
