"""Simulated annealing, a baseline of the paper (Dixon and Szego, 1978; Kirkpatrick et al., 1983).

It is an optimiser: each chain ends at one minimum of the margin.
"""

from __future__ import annotations

import math

import numpy as np

from merge_sumo.metrics.fmc import IntArray
from merge_sumo.samplers.base import LevelwiseSampler, reflect
from merge_sumo.samplers.history import LevelHistory
from merge_sumo.scenario.case import FloatArray

# Chains per level: a single one may spend the whole budget around a minimum of no failures.
CHAINS = 2


class AnnealingSampler(LevelwiseSampler):
    """Lowers the margin by chains of random moves, which cool down from batch to batch.

    A batch has independent moves from the state of each chain in turn. The states follow from the
    history: the random numbers that accept moves depend on the seed and the batch alone.
    """

    about = "minimises the margin by simulated annealing"
    colour = "#E69F00"

    def propose(
        self, history: LevelHistory, n: int, rng: np.random.Generator, level: int
    ) -> FloatArray:
        """Return moves of the chains, (n, d); without outcomes uniform points.

        Args:
            history: outcomes of the level.
            n: number of moves.
            rng: random generator.
            level: level of the POV.
        """
        if not len(history.points):
            return rng.random((n, history.dims))
        states = self._replay(history, level)
        # Standard deviation of the moves in the unit cube; it shrinks from batch to batch.
        step = max(0.25 * 0.85 ** (len(np.unique(history.batch)) - 1), 0.02)
        points = history.points[states[np.arange(n) % len(states)]]
        return reflect(points + step * rng.standard_normal(points.shape))

    def _replay(self, history: LevelHistory, level: int) -> IntArray:
        """Return the row in the history of the state of each chain, (chains,).

        The k-th move of a batch belongs to chain k modulo their number.
        """
        batches = np.unique(history.batch)
        first = np.flatnonzero(history.batch == batches[0])
        best = []
        for chain in range(min(CHAINS, len(first))):
            rows = first[chain::CHAINS]
            best.append(rows[np.argmin(history.margin[rows])])
        states = np.array(best)
        for cooled, batch in enumerate(batches[1:].tolist()):
            # A rise of the margin by the temperature is accepted with probability 1/e.
            temperature = 0.4 * 0.8**cooled
            moves = np.flatnonzero(history.batch == batch)
            chances = np.random.default_rng([self.seed, level, batch, 0]).random(len(moves))
            for number, move in enumerate(moves.tolist()):
                chain = number % len(states)
                rise = history.margin[move] - history.margin[states[chain]]
                # Metropolis et al. (1953): downhill always, uphill sometimes.
                if rise <= 0.0 or chances[number] < math.exp(-rise / temperature):
                    states[chain] = move
        return states
