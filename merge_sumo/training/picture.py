"""Pictures of a merging game, seen from above and drawn to scale by pygame."""

from __future__ import annotations

import importlib
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merge_sumo.road.drawing import road_data
from merge_sumo.road.loader import road_for
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import COLOURS, Scenario

ROAD = "#c9c7c1"
SIZE_PX = np.array([960, 240])
"""Width and height of a picture."""
LANE_M = 3.05
"""Drawn width of a lane of 3.2 m: the rest is the line between two lanes."""
CAR_M = 2.0
"""Width of a car."""
MARGINS_M = (50.0, 22.5)
"""Least width and height of the shown road, without the distance between the cars."""


def game_picture(scenario: Scenario, state: FloatArray) -> NDArray[np.uint8]:
    """Draw a state of a merging game on the road of its scenario.

    Both cars are shown, the POV on the main road and the VUT on the ramp.

    Args:
        scenario: the scenario of the game.
        state: x_POV, v_POV, x_VUT and v_VUT, (4,), in m and m/s.

    Returns:
        Red, green and blue of each pixel, (240, 960, 3).
    """
    # Imported here: pygame greets in the terminal.
    pygame: Any = importlib.import_module("pygame")
    road = road_data(road_for(scenario))
    pov_length_m, vut_length_m = scenario.lengths_m
    x_pov_m, _, x_vut_m, _ = state
    pov_ends_m = _points_at(road["main"], x_pov_m - pov_length_m, x_pov_m)
    vut_ends_m = _points_at(road["ramp"], x_vut_m - vut_length_m, x_vut_m)
    _, pov_front_m = pov_ends_m
    _, vut_front_m = vut_ends_m
    shown_m = np.abs(pov_front_m - vut_front_m) + MARGINS_M
    centre_m = (pov_front_m + vut_front_m) / 2.0
    px_per_m = (SIZE_PX / shown_m).min()
    lines = [
        (ROAD, np.array(road["main"])[:, 1:], LANE_M),  # without the lane coordinate
        (ROAD, np.array(road["ramp"])[:, 1:], LANE_M),
        (COLOURS["pov"], pov_ends_m, CAR_M),
        (COLOURS["vut"], vut_ends_m, CAR_M),
    ]
    surface = pygame.Surface(SIZE_PX)
    surface.fill("#ffffff")
    for colour, points_m, width_m in lines:
        # y points up, and pixels count from the upper left corner.
        points_px = SIZE_PX / 2.0 + (points_m - centre_m) * px_per_m * [1.0, -1.0]
        pygame.draw.lines(surface, colour, False, points_px, math.ceil(width_m * px_per_m))
    # pygame's arrays have the columns first: (width, height, 3).
    return np.ascontiguousarray(pygame.surfarray.array3d(surface).transpose(1, 0, 2))


def _points_at(path: Any, *places_m: float) -> FloatArray:
    """Return the points at places along a path of the road, (n, 2)."""
    along_m, x_m, y_m = np.array(path).T
    return np.column_stack([np.interp(places_m, along_m, x_m), np.interp(places_m, along_m, y_m)])
