"""A merging game from above, to scale, drawn by pygame."""

from __future__ import annotations

import importlib
import math
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merge_sumo.errors import UserError
from merge_sumo.road.drawing import road_data
from merge_sumo.road.merge import road_for
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import COLOURS, Scenario

ROAD = "#c9c7c1"
INK = "#1c2228"
SIZE_PX = (960, 240)
LANE_M = 3.05
"""A lane is 3.2 m wide: what is left free between two lanes is the line between them."""


class GamePicture:
    """Draws states of a game on the road of its scenario; raises `UserError` without pygame."""

    def __init__(self, scenario: Scenario) -> None:
        """Take the lines of the road of a scenario."""
        try:
            self._pygame: Any = importlib.import_module("pygame")
        except ImportError as error:
            raise UserError("pictures need pygame: pip install 'merge-sumo[train]'") from error
        data = road_data(road_for(scenario))
        self._lanes = [np.array(lane) for lane in data["lanes"]]
        self._paths = {"POV": np.array(data["main"]), "VUT": np.array(data["ramp"])}
        self._lengths_m = dict(zip(("POV", "VUT"), scenario.lengths_m, strict=True))
        self._pygame.font.init()
        self._font = self._pygame.font.Font(None, 22)

    def frame(self, state: FloatArray) -> NDArray[np.uint8]:
        """Return the picture of a state, [x_POV, v_POV, x_VUT, v_VUT], as (height, width, 3)."""
        pixels = self._pygame.surfarray.array3d(self._drawn(state))
        return np.ascontiguousarray(pixels.transpose(1, 0, 2))

    def _drawn(self, state: FloatArray) -> Any:
        """Return the picture of a state as a surface, in which both cars are."""
        x_pov_m, v_pov_mps, x_vut_m, v_vut_mps = state.tolist()
        cars = (("POV", x_pov_m, v_pov_mps, -1), ("VUT", x_vut_m, v_vut_mps, 1))
        fronts = np.array([self._place(who, x_m) for who, x_m, _, _ in cars])
        low, high = fronts.min(axis=0), fronts.max(axis=0)
        size = np.array(SIZE_PX)
        across_m, up_m = high - low
        width_m = max(across_m + 50.0, (1.7 * up_m + 22.0) * size[0] / size[1], 90.0)
        px_per_m = size[0] / width_m

        def pixels(points: FloatArray) -> FloatArray:
            return np.asarray(size / 2.0 + (points - (low + high) / 2.0) * [px_per_m, -px_per_m])

        canvas = self._pygame.Surface(SIZE_PX)
        canvas.fill("#ffffff")
        for lane in self._lanes:
            self._line(canvas, ROAD, pixels(lane), LANE_M * px_per_m)
        merge_line = np.array([[0.0, -2.4], [0.0, 5.4]])
        self._line(canvas, INK, pixels(merge_line), 0.25 * px_per_m)
        for who, x_m, v_mps, side in cars:
            rear, front = self._place(who, x_m - self._lengths_m[who]), self._place(who, x_m)
            ends = pixels(np.array([rear, front]))
            self._line(canvas, COLOURS[who.lower()], ends, 2.0 * px_per_m)
            text = self._font.render(f"{who} {v_mps:.1f} m/s", True, INK)
            x, y = ends.mean(axis=0)
            place = text.get_rect(center=(x, y + side * (2.4 * px_per_m + 11.0)))
            canvas.blit(text, place.clamp(canvas.get_rect()))
        return canvas

    def _line(self, canvas: Any, colour: str, points: FloatArray, width_px: float) -> None:
        """Draw a line of a width: rectangles for its pieces, and discs where they meet."""
        for begin, end in pairwise(points):
            dx, dy = end - begin
            aside = np.array([-dy, dx]) * (width_px / 2.0 / (math.hypot(dx, dy) or 1.0))
            corners = [begin + aside, end + aside, end - aside, begin - aside]
            self._pygame.draw.polygon(canvas, colour, corners)
        for joint in points[1:-1]:
            self._pygame.draw.circle(canvas, colour, joint, width_px / 2.0)

    def _place(self, who: str, x_m: float) -> FloatArray:
        """Return where a lane coordinate of a path is in the plane, (2,)."""
        along_m, x, y = self._paths[who].T
        return np.array([np.interp(x_m, along_m, x), np.interp(x_m, along_m, y)])
