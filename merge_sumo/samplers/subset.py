"""Subset simulation, a baseline of the paper (Au and Beck, 2001).

Markov chains draw the cases of regions F1, F2, ... of ever lower margins, which end at the
failures; each region's chains start from the lowest margins of the last one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from merge_sumo.samplers.base import LevelwiseSampler, reflect
from merge_sumo.samplers.history import LevelHistory
from merge_sumo.scenario.case import FloatArray

# Samples of a stage, that is of one conditional region.
STAGE_SIZE = 100
# p0: the share of a stage that is in the next region and starts its chains. With 100 samples
# these are 20 chains, and a batch of 20 moves each of them once.
SEED_SHARE = 0.2


class SubsetState(NamedTuple):
    """The state of subset simulation after a history.

    Attributes:
        number: i of the current region; 0 is the whole cube, sampled uniformly.
        threshold: the region is where the margin is at or below this; infinite for the cube.
        chains: state of each chain, (c, d); none for the cube.
        moved: moves made in this region so far.
    """

    number: int
    threshold: float
    chains: FloatArray
    moved: int


def replay(history: LevelHistory) -> SubsetState:
    """Return the state after the batches that `SubsetSampler` proposed.

    The k-th move of a stage belongs to chain k modulo their number. Surplus samples of the last
    batch of a stage count for it.

    Args:
        history: outcomes of the level.
    """
    number, threshold, moved = 0, np.inf, 0
    chains, levels = np.empty((0, history.dims)), np.empty(0)
    # Samples of the stage are states of the chains: a rejected move repeats its state.
    samples, margins = chains, levels
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
        samples, margins = np.concatenate([samples, points]), np.append(margins, values)
        if len(samples) < STAGE_SIZE:
            continue
        seeds = np.argsort(margins, kind="stable")[: round(SEED_SHARE * len(samples))]
        threshold = float(margins[seeds[-1]])
        if threshold < 0.0:
            seeds = np.flatnonzero(margins < 0.0)
            threshold = np.nextafter(0.0, -np.inf)
        # The seeds are samples of the new region, too.
        samples, margins = samples[seeds], margins[seeds]
        chains, levels = samples.copy(), margins.copy()
        number, moved = number + 1, 0
    return SubsetState(number, threshold, chains, moved)


class SubsetSampler(LevelwiseSampler):
    """Samples conditional regions by Markov chains; the last region is that of the failures.

    Moves are reflected at the faces of the cube. That keeps them symmetric, so under the uniform
    distribution each is accepted exactly where it stays in the region.
    """

    about = "subset simulation: draws from smaller and smaller regions of low margins"
    colour = "#009E73"

    def propose(
        self, history: LevelHistory, n: int, rng: np.random.Generator, level: int
    ) -> FloatArray:
        """Return moves of the chains, (n, d); uniform points in the first stage.

        Args:
            history: outcomes of the level.
            n: number of moves.
            rng: random generator.
            level: level of the POV.
        """
        state = replay(history)
        if state.number == 0:
            return rng.random((n, history.dims))
        chain = (state.moved + np.arange(n)) % len(state.chains)
        # Half width of the moves. A region with p0 of the volume of the last one has p0^(1/d) of
        # its size.
        width = 0.5 * SEED_SHARE ** ((state.number - 1) / history.dims)
        return reflect(state.chains[chain] + rng.uniform(-width, width, (n, history.dims)))
