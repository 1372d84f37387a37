"""CMA-ME of `ribs` (pyribs): evolution strategies that fill an archive of starts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from merge_sumo.metrics.outcome import Outcome
from merge_sumo.samplers.base import LevelwiseSampler
from merge_sumo.samplers.history import LevelHistory
from merge_sumo.scenario.case import FloatArray, Pool

POPULATION: Final = 6
"""Solutions of an emitter in a generation, at least: 4 + 3 ln d, the default of CMA-ES."""
EMITTERS: Final = 2
CELL: Final = 0.05
"""Width of a cell of the archive: the radius of the balls whose volume is the coverage."""
SIGMA0: Final = 0.1
"""First step size, in the unit cube."""
SAFEST: Final = -1.0
"""Objective of a case without a verdict: no case has less."""


class CmaMeSampler(LevelwiseSampler):
    """Ranks solutions by what they add to an archive; the objective is -margin.

    Source: Fontaine et al., "Covariance Matrix Adaptation for the Rapid Illumination of Behavior
    Space" (2020). The measures of the archive are the coordinates of the start, so that it keeps
    the worst case of each cell of the pool.

    A scheduler of the library keeps a random state, and a sampler is a pure function of its
    outcomes. So the search is replayed for each batch: it is asked for earlier batches, and told
    their results.
    """

    about = "fills an archive of starts by evolution strategies (pyribs, CMA-ME)"
    colour = "#D55E00"

    def __init__(self, pool: Pool, seed: int, predictor: Any = None) -> None:
        """Start without outcomes."""
        super().__init__(pool, seed, predictor)
        self._told: dict[int, Outcome] = {}

    def batch_size(self) -> int:
        """Return a generation of all emitters at each level."""
        return EMITTERS * POPULATION * len(self.pool.levels)

    def tell(
        self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray] | None = None
    ) -> None:
        """Take outcomes; one without a verdict has a place in a generation, too."""
        super().tell(outcomes, motions)
        self._told |= {outcome.index: outcome for outcome in outcomes}

    def propose(
        self, history: LevelHistory, n: int, rng: np.random.Generator, level: int
    ) -> FloatArray:
        """Return the next `n` solutions, (n, d)."""
        batches = self._objectives(level)
        first = len(next(iter(batches.values()), range(n)))
        search = Illumination(history.dims, (self.seed, level), first)
        for objectives in batches.values():
            search.ask(len(objectives))
            search.tell(objectives)
        return search.ask(n)

    def _objectives(self, level: int) -> dict[int, list[float]]:
        """Return the objectives of a level by batch, in the order of the proposals."""
        batches: dict[int, list[float]] = {}
        for _, outcome in sorted(self._told.items()):
            if outcome.case.level == level:
                objective = SAFEST if outcome.margin is None else -outcome.margin
                batches.setdefault(outcome.batch, []).append(objective)
        return batches


class Illumination:
    """A search in the unit cube: a Sobol design, then generations, cut into batches of any size.

    The emitters start at the worst cases of the design.
    """

    def __init__(self, dims: int, seed: Sequence[int], first: int) -> None:
        """Prepare a search; its first batch has the size of a generation."""
        from ribs.archives import GridArchive
        from scipy.stats.qmc import Sobol

        self._dims = dims
        self._rng = np.random.default_rng(seed)
        self._emitters = max(1, first // POPULATION)
        self._population = max(POPULATION, first // self._emitters)
        self._archive = GridArchive(
            solution_dim=dims,
            dims=[round(1.0 / CELL)] * dims,
            ranges=[(0.0, 1.0)] * dims,
            seed=self._integer(),
        )
        self._scheduler: Any = None
        size = self._emitters * self._population
        design = Sobol(dims, rng=self._rng).random_base2((size - 1).bit_length())
        self._generation: FloatArray = design[:size]
        self._objectives: list[float] = []
        self._asked: FloatArray = design[:0]

    def ask(self, n: int) -> FloatArray:
        """Return `n` points, (n, d): uniform ones where the generation has too few left."""
        first = len(self._objectives)
        left = self._generation[first : first + n]
        self._asked = np.concatenate([left, self._rng.random((n - len(left), self._dims))])
        return self._asked

    def tell(self, objectives: Sequence[float]) -> None:
        """Take the objectives of the points that were just asked for."""
        place = min(len(self._generation) - len(self._objectives), len(objectives))
        if place < len(objectives):
            uniform = self._asked[place:]
            self._archive.add(uniform, objectives[place:], uniform)
        self._objectives += objectives[:place]
        if len(self._objectives) < len(self._generation):
            return
        if self._scheduler is None:
            self._archive.add(self._generation, self._objectives, self._generation)
            self._scheduler = self._started()
        else:
            self._scheduler.tell(self._objectives, self._generation)
        self._generation, self._objectives = np.asarray(self._scheduler.ask()), []

    def _started(self) -> Any:
        """Return the scheduler, whose emitters start at the worst points of the design."""
        from ribs.emitters import EvolutionStrategyEmitter
        from ribs.schedulers import Scheduler

        worst_first = np.argsort(-np.array(self._objectives), kind="stable")
        emitters = [
            EvolutionStrategyEmitter(
                self._archive,
                x0=start,
                sigma0=SIGMA0,
                ranker="2imp",
                selection_rule="mu",
                bounds=[(0.0, 1.0)] * self._dims,
                batch_size=self._population,
                seed=self._integer(),
            )
            for start in self._generation[worst_first[: self._emitters]]
        ]
        return Scheduler(self._archive, emitters)

    def _integer(self) -> int:
        """Return a seed for a part of the library."""
        return int(self._rng.integers(2**31))
