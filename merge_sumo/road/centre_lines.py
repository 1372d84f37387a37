"""The lanes of a merge as lines in the plane, for what bodies do on them."""

from __future__ import annotations

from typing import Final

import numpy as np

from merge_sumo.metrics.bodies import CentreLines
from merge_sumo.road.corridor import Corridor, LanePath
from merge_sumo.scenario.case import FloatArray

_found: Final[dict[tuple[object, ...], CentreLines]] = {}


def centre_lines(road: Corridor) -> CentreLines:
    """Return the centre lines of both paths of a road; they are found once in a process."""
    key = road.sha256, road.mainline_edges, road.ramp_edges, road.lane_m
    if key not in _found:
        _found[key] = CentreLines.of(_line(road.mainline), _line(road.ramp))
    return _found[key]


def _line(path: LanePath) -> FloatArray:
    return np.array(
        [
            [piece.start_m + share * piece.length_m, x, y]
            for piece in path.pieces
            for share, (x, y, _) in zip(piece.shares, piece.shape, strict=True)
        ]
    )
