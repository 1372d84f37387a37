"""The outcomes that a sampler learns from, as arrays."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from merge_sumo.values.case import FloatArray


@dataclass(frozen=True, slots=True)
class LevelHistory:
    """The outcomes of one POV level: N cases with a verdict, in the order of their index.

    Attributes:
        points: cases in the unit cube, (N, d).
        score: P, or its stand-in under another criterion than the paper's, (N,).
        failed: score < lambda, (N,).
        dx_m: signed gap at M, (N,), or its stand-in under another criterion: a case fails
            within 6 m; NaN where the VUT never arrived or there is no trajectory.
        batch: batch of the campaign in which the case ran, (N,).
    """

    points: FloatArray
    score: FloatArray
    failed: NDArray[np.bool_]
    dx_m: FloatArray
    batch: NDArray[np.int64]

    @property
    def dims(self) -> int:
        """Return d, the number of coordinates."""
        return int(self.points.shape[1])

    def then(self, later: LevelHistory) -> LevelHistory:
        """Return the outcomes with later ones after them."""
        if not len(later.points):
            return self
        pairs = ((getattr(self, f.name), getattr(later, f.name)) for f in fields(self))
        return LevelHistory(*(np.concatenate(pair) for pair in pairs))

    def take(self, places: slice | NDArray[np.int64]) -> LevelHistory:
        """Return some of the outcomes."""
        return LevelHistory(
            points=self.points[places],
            score=self.score[places],
            failed=self.failed[places],
            dx_m=self.dx_m[places],
            batch=self.batch[places],
        )
