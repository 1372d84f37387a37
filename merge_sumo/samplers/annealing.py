"""Simulated annealing, a baseline of the paper (Dixon and Szego, 1978; Kirkpatrick et al., 1983).

One chain looks for the lowest score and cools down as batches come in, so its cases end up around
one minimum: it is an optimiser, not a search for all regions of failures.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from merge_sumo.case import FloatArray
from merge_sumo.samplers.base import LevelHistory, LevelwiseSampler, reflect, uniform_points

TEMPERATURE0: Final = 200.0
"""Of the first move, in units of the score: a rise by it is accepted with probability 1/e."""
COOLING: Final = 0.8
"""Factor of the temperature from batch to batch."""
STEP0: Final = 0.25
"""Standard deviation of the first moves, in the unit cube."""
STEP_SHRINK: Final = 0.85
"""Factor of the step from batch to batch."""
STEP_MIN: Final = 0.02


class AnnealingSampler(LevelwiseSampler):
    """One chain per level; a batch holds independent moves from where the chain stands.

    The chain is replayed from the history. What decides on a move is drawn anew from the seed
    and the batch, so that it is the same whenever it is replayed.
    """

    def propose(
        self, history: LevelHistory, n: int, rng: np.random.Generator, level: int
    ) -> FloatArray:
        """Return `n` moves, (n, d), of the chain; a uniform batch before it stands anywhere."""
        if not len(history.points):
            return uniform_points(n, level, rng)
        current = self._replay(history, level)
        cooled = len(np.unique(history.batch)) - 1
        step = max(STEP0 * STEP_SHRINK**cooled, STEP_MIN)
        here = history.points[current]
        return reflect(here + step * rng.standard_normal((n, len(here))))

    def _replay(self, history: LevelHistory, level: int) -> int:
        """Return the place in the history of the case where the chain stands."""
        batches = np.unique(history.batch)
        first = np.flatnonzero(history.batch == batches[0])
        current = int(first[np.argmin(history.score[first])])
        for cooled, batch in enumerate(batches[1:].tolist()):
            temperature = TEMPERATURE0 * COOLING**cooled
            moves = np.flatnonzero(history.batch == batch)
            luck = self.batch_rng(level, batch).random(len(moves))
            for move, chance in zip(moves.tolist(), luck.tolist(), strict=True):
                rise = float(history.score[move] - history.score[current])
                # Metropolis et al. (1953): downhill always, uphill sometimes.
                if rise <= 0.0 or chance < math.exp(-rise / temperature):
                    current = move
        return current
