"""What is covered already: the balls of the FMC on a grid, for samplers that must be quick."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.values.case import FloatArray
from merge_sumo.values.fmc import RADIUS

CELL: Final = {2: 0.01, 3: 0.0125}
"""Spacing of the grid, per dimension, on which coverage is counted."""


class Ground:
    """The unit cube with a margin of one radius, as cells with the chance not to be covered."""

    def __init__(self, dims: int) -> None:
        """Prepare an uncovered ground of `dims` dimensions."""
        self._cell = CELL[dims]
        reach = int(RADIUS / self._cell) + 1
        side = round((1.0 + 2.0 * RADIUS) / self._cell) + 5
        self._strides = side ** np.arange(dims)[::-1]
        axes = np.meshgrid(*[np.arange(-reach, reach + 1)] * dims, indexing="ij")
        offsets = np.stack(axes, axis=-1).reshape(-1, dims)
        inside = np.square(offsets * self._cell).sum(axis=1) <= RADIUS**2
        self._ball = offsets[inside] @ self._strides
        self._open = np.ones(side**dims, dtype=np.float32)

    def balls(self, points: FloatArray) -> NDArray[np.int64]:
        """Return the cells of the ball around each point, (n, cells)."""
        corner = np.rint((points + RADIUS) / self._cell).astype(np.int64) + 2
        return np.asarray((corner @ self._strides)[:, None] + self._ball, dtype=np.int64)

    def new(self, balls: NDArray[np.int64]) -> FloatArray:
        """Return the expected share of each ball that is not covered, (n,)."""
        return np.asarray(self._open[balls].mean(axis=1), dtype=np.float64)

    def cover(self, balls: NDArray[np.int64], probability: float) -> None:
        """Cover balls with a probability."""
        self._open[balls] *= np.float32(1.0 - probability)

    def covered_balls(self) -> float:
        """Return the expected covered volume in balls."""
        return float((1.0 - self._open).sum()) / len(self._ball)
