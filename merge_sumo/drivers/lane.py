"""Driving along an acceleration lane: the POVs, and a VUT that only accelerates.

On such a road the VUT is on the mainline from the step of its merge on, and M is only the place
where POVs expect the merge.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.base import MERGE, NO_REQUEST, Driver, DriverWrapper, Scene
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S, OWN, VUT, Scenario

A_MPS2 = 1.5
B_MPS2 = 2.0
"""Acceleration and comfortable deceleration of IDM and ACC. Kesting, Treiber and Helbing (2010)."""
LEAST_GAP_M = 0.01
"""Smaller gaps, and overlaps, count as this."""
END_MARGIN_M = 0.5
"""Least distance from the end of the lane of a VUT that has to stop before it."""


def idm_mps2(
    gap_m: FloatArray,
    v_mps: FloatArray,
    v_leader_mps: FloatArray,
    v_desired_mps: FloatArray | float,
) -> FloatArray:
    """Return the acceleration of the intelligent driver model: Treiber, Hennecke, Helbing (2000).

    The time headway is 1 s, the gap at a stand 2 m.

    Args:
        gap_m: distances from bumper to bumper, (K,); infinite on a free road.
        v_mps: speeds, (K,).
        v_leader_mps: speeds of the leaders, (K,).
        v_desired_mps: desired speeds, (K,) or one; those below 0.1 m/s count as 0.1 m/s.
    """
    gap_m = np.maximum(gap_m, LEAST_GAP_M)
    closing = v_mps * (v_mps - v_leader_mps) / (2.0 * np.sqrt(A_MPS2 * B_MPS2))
    wanted_m = 2.0 + np.maximum(v_mps * 1.0 + closing, 0.0)
    free = 1.0 - (v_mps / np.maximum(v_desired_mps, 0.1)) ** 4
    return np.asarray(A_MPS2 * (free - (wanted_m / gap_m) ** 2))


def acc_mps2(
    gap_m: FloatArray,
    v_mps: FloatArray,
    v_leader_mps: FloatArray,
    a_leader_mps2: FloatArray,
    v_desired_mps: FloatArray | float,
) -> FloatArray:
    """Return the acceleration of adaptive cruise control behind a leader, (K,).

    IDM brakes hard for any leader that is nearer than desired. ACC tempers it by the acceleration
    that is needed if the leader keeps its own (the constant-acceleration heuristic, CAH), with a
    coolness of 0.99. Kesting, Treiber and Helbing, "Enhanced intelligent driver model to access the
    impact of driving strategies on traffic capacity", Phil. Trans. R. Soc. A 368 (2010), eqs. (2.3)
    and (2.4).

    Args:
        gap_m: distances from bumper to bumper, (K,).
        v_mps: speeds, (K,).
        v_leader_mps: speeds of the leaders, (K,).
        a_leader_mps2: their accelerations, (K,).
        v_desired_mps: desired speeds, (K,) or one.
    """
    idm = idm_mps2(gap_m, v_mps, v_leader_mps, v_desired_mps)
    gap_m = np.maximum(gap_m, LEAST_GAP_M)
    a_leader = np.minimum(a_leader_mps2, A_MPS2)
    closing = v_mps - v_leader_mps
    stops = v_leader_mps * closing <= -2.0 * gap_m * a_leader
    below = v_leader_mps**2 - 2.0 * gap_m * a_leader
    stopping = v_mps**2 * a_leader / np.where(stops & (below != 0.0), below, 1.0)
    cah = np.where(stops, stopping, a_leader - np.maximum(closing, 0.0) ** 2 / (2.0 * gap_m))
    coolness = 0.99
    tempered = (1.0 - coolness) * idm + coolness * (cah + B_MPS2 * np.tanh((idm - cah) / B_MPS2))
    return np.where(idm >= cah, idm, tempered)


Places = tuple[NDArray[np.int64], NDArray[np.int64]]
"""Rows and corridors, (K,) each: the index of one vehicle in each corridor."""


def car_ahead(x_m: FloatArray) -> tuple[FloatArray, Places]:
    """Return the distance from the VUT to the nearest car ahead, (K,), and the index of that car.

    The distance is between front bumpers, and infinite without such a car; `x_m` is (A, K).
    """
    ahead_m = x_m - x_m[VUT]
    ahead_m[VUT] = -1.0
    ahead_m = np.where(ahead_m >= 0.0, ahead_m, np.inf)
    return ahead_m.min(axis=0), (ahead_m.argmin(axis=0), np.arange(x_m.shape[1]))


def follow_mps2(x_m: FloatArray, v_mps: FloatArray, scenario: Scenario) -> FloatArray:
    """Return the acceleration by IDM of a VUT after its merge, (K,).

    It follows the nearest car ahead and desires the level-0 speed.

    Args:
        x_m: positions of all vehicles, (A, K).
        v_mps: their speeds, (A, K).
        scenario: the scenario of the episodes.
    """
    ahead_m, leader = car_ahead(x_m)
    gap_m = ahead_m - scenario.pov_length_m
    return idm_mps2(gap_m, v_mps[VUT], v_mps[leader], scenario.level0_v_mps)


def stopping_mps(room_m: FloatArray, brake_mps2: float) -> FloatArray:
    """Return the highest speeds, (K,), from which a vehicle stops within distances, (K,).

    By eq. (4) braking at b from a speed v takes v^2 / (2 b) + v dt / 2.
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


