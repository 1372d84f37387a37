"""The maps of the report: what is known of the pool, in two coordinates at a time.

A level with two coordinates has one map; with a third, the reader moves through it. Of more, a map
shows a pair and stands for all values of the others: chance and truth are means over them. Which
pair comes first is what the surrogate says: the two that explain the most of where cases fail.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.analysis.surface import Grid, Surface, nodes
from merge_sumo.studies.truth import Truth
from merge_sumo.values.case import FloatArray, to_unit
from merge_sumo.values.fmc import radius_for
from merge_sumo.values.scenario import Scenario
from merge_sumo.values.score import Outcome

COUNT_GRID: Final = (32, 20)
GRID: Final = {2: (49, 49, 1), 3: (33, 33, 9)}
"""Nodes of a map in its two coordinates and in the one that it moves through."""
NEIGHBOURS: Final = 3
"""Cases of the truth that decide whether a node of the map fails."""
PAIR_NODES: Final = 41
BLUR_NODES: Final = 1.5
"""Nodes of the map of a pair, in each direction, and over how many of them its means are taken."""
PAIR_CELLS: Final = 12
"""Cells in each direction between which what a pair explains is counted."""

Axes = tuple[int, int]
"""Places of two coordinates in the pool's order."""


@dataclass(frozen=True, slots=True)
class Pair:
    """Two coordinates of a level, and the share of where cases fail that they explain.

    The share is that of the variance of the chance to fail, over the pool, which is left when all
    other coordinates are averaged out (the closed Sobol index of the two); None where no surrogate
    tells.
    """

    axes: Axes
    share: float | None


def pairs_of(dims: int, surface: Surface | None) -> list[Pair]:
    """Return the pairs of a level that may be shown, the first one first."""
    if dims <= 3:
        return [Pair((0, 1), None)]
    every = list(combinations(range(dims), 2))
    if surface is None:
        return [Pair(axes, None) for axes in every]
    points, chance = surface.pool()
    found = [Pair(axes, explained(points[:, list(axes)], chance)) for axes in every]
    return sorted(found, key=lambda pair: -(pair.share or 0.0))


def explained(points: FloatArray, values: FloatArray) -> float:
    """Return the share of the variance of values, (n,), that uniform points, (n, 2), explain.

    It is the variance between the cells of a grid, without the part of it that is there by chance.
    """
    cell = np.minimum((points * PAIR_CELLS).astype(np.int64), PAIR_CELLS - 1) @ (PAIR_CELLS, 1)
    number = np.bincount(cell, minlength=PAIR_CELLS**2)
    total = np.bincount(cell, values, minlength=PAIR_CELLS**2)
    mean = np.divide(total, number, out=np.zeros_like(total), where=number > 0)
    whole = float(np.square(values - values.mean()).sum())
    within = float(np.square(values - mean[cell]).sum())
    cells = int((number > 0).sum())
    if whole <= 0.0 or len(values) <= cells:
        return 0.0
    by_chance = within * (cells - 1) / (len(values) - cells)
    return min(max((whole - within - by_chance) / whole, 0.0), 1.0)


def maps_of(
    scenario: Scenario,
    level: int,
    others: Sequence[Outcome],
    surface: Surface | None,
    truth: Truth | None,
) -> dict[str, Any]:
    """Return what the script draws the map of a level from.

    `others` are outcomes that the page counts instead of showing one by one.
    """
    dims = len(scenario.dimensions(level))
    pairs = pairs_of(dims, surface)
    return {
        "pairs": [{"axes": pair.axes, "share": pair.share} for pair in pairs],
        "through": 2 if dims == 3 else None,
        # The ball of more coordinates is as wide as the map: its shadow says nothing.
        "radius": radius_for(dims) if dims <= 3 else None,
        "grids": [
            {
                "chance": None if surface is None else _chance(surface, dims, pair.axes),
                "truth": None if truth is None else _truth(truth, dims, pair.axes),
                "counts": _counts(others, scenario, level, pair.axes) if others else None,
            }
            for pair in pairs
        ],
    }


def _counts(
    others: Sequence[Outcome], scenario: Scenario, level: int, axes: Axes
) -> dict[str, Any]:
    nx, ny = COUNT_GRID
    grid: dict[str, Any] = {"nx": nx, "ny": ny}
    for name, failing in (("safe", False), ("failing", True)):
        cases = (o.case for o in others if o.failed is failing)
        points = to_unit(cases, level, scenario)[:, list(axes)]
        cells, _, _ = np.histogram2d(
            points[:, 1], points[:, 0], bins=(ny, nx), range=((0, 1), (0, 1))
        )
        grid[name] = cells.astype(int).ravel().tolist()
    return grid


def _chance(surface: Surface, dims: int, axes: Axes) -> dict[str, Any]:
    if dims in GRID:
        return _packed(GRID[dims], surface.over(GRID[dims]))
    points, chance = surface.pool()
    return _means(points[:, list(axes)], chance)


def _truth(truth: Truth, dims: int, axes: Axes) -> dict[str, Any]:
    from scipy.spatial import cKDTree

    failed = truth.margin < 0.0
    if dims in GRID:
        _, near = cKDTree(truth.points).query(nodes(GRID[dims]), k=NEIGHBOURS)
        return _packed(GRID[dims], failed[near].mean(axis=1))
    return _means(truth.points[:, list(axes)], failed.astype(np.float64))


def _means(points: FloatArray, values: FloatArray) -> dict[str, Any]:
    """Return the means of values, (n,), around the nodes of a map, as shares of the highest."""
    from scipy.ndimage import gaussian_filter

    node = np.rint(points * (PAIR_NODES - 1)).astype(np.int64) @ (1, PAIR_NODES)
    near, total = (
        gaussian_filter(
            np.bincount(node, weights, minlength=PAIR_NODES**2)
            .astype(np.float64)
            .reshape(PAIR_NODES, PAIR_NODES),
            BLUR_NODES,
            mode="constant",
        ).ravel()
        for weights in (None, values)
    )
    mean = np.divide(total, near, out=np.zeros_like(total), where=near > 0.0)
    most = float(mean.max())
    shares = mean / most if most > 0.0 else mean
    return {"most": round(most, 3), **_packed((PAIR_NODES, PAIR_NODES, 1), shares)}


def _packed(grid: Grid, share: NDArray[Any]) -> dict[str, Any]:
    nx, ny, through = grid
    values = np.rint(255.0 * share).astype(np.uint8)
    data = base64.b64encode(values.tobytes()).decode()
    return {"nx": nx, "ny": ny, "np": through, "data": data}
