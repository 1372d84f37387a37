"""Data of the player of motions (`templates/player.js`): the road, and the speeds of all cars."""

from __future__ import annotations

import base64
import math
from collections.abc import Hashable, Mapping
from typing import Any, Final, TypeVar

import numpy as np

from merge_sumo.road.corridor import Corridor, LanePath
from merge_sumo.values.scenario import DT_S, VEHICLES, MergeScenario, Scenario, lane_of
from merge_sumo.values.score import Outcome
from merge_sumo.values.trajectory import End, Trajectory

Key = TypeVar("Key", bound=Hashable)
SPEED_UNIT_MPS: Final = 0.002
"""Speeds are kept as whole numbers of this in 16 bits: up to 131 m/s, positions within 2 cm."""


def player_data(scenario: Scenario, road: Corridor, speeds: str) -> dict[str, Any]:
    """Return what all motions of a page share, with the speeds of all of them (`packed`)."""
    lane_m = lane_of(scenario)
    return {
        "dt": DT_S,
        "crash_m": scenario.dx_crash_m if isinstance(scenario, MergeScenario) else 0.0,
        "vehicles": VEHICLES[: scenario.vehicles],
        "ends": [end.value for end in End],
        "speeds": speeds,
        "speed_unit_mps": SPEED_UNIT_MPS,
        **road_data(road),
        **({} if lane_m is None else {"lane": lane_m, "place": scenario.place}),
    }


def motion_row(outcome: Outcome, trajectory: Trajectory | None, offset: int) -> dict[str, Any]:
    """Return what the player needs of a case: it has no rows where its motion is not known."""
    return {
        "starts": [round(x_m, 3) for x_m, _ in outcome.case.starts()],
        "nearest": VEHICLES.index(outcome.measures.nearest),
        "end": list(End).index(outcome.measures.end),
        "offset": offset,
        "rows": 0 if trajectory is None else len(trajectory.motion),
    }


def packed(motions: Mapping[Key, Trajectory]) -> tuple[str, dict[Key, int]]:
    """Return the speeds of all cars at every step in base64, and the first row of each motion."""
    offsets: dict[Key, int] = {}
    first = 0
    parts = [np.empty(0, dtype="<u2")]
    for key, trajectory in motions.items():
        speeds = trajectory.motion[:, :, 1]
        packed = np.rint(np.clip(speeds / SPEED_UNIT_MPS, 0, 65535)).astype("<u2")
        parts.append(packed.ravel())
        offsets[key] = first
        first += len(speeds)
    return base64.b64encode(np.concatenate(parts).tobytes()).decode(), offsets


def road_data(road: Corridor) -> dict[str, Any]:
    """Return both paths as points (lane coordinate, x, y), and the lines of all lanes near M.

    M is the origin of the plane, and the road goes on to the right: a net may lie anywhere.
    """
    at = road.lane_point(0.0, on_ramp=False)
    ahead_x, ahead_y = math.sin(math.radians(at.angle_deg)), math.cos(math.radians(at.angle_deg))

    def place(x: float, y: float) -> list[float]:
        dx, dy = x - at.x_m, y - at.y_m
        along, left = dx * ahead_x + dy * ahead_y, dy * ahead_x - dx * ahead_y
        return [round(along, 2), round(left, 2)]

    def points(path: LanePath) -> list[list[float]]:
        return [
            [round(piece.start_m + share * piece.length_m, 2), *place(x, y)]
            for piece in path.pieces
            for share, (x, y, _) in zip(piece.shares, piece.shape, strict=True)
        ]

    shapes = [piece.shape for path in (road.mainline, road.ramp) for piece in path.pieces]
    lanes = [*road.surroundings, *dict.fromkeys(shapes)]
    return {
        "main": points(road.mainline),
        "ramp": points(road.ramp),
        "lanes": [[place(x, y) for x, y, _ in shape] for shape in lanes],
    }
