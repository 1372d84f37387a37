"""An oracle of the search: it is given all failures, and takes the most useful first."""

from __future__ import annotations

from collections.abc import Mapping
from heapq import heappop, heapreplace

import numpy as np

from merge_sumo.metrics.fmc import fmc
from merge_sumo.samplers.coverage_grid import CoverageGrid
from merge_sumo.scenario.case import FloatArray


def oracle(failures: Mapping[int, FloatArray], cases: int) -> FloatArray:
    """Return the coverage of an oracle after 0, 1, ... cases, summed over the levels.

    It takes, one after the other, the failure whose ball adds the most volume: greedy maximum
    coverage, which no order beats by more than a factor of e / (e - 1) (Nemhauser, Wolsey and
    Fisher, 1978). A sampler may still pass its end, the coverage of all failures: it may fail where
    the cases of the truth have missed.

    Args:
        failures: known failures in the unit cube by level, (m, d).
        cases: most cases of the oracle.

    Returns:
        The coverage, (cases + 1,).
    """
    greedy = {level: greedy_cover(points, cases) for level, points in failures.items()}
    gains = []
    for level, (points, added) in greedy.items():
        ball = fmc(np.zeros((1, points.shape[1])))
        gains += [(-gain * ball, level) for gain in added]
    order = [level for _, level in sorted(gains)]
    curve = np.zeros(cases + 1)
    for level, (points, _) in greedy.items():
        for n in range(cases + 1):
            curve[n] += fmc(points[: order[:n].count(level)])
    return curve


def greedy_cover(points: FloatArray, most: int) -> tuple[FloatArray, FloatArray]:
    """Order points greedily by the coverage that they add.

    The added coverage of a point never grows. So the best point is one that still adds its earlier
    value, if no other earlier value is larger (Minoux, 1978); of equal points it is the first.

    Args:
        points: points of the unit cube, (m, d).
        most: largest number of points.

    Returns:
        Points in greedy order, (n, d), and the added coverage of each in balls, (n,).
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
