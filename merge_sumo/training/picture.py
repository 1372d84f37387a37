"""Pictures of a merging game, seen from above and drawn to scale by pygame."""

from __future__ import annotations

import importlib
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merge_sumo.errors import UserError
from merge_sumo.road.drawing import road_data
from merge_sumo.road.loader import road_for
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import COLOURS, Scenario

ROAD = "#c9c7c1"
INK = "#1c2228"
SIZE_PX = np.array([960, 240])
"""Width and height of a picture."""
LANE_M = 3.05
"""Drawn width of a lane of 3.2 m: the rest is the line between two lanes."""
CAR_M = 2.0
"""Width of a car."""
MARGINS_M = (50.0, 22.5)
"""Least width and height of the shown road, without the distance between the cars."""
LABEL_PX = 26.0
"""Distance from the centre of a car to the centre of its label."""
MERGE_LINE_M = np.array([[0.0, -2.4], [0.0, 5.4]])
"""Ends of the line across the road at M, (2, 2)."""
MERGE_LINE_WIDTH_M = 0.25
FONT_PX = 22
"""Size of the font of labels."""


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

        Raises:
            UserError: if pygame is not installed.
        """
        # Imported here: pygame comes with the extra "train" only.
        try:
            self._pygame: Any = importlib.import_module("pygame")
        except ImportError as error:
            raise UserError("pictures need pygame: pip install 'merge-sumo[train]'") from error
        self._pygame.font.init()
        self._road = road_data(road_for(scenario))
        self._lengths_m = scenario.lengths_m

    def frame(self, state: FloatArray) -> NDArray[np.uint8]:
        """Draw one state.

        Args:
            state: x_POV, v_POV, x_VUT and v_VUT, (4,), in m and m/s.

        Returns:
            Red, green and blue of each pixel, (240, 960, 3).
        """
        x_pov_m, v_pov_mps, x_vut_m, v_vut_mps = state
        pov_length_m, vut_length_m = self._lengths_m
        pov_ends_m = self._ends_of_car("main", x_pov_m - pov_length_m, x_pov_m)
        vut_ends_m = self._ends_of_car("ramp", x_vut_m - vut_length_m, x_vut_m)
        _, pov_front_m = pov_ends_m
        _, vut_front_m = vut_ends_m
        canvas = _Canvas(self._pygame, pov_front_m, vut_front_m)
        for path in ("main", "ramp"):
            points_m = np.array(self._road[path])[:, 1:]  # without the lane coordinate
            canvas.draw_line(ROAD, points_m, LANE_M)
        canvas.draw_line(INK, MERGE_LINE_M, MERGE_LINE_WIDTH_M)
        canvas.draw_car("pov", pov_ends_m, v_pov_mps, -LABEL_PX)
        canvas.draw_car("vut", vut_ends_m, v_vut_mps, LABEL_PX)
        # pygame's arrays have the columns first: (width, height, 3).
        columns = self._pygame.surfarray.array3d(canvas.surface)
        return np.ascontiguousarray(columns.transpose(1, 0, 2))

    def _ends_of_car(self, path: str, rear_m: float, front_m: float) -> FloatArray:
        """Return the points of the rear and the front of a car on a path of the road, (2, 2)."""
        along_m, x_m, y_m = np.array(self._road[path]).T
        ends_m = rear_m, front_m
        x_ends_m = np.interp(ends_m, along_m, x_m)
        y_ends_m = np.interp(ends_m, along_m, y_m)
        return np.column_stack([x_ends_m, y_ends_m])


class _Canvas:
    """A surface of pygame that shows both cars, with coordinates in m: x to the right, y up."""

    def __init__(self, pygame: Any, pov_front_m: FloatArray, vut_front_m: FloatArray) -> None:
        self._pygame = pygame
        self.surface = pygame.Surface(SIZE_PX)
        self.surface.fill("#ffffff")
        shown_m = np.abs(pov_front_m - vut_front_m) + MARGINS_M
        self._px_per_m = (SIZE_PX / shown_m).min()
        self._centre_m = (pov_front_m + vut_front_m) / 2.0

    def draw_line(self, colour: str, points_m: FloatArray, width_m: float) -> None:
        """Draw a line.

        Args:
            colour: its colour.
            points_m: the points that it joins, (n, 2).
            width_m: its width.
        """
        width_px = math.ceil(width_m * self._px_per_m)
        self._pygame.draw.lines(self.surface, colour, False, self._pixels(points_m), width_px)

    def draw_car(self, name: str, ends_m: FloatArray, v_mps: float, down_px: float) -> None:
        """Draw a car, and its speed as a label.

        Args:
            name: name of the vehicle, a key of `COLOURS`.
            ends_m: its rear and its front, (2, 2).
            v_mps: its speed.
            down_px: distance of the label below the car; negative for a label above it.
        """
        self.draw_line(COLOURS[name], ends_m, CAR_M)
        font = self._pygame.font.Font(None, FONT_PX)
        text = font.render(f"{name.upper()} {v_mps:.1f} m/s", True, INK)
        x_px, y_px = self._pixels(ends_m).mean(axis=0)
        label = text.get_rect(center=(x_px, y_px + down_px))
        # A label that would leave the picture is moved to its edge.
        self.surface.blit(text, label.clamp(self.surface.get_rect()))

    def _pixels(self, points_m: FloatArray) -> FloatArray:
        """Return points in pixels, which count from the upper left corner."""
        from_centre_px = (points_m - self._centre_m) * self._px_per_m
        return np.asarray(SIZE_PX / 2.0 + from_centre_px * [1.0, -1.0])
