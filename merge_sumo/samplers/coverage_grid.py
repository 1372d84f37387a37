"""Discrete coverage of the unit cube by the balls of the FMC, for samplers that must be fast.

A ball is a set of nodes. In two and three dimensions the nodes form a regular grid. In more
dimensions a grid finer than a ball has too many nodes; the nodes are then points of a Halton
sequence, and a ball is a fixed number of nodes nearest to its centre.
"""

from __future__ import annotations

import math
from copy import copy
from functools import lru_cache
from typing import Self

import numpy as np
from scipy.spatial import cKDTree

from merge_sumo.metrics.fmc import RADIUS, IntArray, ball_volume, radius_for
from merge_sumo.scenario.case import FloatArray

# Nodes in a ball without a grid.
NODES_PER_BALL = 64


class CoverageGrid:
    """The unit cube with a margin, as nodes with the probability of each not to be covered.

    Attributes:
        overlap: distance from which on two balls share no node.

    Example:
        grid = CoverageGrid(dims=2)
        grid.cover(grid.balls(failures), 1.0)
        gain = grid.new(grid.balls(candidates))
    """

    def __init__(self, dims: int, *, coarse: bool = False) -> None:
        """Prepare an uncovered grid.

        Args:
            dims: number of dimensions, 2 to 6.
            coarse: whether nodes are .01 apart in two dimensions instead of .0025, and a ball in
                more than three dimensions has the volume of a ball in three.
        """
        # A fine grid resolves slivers, the gain of a case late in a search. It is cheap in two
        # dimensions.
        cell = {2: 0.01 if coarse else 0.0025, 3: 0.0125}.get(dims)
        radius = radius_for(dims)
        if coarse and dims > 3:
            radius = (RADIUS**3 * ball_volume(3) / ball_volume(dims)) ** (1.0 / dims)
        self._nodes = _nodes(dims, cell, radius)
        self.overlap = self._nodes.overlap
        self._open = np.ones(self._nodes.count, dtype=np.float32)

    def copy(self) -> Self:
        """Return an independent grid with the same coverage."""
        other = copy(self)
        other._open = self._open.copy()
        return other

    def balls(self, points: FloatArray) -> IntArray:
        """Return the balls around points.

        Args:
            points: centres, (n, d).

        Returns:
            Indices of their nodes, (n, nodes of a ball).
        """
        return self._nodes.balls(points)

    def new(self, balls: IntArray) -> FloatArray:
        """Return the expected uncovered shares of balls.

        Args:
            balls: their nodes, (n, nodes of a ball).

        Returns:
            Shares from 0 to 1, (n,).
        """
        return np.asarray(self._open.take(balls).mean(axis=1), dtype=np.float64)

    def cover(self, balls: IntArray, probability: float) -> None:
        """Cover balls with a probability.

        Args:
            balls: their nodes, of any shape. A node of several balls is covered once.
            probability: probability that the balls are covered.
        """
        self._open[balls] *= np.float32(1.0 - probability)


class _Grid:
    """The nodes of a regular grid."""

    def __init__(self, dims: int, cell: float) -> None:
        self._cell = cell
        reach = int(RADIUS / self._cell) + 1
        side = round((1.0 + 2.0 * RADIUS) / self._cell) + 5
        self._strides = side ** np.arange(dims)[::-1]
        axes = np.meshgrid(*[np.arange(-reach, reach + 1)] * dims, indexing="ij")
        offsets = np.stack(axes, axis=-1).reshape(-1, dims)
        inside = np.square(offsets * self._cell).sum(axis=1) <= RADIUS**2
        self._ball = offsets[inside] @ self._strides
        self.count = side**dims
        self.overlap = 2.0 * RADIUS + math.sqrt(dims) * self._cell

    def balls(self, points: FloatArray) -> IntArray:
        corner = np.rint((points + RADIUS) / self._cell).astype(np.int64) + 2
        return np.asarray((corner @ self._strides)[:, None] + self._ball, dtype=np.int64)


class _Scattered:
    """The points of a sequence of low discrepancy."""

    def __init__(self, dims: int, radius: float) -> None:
        from scipy.stats.qmc import Halton

        self.overlap = math.inf
        # Margin of nodes around the unit cube.
        margin = 1.1 * radius
        density = NODES_PER_BALL / (ball_volume(dims) * radius**dims)
        self.count = round(density * (1.0 + 2.0 * margin) ** dims)
        sequence = Halton(dims, seed=np.random.default_rng(dims)).random(self.count)
        self._tree = cKDTree(sequence * (1.0 + 2.0 * margin) - margin)

    def balls(self, points: FloatArray) -> IntArray:
        return np.asarray(self._tree.query(points, k=NODES_PER_BALL)[1], dtype=np.int64)


@lru_cache
def _nodes(dims: int, cell: float | None, radius: float) -> _Grid | _Scattered:
    return _Scattered(dims, radius) if cell is None else _Grid(dims, cell)
