"""Scrambled Sobol points of `scipy.stats.qmc`: space-filling, and blind to outcomes."""

from __future__ import annotations

import numpy as np

from merge_sumo.samplers.base import LevelwiseSampler
from merge_sumo.samplers.history import LevelHistory
from merge_sumo.scenario.case import FloatArray


class SobolSampler(LevelwiseSampler):
    """The next points of a scrambled Sobol sequence of each level.

    Source of the settings: `scipy.stats.qmc.Sobol`. Owen's scrambling by the seed, and the first
    point is kept. The sequence is balanced at powers of 2, and is cut where a batch ends.
    """

    about = "follows a scrambled Sobol sequence (scipy)"
    colour = "#56B4E9"
    learns = False
    overlaps = True

    def propose(
        self, history: LevelHistory, n: int, rng: np.random.Generator, level: int
    ) -> FloatArray:
        """Return the next `n` points of the sequence of a level, (n, d)."""
        from scipy.stats.qmc import Sobol

        # Not by `rng`, which is another one for every batch.
        scrambling = np.random.default_rng([self.seed, level])
        first = self.proposed(level)
        sequence = Sobol(history.dims, rng=scrambling)
        points = sequence.random_base2((first + n - 1).bit_length())
        return np.asarray(points[first : first + n], dtype=np.float64)
