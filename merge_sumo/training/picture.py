"""A merging game from above, as the player of the report draws a case: with pygame, to scale."""

from __future__ import annotations

import importlib
import math
import os
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.errors import UserError
from merge_sumo.road.drawing import road_data
from merge_sumo.road.merge import road_for
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.colours import COLOURS
from merge_sumo.scenario.scenario import Scenario

BACKGROUND: Final = "#ffffff"
ROAD: Final = "#c9c7c1"
INK: Final = "#1c2228"
SIZE_PX: Final = (960, 240)
FINER: Final = 2
"""The picture is drawn so many times larger, and made smaller, so that edges are smooth."""
LANE_M: Final = 3.05
"""A lane is 3.2 m wide: what is left free between two lanes is the line between them."""
CAR_WIDTH_M: Final = 2.0
LEAST_M: Final = 90.0
"""The view follows both cars, and is never narrower."""
MERGE_LINE_M: Final = (-2.4, 5.4)
DASH_M: Final = 1.0
LETTERS_PX: Final = 22
UNSEEN: Final = ("dummy", "offscreen")
"""Drivers of SDL that draw windows nowhere."""


class GamePicture:
    """Draws states of a game on the road of its scenario; raises `UserError` without pygame."""

    def __init__(self, scenario: Scenario) -> None:
        """Take the lines of the road; a window is opened when one is asked for."""
        try:
            self._pygame: Any = importlib.import_module("pygame")
        except ImportError as error:
            raise UserError("pictures need pygame: pip install 'merge-sumo[train]'") from error
        data = road_data(road_for(scenario))
        self._lanes = [np.array(lane) for lane in data["lanes"]]
        self._paths = {"POV": np.array(data["main"]), "VUT": np.array(data["ramp"])}
        self._lengths_m = dict(zip(("POV", "VUT"), scenario.lengths_m, strict=True))
        self._pygame.font.init()
        self._font = self._pygame.font.Font(None, FINER * LETTERS_PX)
        self._window: Any = None
        self._clock = self._pygame.time.Clock()

    def frame(self, state: FloatArray) -> NDArray[np.uint8]:
        """Return the picture of a state, [x_POV, v_POV, x_VUT, v_VUT], as (height, width, 3)."""
        pixels = self._pygame.surfarray.array3d(self._drawn(state))
        return np.ascontiguousarray(pixels.transpose(1, 0, 2))

    def show(self, state: FloatArray, fps: float) -> None:
        """Show the picture in a window, at most so often a second; `UserError` without a screen."""
        pygame = self._pygame
        if self._window is None:
            self._window = self._opened()
        self._window.blit(self._drawn(state), (0, 0))
        pygame.event.pump()
        pygame.display.flip()
        self._clock.tick(fps)

    def _opened(self) -> Any:
        """Return a new window; `UserError` where it could not be seen."""
        pygame = self._pygame
        try:
            pygame.display.init()
            # Without a screen SDL goes on in silence, unless it is told to.
            if pygame.display.get_driver() in UNSEEN and "SDL_VIDEODRIVER" not in os.environ:
                raise pygame.error("no display")
            pygame.display.set_caption("merge-sumo")
            return pygame.display.set_mode(SIZE_PX)
        except pygame.error as error:
            pygame.display.quit()
            raise UserError(
                f"there is no screen for a window ({error}): take render_mode='rgb_array'"
            ) from error

    def close(self) -> None:
        """Close the window, if one is open."""
        if self._window is not None:
            self._pygame.display.quit()
            self._window = None

    def _drawn(self, state: FloatArray) -> Any:
        """Return the picture of a state as a surface."""
        x_pov_m, v_pov_mps, x_vut_m, v_vut_mps = state.tolist()
        moving = {"POV": (x_pov_m, v_pov_mps), "VUT": (x_vut_m, v_vut_mps)}
        fronts = np.array([self._place(who, x_m) for who, (x_m, _) in moving.items()])
        (left, bottom), (right, top) = fronts.min(axis=0), fronts.max(axis=0)
        wide, high = (FINER * px for px in SIZE_PX)
        width_m = max(right - left + 50.0, (1.7 * (top - bottom) + 22.0) * wide / high, LEAST_M)
        px_per_m, centre = wide / width_m, np.array([left + right, bottom + top]) / 2.0

        def pixels(points: FloatArray) -> FloatArray:
            middle = np.array([wide, high]) / 2.0
            placed: FloatArray = middle + (points - centre) * [px_per_m, -px_per_m]
            return placed

        canvas = self._pygame.Surface((wide, high))
        canvas.fill(BACKGROUND)
        for lane in self._lanes:
            self._line(canvas, ROAD, pixels(lane), LANE_M * px_per_m)
        for y_m in np.arange(*MERGE_LINE_M, 2.0 * DASH_M):
            dash = pixels(np.array([[0.0, y_m], [0.0, y_m + DASH_M]]))
            self._line(canvas, INK, dash, 0.25 * px_per_m)
        is_above = fronts[0, 1] > fronts[1, 1]
        for (who, (x_m, v_mps)), front in zip(moving.items(), fronts, strict=True):
            rear = self._place(who, x_m - self._lengths_m[who])
            ends = pixels(np.array([rear, front]))
            self._line(canvas, COLOURS[who.lower()], ends, CAR_WIDTH_M * px_per_m)
            text = self._font.render(f"{who} {v_mps:.1f} m/s", True, INK)
            x, y = pixels(np.array([(rear + front) / 2.0]))[0]
            aside = 2.4 * px_per_m + text.get_height() / 2.0
            above = is_above == (who == "POV")
            place = text.get_rect(center=(x, y - aside if above else y + aside))
            canvas.blit(text, place.clamp(canvas.get_rect()))
        return self._pygame.transform.smoothscale(canvas, SIZE_PX)

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
