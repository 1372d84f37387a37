"""Uniform sampling: the baseline, and the ground truth."""

from __future__ import annotations

from merge_sumo.samplers.base import Sampler
from merge_sumo.scenario.case import Case


class UniformSampler(Sampler):
    """Draws every case uniformly from the pool, an equal number at each level."""

    about = "draws every case uniformly from the pool"
    colour = "#8a8a8a"
    learns = False
    overlaps = True

    def ask(self, n: int) -> list[Case]:
        """Return the next `n` cases, level by level.

        Args:
            n: number of cases.
        """
        cases: list[Case] = []
        for level, share in self.shares(n).items():
            points = self.rng(level).random((share, len(self.pool.scenario.dimensions(level))))
            cases += self.pool.cases(points, level)
        return cases
