"""What a surrogate says of the cases that a campaign did not run.

The surrogate is that of the sampler `coverage`, learned afresh from the outcomes of a run,
whichever sampler chose its cases.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Final

import numpy as np
from threadpoolctl import threadpool_limits

from merge_sumo.samplers.belief import JUDGED_FROM, learn_chance
from merge_sumo.samplers.history import LevelHistory
from merge_sumo.samplers.uniform import UniformSampler
from merge_sumo.system.workers import Workers, workers_or_cores
from merge_sumo.values.case import FloatArray, Pool
from merge_sumo.values.fmc import fmc
from merge_sumo.values.score import Outcome

FEWEST_FAILURES: Final = 5
"""Failures at a level from which a surrogate is learned. Chosen, not tuned."""
PLAUSIBLE: Final = 0.1
"""Chance to fail from which a place counts for `plausible_fmc`. Chosen, not tuned."""
POOL_POINTS: Final = {2: 10_000, 3: 20_000, 4: 20_000, 5: 20_000, 6: 20_000}
"""Uniform points by dimension: up to three as many as the cases of a ground truth."""
PART: Final = 4000
"""Points asked at a time, so that memory does not grow with their number."""

Grid = tuple[int, int, int]
"""Nodes in each coordinate; of two coordinates the last number is 1."""


Ask = Callable[[Sequence[FloatArray]], Sequence[FloatArray]]
"""Gives the chances to fail, (n,), at each of several sets of points, (n, d)."""


class Surface:
    """The surrogate of one level of a run."""

    def __init__(self, failing: FloatArray, ask: Ask, tolerated: float = 0.0) -> None:
        """Use a learned chance to fail and the points, (n, d), of the failures found.

        A place that fails in no more than a `tolerated` share of its runs is no failure.
        """
        self.plausible = max(PLAUSIBLE, tolerated)
        self._dims = failing.shape[1]
        self._failing = failing
        self._ask = ask
        self._pool: tuple[FloatArray, FloatArray] | None = None
        self._over: dict[Grid, FloatArray] = {}

    def chance(self, points: FloatArray) -> FloatArray:
        """Return the chance that cases at points, (n, d), of the unit cube fail: (n,)."""
        return self._chances(points)[0]

    def _chances(self, *sets: FloatArray) -> list[FloatArray]:
        parts = [np.array_split(points, len(points) // PART + 1) for points in sets]
        answers = iter(self._ask([part for of_set in parts for part in of_set]))
        return [np.concatenate([next(answers) for _ in of_set]) for of_set in parts]

    def work_out(self, grid: Grid | None) -> None:
        """Work out `pool`, and `over` a grid, at once: nobody has to wait for them later."""
        points = np.random.default_rng(0).random((POOL_POINTS[self._dims], self._dims))
        if grid is None:
            self._pool = points, self.chance(points)
        else:
            chance, self._over[grid] = self._chances(points, nodes(grid))
            self._pool = points, chance

    def plausible_fmc(self) -> float:
        """Return the coverage if all places failed that the surrogate does not exclude.

        As many uniform points as a ground truth has cases, those with a chance of at least
        `plausible`, together with the failures found. No more than the pool, though balls at its
        faces reach out of it, unless the failures found alone cover more. No confidence bound: a
        region of which the surrogate knows nothing is not in it.
        """
        points, chance = self.pool()
        whole = fmc(np.concatenate([self._failing, points[chance >= self.plausible]]))
        return whole if whole <= 1.0 else max(1.0, fmc(self._failing))

    def pool(self) -> tuple[FloatArray, FloatArray]:
        """Return uniform points of the unit cube, (n, d), and the chance of each to fail, (n,)."""
        if self._pool is None:
            self.work_out(None)
        assert self._pool is not None, "it was worked out"  # noqa: S101
        return self._pool

    def over(self, grid: Grid) -> FloatArray:
        """Return the chance at the nodes of a grid, (n,), in the order of `nodes`."""
        if grid not in self._over:
            self._over[grid] = self.chance(nodes(grid))
        return self._over[grid]


def nodes(grid: Grid) -> FloatArray:
    """Return the nodes of a grid of the unit cube, (n, d), the first coordinate running fastest."""
    axes = [np.linspace(0.0, 1.0, n) for n in grid if n > 1]
    mesh = np.meshgrid(*axes[::-1], indexing="ij")
    return np.stack([axis.ravel() for axis in mesh[::-1]], axis=1)


def learn_surface(
    outcomes: Sequence[Outcome],
    level: int,
    workers: Workers | None = None,
    tolerated: float = 0.0,
) -> Surface | None:
    """Return the surrogate of a level, or None where too few cases failed to learn from.

    It is asked on the cores of this process, or on `workers`, which learn it each for themselves.
    """
    at_level = [outcome for outcome in outcomes if outcome.case.level == level]
    if not at_level:
        return None
    sampler = UniformSampler(Pool(levels=(level,), scenario=at_level[0].case.scenario), seed=0)
    sampler.tolerated = tolerated
    sampler.tell(at_level)
    history = sampler.history(level)
    failing = history.points[history.failed]
    if len(failing) < FEWEST_FAILURES or len(history.failed) - len(failing) < JUDGED_FROM:
        return None
    if workers is not None and workers.count > 1 and not workers.here:
        return Surface(failing, partial(_on_workers, workers, history), tolerated)
    with threadpool_limits(1):
        return Surface(failing, partial(_on_cores, _learned(history)), tolerated)


def _learned(history: LevelHistory) -> Callable[[FloatArray], FloatArray]:
    chance = learn_chance(history)
    assert chance is not None, "there are cases enough"  # noqa: S101
    return chance


def _on_cores(
    chance: Callable[[FloatArray], FloatArray], parts: Sequence[FloatArray]
) -> list[FloatArray]:
    # Each part in one thread: a report is the same whatever the number of cores.
    with threadpool_limits(1), ThreadPoolExecutor(workers_or_cores(None)) as cores:
        return list(cores.map(chance, parts))


def _on_workers(
    workers: Workers, history: LevelHistory, parts: Sequence[FloatArray]
) -> list[FloatArray]:
    chances = partial(_learn_and_predict, history)
    by_place = dict(workers.run(chances, parts, lambda part: chances([part])[0]))
    return [by_place[place] for place in range(len(parts))]


def _learn_and_predict(history: LevelHistory, parts: Sequence[FloatArray]) -> list[FloatArray]:
    with threadpool_limits(1):
        chance = _learned(history)
        return [chance(part) for part in parts]
