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


class GamePicture:
    """Draws states of a merging game on the road of its scenario.

    Example:
        picture = GamePicture(US23)
        pixels = picture.frame(np.array([-250.0, 30.0, -182.0, 18.0]))
    """

    def __init__(self, scenario: Scenario) -> None:
        """Load the road of a scenario.

        Args:
            scenario: the scenario of the game.
        """
        # Imported here: pygame greets in the terminal.
        self._pygame: Any = importlib.import_module("pygame")
        self._road = road_data(road_for(scenario))
        self._lengths_m = scenario.lengths_m

    def frame(self, state: FloatArray) -> NDArray[np.uint8]:
        """Draw one state.

        Args:
            state: x_POV, v_POV, x_VUT and v_VUT, (4,), in m and m/s.

        Returns:
            Red, green and blue of each pixel, (240, 960, 3).
        """
        x_pov_m, _, x_vut_m, _ = state
        pov_length_m, vut_length_m = self._lengths_m
        pov_ends_m = self._ends_of_car("main", x_pov_m - pov_length_m, x_pov_m)
        vut_ends_m = self._ends_of_car("ramp", x_vut_m - vut_length_m, x_vut_m)
        # Both cars are shown; y points up, and pixels count from the upper left corner.
        _, pov_front_m = pov_ends_m
        _, vut_front_m = vut_ends_m
        shown_m = np.abs(pov_front_m - vut_front_m) + MARGINS_M
        centre_m = (pov_front_m + vut_front_m) / 2.0
        px_per_m = (SIZE_PX / shown_m).min()
        lines = [(ROAD, np.array(lane), LANE_M) for lane in self._road["lanes"]]
        lines += (COLOURS["pov"], pov_ends_m, CAR_M), (COLOURS["vut"], vut_ends_m, CAR_M)
        surface = self._pygame.Surface(SIZE_PX)
        surface.fill("#ffffff")
        for colour, points_m, width_m in lines:
            points_px = SIZE_PX / 2.0 + (points_m - centre_m) * px_per_m * [1.0, -1.0]
            width_px = math.ceil(width_m * px_per_m)
            self._pygame.draw.lines(surface, colour, False, points_px, width_px)
        # pygame's arrays have the columns first: (width, height, 3).
        columns = self._pygame.surfarray.array3d(surface)
        return np.ascontiguousarray(columns.transpose(1, 0, 2))

    def _ends_of_car(self, path: str, rear_m: float, front_m: float) -> FloatArray:
        """Return the points of the rear and the front of a car on a path of the road, (2, 2)."""
        along_m, x_m, y_m = np.array(self._road[path]).T
        ends_m = rear_m, front_m
        x_ends_m = np.interp(ends_m, along_m, x_m)
        y_ends_m = np.interp(ends_m, along_m, y_m)
        return np.column_stack([x_ends_m, y_ends_m])
