"""Uniform sampling: the baseline, and the ground truth."""

from __future__ import annotations

import numpy as np

from merge_sumo.samplers.base import LevelHistory, LevelwiseSampler
from merge_sumo.values.case import FloatArray


class UniformSampler(LevelwiseSampler):
    """Draws every case uniformly from the pool, an equal number at each level."""

    def propose(
        self, history: LevelHistory, n: int, rng: np.random.Generator, level: int
    ) -> FloatArray:
        """Return `n` uniform points."""
        return rng.random((n, history.dims))
