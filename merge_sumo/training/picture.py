"""A merging game from above, to scale, drawn by pygame."""

from __future__ import annotations

import importlib
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
SIZE_PX = (960, 240)
LANE_M = 3.05
"""Drawn width of a lane of 3.2 m: the rest is the line between two lanes."""
CAR_M = 2.0


class GamePicture:
    """Draws states of a game on the road of its scenario.

    Example:
        picture = GamePicture(US23)
        pixels = picture.frame(np.array([-250.0, 30.0, -182.0, 18.0]))
    """

    def __init__(self, scenario: Scenario) -> None:
        """Take the road of a scenario.

        Raises:
            UserError: if pygame is not installed.
        """
        try:
            self._pygame: Any = importlib.import_module("pygame")
        except ImportError as error:
            raise UserError("pictures need pygame: pip install 'merge-sumo[train]'") from error
        self._road = road_data(road_for(scenario))
        self._lengths_m = scenario.lengths_m
        self._pygame.font.init()
        self._font = self._pygame.font.Font(None, 22)

    def frame(self, state: FloatArray) -> NDArray[np.uint8]:
        """Return the picture of a state, [x_POV, v_POV, x_VUT, v_VUT], as (height, width, 3)."""
        canvas = self._pygame.Surface(SIZE_PX)
        canvas.fill("#ffffff")
        cars = {}
        for row, (who, path) in enumerate((("pov", "main"), ("vut", "ramp"))):
            along_m, x, y = np.array(self._road[path]).T
            front_m = state[2 * row]
            ends_m = [front_m - self._lengths_m[row], front_m]
            cars[who] = np.column_stack(
                [np.interp(ends_m, along_m, x), np.interp(ends_m, along_m, y)]
            )
        fronts = np.array([car[1] for car in cars.values()])
        across_m, up_m = np.ptp(fronts, axis=0)
        width, height = SIZE_PX
        width_m = max(across_m + 50.0, (1.7 * up_m + 22.0) * width / height, 90.0)
        scale = width / width_m
        centre = (fronts.min(axis=0) + fronts.max(axis=0)) / 2.0

        def draw(colour: str, points: FloatArray, line_m: float) -> FloatArray:
            """Draw a line on the road; return its points in pixels.

            Args:
                colour: #RRGGBB.
                points: in m, (n, 2).
                line_m: width of the line.
            """
            pixels: FloatArray = np.array(SIZE_PX) / 2.0 + (points - centre) * [scale, -scale]
            self._pygame.draw.lines(canvas, colour, False, pixels, max(round(line_m * scale), 1))
            return pixels

        for lane in self._road["lanes"]:
            draw(ROAD, np.array(lane), LANE_M)
        draw(INK, np.array([[0.0, -2.4], [0.0, 5.4]]), 0.25)
        for row, (who, car) in enumerate(cars.items()):
            x, y = draw(COLOURS[who], car, CAR_M).mean(axis=0)
            text = self._font.render(f"{who.upper()} {state[2 * row + 1]:.1f} m/s", True, INK)
            side = 2 * row - 1
            place = text.get_rect(center=(x, y + side * (2.4 * scale + 11.0)))
            canvas.blit(text, place.clamp(canvas.get_rect()))
        return np.ascontiguousarray(self._pygame.surfarray.array3d(canvas).transpose(1, 0, 2))
