"""The acceleration lane: merge requests, when they are granted, and the end of the lane.

The VUT is on the mainline from the step of its merge on; M is the place where POVs expect it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.base import MERGE, NO_REQUEST
from merge_sumo.drivers.car_following import follow_mps2
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import DT_S, VUT, Scenario

END_MARGIN_M = 0.5
"""Least distance from the end of the lane of a VUT that has to stop before it."""


def stopping_mps(room_m: FloatArray, brake_mps2: float) -> FloatArray:
    """Return the highest speeds from which vehicles stop within distances.

    By eq. (4) braking at b from a speed v takes v^2 / (2 b) + v dt / 2.

    Args:
        room_m: distances, (K,); those below 0 count as 0.
        brake_mps2: deceleration b, positive.

    Returns:
        The speeds, (K,), in m/s.
    """
    half = 0.5 * brake_mps2 * DT_S
    return np.sqrt(half**2 + 2.0 * brake_mps2 * np.maximum(room_m, 0.0)) - half


def speed_to_stop_mps(next_m: FloatArray, scenario: Scenario) -> FloatArray:
    """Return the highest speeds from which VUTs stop before the end of their lane, (K,).

    Args:
        next_m: positions of the VUTs after the next step, (K,).
        scenario: gives the acceleration lane and the hardest braking.
    """
    _, end_m = scenario.lane_m or (0.0, 0.0)
    return stopping_mps(end_m - END_MARGIN_M - next_m, -scenario.a_min_mps2)


class Merging:
    """The merges of the VUTs of K corridors on a road with an acceleration lane.

    In each step: `take` the merge requests, then `step`.

    Example:
        merging = Merging(corridors=1, scenario=named_scenario("us23-lane"))
        merging.take(vut.merge_requests(), a_mps2, x_m, v_mps)
        on_mainline = merging.step(x_m, v_mps)

    Attributes:
        begin_m: position at which the lane begins, where the first requests are granted.
        end_m: position of the end of the lane, where a merge is forced.
        merged: whether the VUT of a corridor is on the mainline, (K,).
    """

    def __init__(self, corridors: int, scenario: Scenario) -> None:
        """Begin with all VUTs on the ramp.

        Args:
            corridors: number of corridors, K.
            scenario: a scenario with a lane; `lane_end` says what happens at its end.
        """
        self.begin_m, self.end_m = scenario.lane_m or (0.0, 0.0)
        self._stops = scenario.lane_end == "stop"
        self._scenario = scenario
        self.merged = np.zeros(corridors, dtype=np.bool_)
        self._states_requests = np.zeros(corridors, dtype=np.bool_)
        """Whether the VUT has ever made a merge request."""
        self._merge_requests = np.zeros(corridors, dtype=np.bool_)

    @property
    def driven_for(self) -> NDArray[np.bool_]:
        """Which VUTs have merged without any merge request, (K,): they are driven by IDM."""
        return self.merged & ~self._states_requests

    def begin(self, corridor: int) -> None:
        """Begin an episode with the VUT on the ramp.

        Args:
            corridor: index of the corridor.
        """
        for flags in (self.merged, self._states_requests, self._merge_requests):
            flags[corridor] = False

    def take(
        self,
        merge_requests: NDArray[np.int8] | None,
        answer: FloatArray,
        x_m: FloatArray,
        v_mps: FloatArray,
    ) -> None:
        """Take the merge requests of the VUTs, and limit their answers in place.

        Args:
            merge_requests: those of the last answers, (K,); None for a VUT that only accelerates.
            answer: accelerations of all vehicles, (A, K).
            x_m: their positions, (A, K).
            v_mps: their speeds, (A, K).
        """
        next_m = x_m[VUT] + v_mps[VUT] * DT_S
        if merge_requests is None:
            merge_requests = np.full(len(self.merged), NO_REQUEST, dtype=np.int8)
        self._states_requests |= merge_requests != NO_REQUEST
        self._merge_requests = np.where(
            self._states_requests, merge_requests == MERGE, next_m >= 0.0
        )
        if self.driven_for.any():
            followed = follow_mps2(x_m, v_mps, self._scenario)
            answer[VUT] = np.where(self.driven_for, followed, answer[VUT])
        if self._stops:
            most = (speed_to_stop_mps(next_m, self._scenario) - v_mps[VUT]) / DT_S
            leaves = self.merged | self._granted(next_m)
            answer[VUT] = np.where(leaves, answer[VUT], np.minimum(answer[VUT], most))

    def step(self, x_m: FloatArray, v_mps: FloatArray) -> NDArray[np.bool_]:
        """Grant merge requests; return which VUTs are on the mainline after the next step, (K,).

        Args:
            x_m: positions of all vehicles, (A, K).
            v_mps: their speeds, (A, K).
        """
        next_m = x_m[VUT] + v_mps[VUT] * DT_S
        self.merged = self.merged | self._granted(next_m) | (next_m >= self.end_m)
        return self.merged

    def _granted(self, next_m: FloatArray) -> NDArray[np.bool_]:
        """Return the granted requests, (K,), for the next positions of the VUTs, (K,)."""
        return self._merge_requests & (next_m >= self.begin_m)
