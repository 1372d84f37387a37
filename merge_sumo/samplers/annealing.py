"""Simulated annealing, a baseline of the paper (Dixon and Szego, 1978; Kirkpatrick et al., 1983).

Chains look for the lowest margin and cool down as batches come in, so their cases end up around
one minimum each: it is an optimiser, not a search for all regions of failures.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.samplers.base import LevelwiseSampler, reflect
from merge_sumo.samplers.history import LevelHistory
from merge_sumo.scenario.case import FloatArray

CHAINS: Final = 2
"""Chains per level: a single one may spend the whole budget around a minimum of no failures."""
TEMPERATURE0: Final = 0.4
"""Of the first move, as a margin: a rise by it is accepted with probability 1/e."""
COOLING: Final = 0.8
"""Factor of the temperature from batch to batch."""
STEP0: Final = 0.25
"""Standard deviation of the first moves, in the unit cube."""
STEP_SHRINK: Final = 0.85
"""Factor of the step from batch to batch."""
STEP_MIN: Final = 0.02


class AnnealingSampler(LevelwiseSampler):
    """Chains that take turns; a batch holds independent moves from where each chain stands.

    The chains are replayed from the history. What decides on a move is drawn anew from the seed
    and the batch, so that it is the same whenever it is replayed.
    """

    about = "looks for the lowest margin by simulated annealing"
    colour = "#E69F00"

    def propose(
        self, history: LevelHistory, n: int, rng: np.random.Generator, level: int
    ) -> FloatArray:
        """Return `n` moves, (n, d), of the chains; a uniform batch before they stand anywhere."""
        if not len(history.points):
            return rng.random((n, history.dims))
        standing = self._replay(history, level)
        cooled = len(np.unique(history.batch)) - 1
        step = max(STEP0 * STEP_SHRINK**cooled, STEP_MIN)
        here = history.points[standing[np.arange(n) % len(standing)]]
        return reflect(here + step * rng.standard_normal(here.shape))

    def _replay(self, history: LevelHistory, level: int) -> NDArray[np.int64]:
        """Return the places in the history of the cases where the chains stand, (chains,).

        The k-th move of a batch belongs to chain k modulo their number.
        """
        batches = np.unique(history.batch)
        first = np.flatnonzero(history.batch == batches[0])
        turns = [first[chain::CHAINS] for chain in range(min(CHAINS, len(first)))]
        standing = np.array([turn[np.argmin(history.margin[turn])] for turn in turns])
        for cooled, batch in enumerate(batches[1:].tolist()):
            temperature = TEMPERATURE0 * COOLING**cooled
            moves = np.flatnonzero(history.batch == batch)
            luck = np.random.default_rng([self.seed, level, batch, 0]).random(len(moves))
            turn = (np.arange(len(moves)) % len(standing)).tolist()
            for chain, move, chance in zip(turn, moves.tolist(), luck.tolist(), strict=True):
                rise = float(history.margin[move] - history.margin[standing[chain]])
                # Metropolis et al. (1953): downhill always, uphill sometimes.
                if rise <= 0.0 or chance < math.exp(-rise / temperature):
                    standing[chain] = move
        return standing