class PovAfterMerge(DriverWrapper):
    """Drives cars of the mainline at an acceleration lane by a driver that expects a merge at M.

    While the VUT is before M, the driver decides. When the VUT is past M, the driver sees the end
    of the lane as M. A car that has passed the VUT returns to its first speed. After the merge
    every car does so, and a car behind the VUT follows it no closer than ACC. A POV of the user
    decides for itself until the merge.
    """

    def __init__(self, driver: Driver) -> None:
        """Take the driver of all cars."""
        super().__init__(driver)
        self._v_first_mps = np.zeros(driver.corridors)
        self._is_own = np.zeros(driver.corridors, dtype=np.bool_)
        self._v_vut_mps = np.zeros(driver.corridors)

    def begin(self, corridor: int, case: Case) -> None:
        """Take the first speed of a car."""
        super().begin(corridor, case)
        self._v_first_mps[corridor] = case.v_pov0_mps
        self._is_own[corridor] = case.level == OWN
        self._v_vut_mps[corridor] = case.starts()[VUT][1]

    def act(self, scene: Scene) -> FloatArray:
        """Return the accelerations, (K,)."""
        merged = np.zeros(self.corridors, np.bool_) if scene.merged is None else scene.merged
        x_pov, v_pov, x_vut, v_vut = scene.x_pov_m, scene.v_pov_mps, scene.x_vut_m, scene.v_vut_mps
        after_m = ~merged & ~self._is_own & (x_vut >= 0.0)
        seen = scene
        if after_m.any():
            _, end_m = self.scenario.lane_m or (0.0, 0.0)
            seen = scene._replace(x_m=scene.x_m - np.where(after_m, end_m, 0.0))
        answer = self._driver.act(seen)
        recovery = np.clip((self._v_first_mps - v_pov) / DT_S, 0.0, 1.0)
        passed = after_m & (x_pov - self.scenario.pov_length_m > x_vut)
        answer = np.where(passed | (merged & ~self._is_own), recovery, answer)
        follows = merged & (x_pov < x_vut)
        if follows.any():
            gap_m = x_vut - self.scenario.vut_length_m - x_pov
            a_vut = (v_vut - self._v_vut_mps) / DT_S
            most = acc_mps2(gap_m, v_pov, v_vut, a_vut, self._v_first_mps)
            answer = np.where(follows, np.minimum(answer, most), answer)
        self._v_vut_mps = v_vut.copy()
        return answer


class Merging:
    """The merges of the VUTs of K corridors on a road with an acceleration lane.

    Attributes:
        merged: whether the VUT of a corridor is on the mainline, (K,).
    """

    def __init__(self, corridors: int, scenario: Scenario) -> None:
        """Take the lane of a scenario, and its `lane_end`."""
        self.begin_m, self.end_m = scenario.lane_m or (0.0, 0.0)
        self._stops = scenario.lane_end == "stop"
        self._scenario = scenario
        self.merged = np.zeros(corridors, dtype=np.bool_)
        self._states_requests = np.zeros(corridors, dtype=np.bool_)
        """Whether the VUT has ever made a merge request."""
        self._merge_requests = np.zeros(corridors, dtype=np.bool_)

    @property
    def driven_for(self) -> NDArray[np.bool_]:
        """Which VUTs have merged without any merge request, (K,): they are driven for."""
        return self.merged & ~self._states_requests

    def begin(self, corridor: int) -> None:
        """Begin an episode in a corridor: the VUT is on the ramp."""
        self.merged[corridor] = self._states_requests[corridor] = self._merge_requests[corridor] = (
            False
        )

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
        """Return which VUTs are on the mainline after the next step, (K,)."""
        next_m = x_m[VUT] + v_mps[VUT] * DT_S
        self.merged = self.merged | self._granted(next_m) | (next_m >= self.end_m)
        return self.merged

    def _granted(self, next_m: FloatArray) -> NDArray[np.bool_]:
        """Return the granted requests, (K,), for the next positions of the VUTs, (K,)."""
        return self._merge_requests & (next_m >= self.begin_m)
