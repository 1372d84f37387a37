"""The failure probability of cases that a campaign did not run, by a surrogate.

It is the surrogate of the sampler `coverage`, learned from the outcomes of any sampler.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from threadpoolctl import threadpool_limits

from merge_sumo.metrics.outcome import Outcome
from merge_sumo.samplers.surrogate import JUDGED_FROM, learn_chance
from merge_sumo.samplers.uniform import UniformSampler
from merge_sumo.scenario.case import FloatArray, Pool

FEWEST_FAILURES = 5
"""Failures at a level from which a surrogate is learned. Chosen, not tuned."""
PART = 4000
"""Points predicted at a time, so that memory does not grow with their number."""

Grid = tuple[int, int, int]
"""Nodes in each coordinate; of two coordinates the last number is 1."""

Surface = Callable[[FloatArray], FloatArray]
"""Returns the failure probability of cases, (n,), at points of the unit cube, (n, d)."""


def nodes(grid: Grid) -> FloatArray:
    """Return the nodes of a grid of the unit cube, (n, d), the first coordinate running fastest.

    Args:
        grid: number of nodes along each coordinate.
    """
    axes = [np.linspace(0.0, 1.0, n) for n in grid if n > 1]
    mesh = np.meshgrid(*axes[::-1], indexing="ij")
    return np.stack([axis.ravel() for axis in mesh[::-1]], axis=1)


def learn_surface(
    outcomes: Sequence[Outcome], level: int, tolerated: float = 0.0
) -> Surface | None:
    """Learn the surrogate of a level.

    Example:
        surface = learn_surface(run.outcomes, level=0)
        chance = surface(nodes((50, 50, 1)))

    Args:
        outcomes: outcomes of a campaign.
        level: level of the POV.
        tolerated: share of its runs in which a case may fail, 0 to 1.

    Returns:
        The surrogate; None where too few cases failed or passed to learn from.
    """
    at_level = [outcome for outcome in outcomes if outcome.case.level == level]
    if not at_level:
        return None
    sampler = UniformSampler(Pool(levels=(level,), scenario=at_level[0].case.scenario), seed=0)
    sampler.tolerated = tolerated
    sampler.tell(at_level)
    history = sampler.history(level)
    failing = int(history.failed.sum())
    if failing < FEWEST_FAILURES or len(history.failed) - failing < JUDGED_FROM:
        return None
    with threadpool_limits(1):
        predict = learn_chance(history)
    assert predict is not None, "there are enough cases"  # noqa: S101

    def chance(points: FloatArray) -> FloatArray:
        parts = np.array_split(points, len(points) // PART + 1)
        # In one thread: the answer is the same whatever the number of cores.
        with threadpool_limits(1):
            return np.concatenate(list(map(predict, parts)))

    return chance
