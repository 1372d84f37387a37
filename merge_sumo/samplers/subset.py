"""Subset simulation, a baseline of the paper (Au and Beck, 2001).

Regions F1, F2, ... of ever lower margins end at the failures. The cases of a region are drawn by
Markov chains that start from the lowest margins of the region before (modified Metropolis).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from merge_sumo.samplers.base import LevelwiseSampler, reflect
from merge_sumo.samplers.history import LevelHistory
from merge_sumo.scenario.case import FloatArray

STAGE_SIZE: Final = 100
"""Samples of a stage, that is of one conditional region."""
SEED_SHARE: Final = 0.2
"""p0: the share of a stage that is in the next region and starts its chains. With 100 samples
that is 20 chains, and a batch of 20 moves each of them once."""
WIDTH0: Final = 0.5
"""Half width of the moves in the unit cube at the first region; it shrinks with the regions."""


@dataclass(frozen=True, slots=True)
class SubsetState:
    """The state of subset simulation after a history.

    Attributes:
        number: i of the present region; 0 is the whole cube, sampled uniformly.
        threshold: the region is where the margin is at or below this; infinite for the cube.
        chains: present state of each chain, (c, d); none for the cube.
        moved: moves made in this region so far.
    """

    number: int
    threshold: float
    chains: FloatArray
    moved: int


def replay(history: LevelHistory) -> SubsetState:
    """Return where the chains stand after a history of batches proposed by `SubsetSampler`.

    The k-th move of a stage belongs to chain k modulo their number. A batch may run over the end
    of a stage by a few samples, which then count for it.
    """
    dims = history.points.shape[1]
    number, threshold, moved = 0, np.inf, 0
    chains, levels = np.empty((0, dims)), np.empty(0)
    # The samples of the stage: states of the chains, so that a rejected move repeats its state.
    samples, margins = [np.empty((0, dims))], [np.empty(0)]
    for batch in np.unique(history.batch).tolist():
        points = history.points[history.batch == batch]
        values = history.margin[history.batch == batch]
        if number:
            chain = (moved + np.arange(len(points))) % len(chains)
            moved += len(points)
            rejected = values > threshold
            points = np.where(rejected[:, None], chains[chain], points)
            values = np.where(rejected, levels[chain], values)
            # Where a chain made several moves in a batch, the last one counts.
            chains[chain], levels[chain] = points, values
        if threshold < 0.0:
            continue
        samples.append(points)
        margins.append(values)
        population, of_population = np.concatenate(samples), np.concatenate(margins)
        if len(population) < STAGE_SIZE:
            continue
        seeds = np.argsort(of_population, kind="stable")[: round(SEED_SHARE * len(population))]
        threshold = float(of_population[seeds[-1]])
        if threshold < 0.0:
            seeds = np.flatnonzero(of_population < 0.0)
            threshold = np.nextafter(0.0, -np.inf)
        chains, levels = population[seeds], of_population[seeds]
        # The seeds are samples of the new region too.
        samples, margins = [chains.copy()], [levels.copy()]
        number, moved = number + 1, 0
    return SubsetState(number, threshold, chains, moved)


class SubsetSampler(LevelwiseSampler):
    """Conditional regions and Markov chains; the last region, the failures, is sampled on and on.

    Moves are reflected at the faces of the cube. That keeps them symmetric, so under the uniform
    distribution each is accepted exactly where it stays in the region.
    """

    about = "draws from ever smaller regions of low margins by Markov chains"
    colour = "#009E73"

    def propose(
        self, history: LevelHistory, n: int, rng: np.random.Generator, level: int
    ) -> FloatArray:
        """Return the next move of `n` chains, (n, d), or uniform points at first."""
        state = replay(history)
        if state.number == 0:
            return rng.random((n, history.dims))
        dims = state.chains.shape[1]
        chain = (state.moved + np.arange(n)) % len(state.chains)
        # A region with p0 of the volume of the one before has p0^(1/d) of its size.
        width = WIDTH0 * SEED_SHARE ** ((state.number - 1) / dims)
        return reflect(state.chains[chain] + rng.uniform(-width, width, (n, dims)))
