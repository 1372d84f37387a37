"""Driving beside an acceleration lane: the POVs, and a VUT that only accelerates.

On a road with an acceleration lane the VUT is on the mainline from the step of its merge on; M is
only the place where a merge is expected. A POV plays the game that it knows, a merge at M, as long
as that can be played, and then drives as cars do.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.base import MERGE, NO_WISH, Driver, DriverWrapper, Scene
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S, OWN, US23, VUT, Scenario

RECOVERY_MPS2: Final = 1.0
"""Acceleration with which a POV comes back to the speed at which it started."""
A_MPS2: Final = 1.5
B_MPS2: Final = 2.0
HEADWAY_S: Final = 1.0
STANDSTILL_M: Final = 2.0
COOLNESS: Final = 0.99
"""Parameters of IDM and ACC: acceleration, comfortable deceleration, time headway, gap at a stand,
and how much of IDM's alarm about a near leader is left out. Kesting, Treiber and Helbing (2010)."""
LEAST_GAP_M: Final = 0.01
"""A smaller gap, or an overlap, counts as this."""
LEAST_SPEED_MPS: Final = 0.1
"""A lower desired speed counts as this."""
END_MARGIN_M: Final = 0.5
"""A VUT that may not pass the lane's end stands at least so far before it."""


def idm_mps2(
    gap_m: FloatArray, v_mps: FloatArray, v_leader_mps: FloatArray, v_desired_mps: FloatArray
) -> FloatArray:
    """Return the acceleration of the intelligent driver model behind a leader; arrays of one shape.

    Treiber, Hennecke and Helbing (2000); an infinite gap is a free road.
    """
    gap_m = np.maximum(gap_m, LEAST_GAP_M)
    closing = v_mps * (v_mps - v_leader_mps) / (2.0 * np.sqrt(A_MPS2 * B_MPS2))
    wanted_m = STANDSTILL_M + np.maximum(v_mps * HEADWAY_S + closing, 0.0)
    free = 1.0 - (v_mps / np.maximum(v_desired_mps, LEAST_SPEED_MPS)) ** 4
    acceleration: FloatArray = A_MPS2 * (free - (wanted_m / gap_m) ** 2)
    return acceleration


def acc_mps2(
    gap_m: FloatArray,
    v_mps: FloatArray,
    v_leader_mps: FloatArray,
    a_leader_mps2: FloatArray,
    v_desired_mps: FloatArray,
) -> FloatArray:
    """Return the acceleration of adaptive cruise control behind a leader; arrays of one shape.

    IDM, which brakes hard for any leader that is nearer than it wishes, is tempered by what is
    needed if the leader goes on as it does (the constant-acceleration heuristic). Kesting, Treiber
    and Helbing, "Enhanced intelligent driver model to access the impact of driving strategies on
    traffic capacity", Phil. Trans. R. Soc. A 368 (2010), eqs. (2.3) and (2.4).
    """
    idm = idm_mps2(gap_m, v_mps, v_leader_mps, v_desired_mps)
    gap_m = np.maximum(gap_m, LEAST_GAP_M)
    a_leader = np.minimum(a_leader_mps2, A_MPS2)
    closing = v_mps - v_leader_mps
    stops = v_leader_mps * closing <= -2.0 * gap_m * a_leader
    below = v_leader_mps**2 - 2.0 * gap_m * a_leader
    stopping = v_mps**2 * a_leader / np.where(stops & (below != 0.0), below, 1.0)
    cah = np.where(stops, stopping, a_leader - np.maximum(closing, 0.0) ** 2 / (2.0 * gap_m))
    tempered = (1.0 - COOLNESS) * idm + COOLNESS * (cah + B_MPS2 * np.tanh((idm - cah) / B_MPS2))
    return np.where(idm >= cah, idm, tempered)


Following = Callable[[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray], FloatArray]
"""Gives accelerations by gaps, speeds, speeds and accelerations of leaders, and desired speeds."""


def follow_mps2(x_m: FloatArray, v_mps: FloatArray, scenario: Scenario) -> FloatArray:
    """Return the acceleration of a VUT that is driven for after its merge, (K,): IDM.

    The states are (A, K); it follows the nearest car ahead, and wants the level-0 speed.
    """
    gaps_m = x_m - x_m[VUT]
    gaps_m[VUT] = -1.0
    gaps_m = np.where(gaps_m > 0.0, gaps_m, np.inf)
    leader, places = gaps_m.argmin(axis=0), np.arange(x_m.shape[1])
    gap_m = gaps_m[leader, places] - scenario.pov_length_m
    v_desired = np.full(x_m.shape[1], scenario.level0_v_mps)
    return idm_mps2(gap_m, v_mps[VUT], v_mps[leader, places], v_desired)


def stopping_mps(room_m: FloatArray, brake_mps2: float) -> FloatArray:
    """Return the highest speeds from which a vehicle still stops within distances, (K,).

    By eq. (4) braking at b from a speed v takes v^2 / (2 b) + v dt / 2.
    """
    half = 0.5 * brake_mps2 * DT_S
    speed: FloatArray = np.sqrt(half**2 + 2.0 * brake_mps2 * np.maximum(room_m, 0.0)) - half
    return speed


class LanePov(DriverWrapper):
    """Drives cars of the mainline beside an acceleration lane by a driver that knows a merge at M.

    As long as the VUT is before M, the driver plays as ever; from M on it plays as if M were the
    lane's end. A car that the VUT has let pass comes back to its first speed and brakes no more for
    it. After the merge every car does so and, behind the VUT, follows it no closer than ACC does. A
    POV of a person's own decides for itself until then.
    """

    def __init__(self, driver: Driver, follow: Following = acc_mps2) -> None:
        """Take the driver of all cars, and how they follow a VUT that has merged."""
        super().__init__(driver)
        self._follow = follow
        self._v_first_mps = np.zeros(driver.corridors)
        self._end_m = np.zeros(driver.corridors)
        self._pov_length_m = np.full(driver.corridors, US23.pov_length_m)
        self._vut_length_m = np.full(driver.corridors, US23.vut_length_m)
        self._is_own = np.zeros(driver.corridors, dtype=np.bool_)
        self._v_vut_mps = np.zeros(driver.corridors)

    def begin(self, corridor: int, case: Case) -> None:
        """Take the first speed of a car, and the lane of its scenario."""
        scenario = case.scenario
        self._v_first_mps[corridor] = case.v_pov0_mps
        self._end_m[corridor] = (scenario.lane_m or (0.0, 0.0))[1]
        self._pov_length_m[corridor] = scenario.pov_length_m
        self._vut_length_m[corridor] = scenario.vut_length_m
        self._is_own[corridor] = case.level == OWN
        self._v_vut_mps[corridor] = case.starts()[VUT][1]
        self._driver.begin(corridor, case)

    def act(self, scene: Scene) -> FloatArray:
        """Return the accelerations, (K,)."""
        merged = np.zeros(self.corridors, np.bool_) if scene.merged is None else scene.merged
        x_pov, v_pov, x_vut, v_vut = scene.x_pov_m, scene.v_pov_mps, scene.x_vut_m, scene.v_vut_mps
        behind_m = ~merged & ~self._is_own & (x_vut >= 0.0)
        of_game = scene
        if behind_m.any():
            of_game = scene._replace(x_m=scene.x_m - np.where(behind_m, self._end_m, 0.0))
        answer = self._driver.act(of_game)
        recovery = np.clip((self._v_first_mps - v_pov) / DT_S, 0.0, RECOVERY_MPS2)
        passed = behind_m & (x_pov - self._pov_length_m > x_vut)
        answer = np.where(passed | (merged & ~self._is_own), recovery, answer)
        follows = merged & (x_pov < x_vut)
        if follows.any():
            gap_m, a_vut = x_vut - self._vut_length_m - x_pov, (v_vut - self._v_vut_mps) / DT_S
            most = self._follow(gap_m, v_pov, v_vut, a_vut, self._v_first_mps)
            answer = np.where(follows, np.minimum(answer, most), answer)
        self._v_vut_mps = v_vut.copy()
        return answer


class Merging:
    """Which VUTs of K corridors are on the mainline of a road with an acceleration lane.

    Attributes:
        merged: whether the VUT of a corridor is on the mainline, (K,).
    """

    def __init__(self, corridors: int, scenario: Scenario) -> None:
        """Take the lane of a scenario, and what its end does to a VUT."""
        self.begin_m, self.end_m = scenario.lane_m or (0.0, 0.0)
        self._stops = getattr(scenario, "lane_end", "merge") == "stop"
        self._scenario = scenario
        self.merged = np.zeros(corridors, dtype=np.bool_)
        self._states_wishes = np.zeros(corridors, dtype=np.bool_)
        """Whether the VUT has ever stated a wish."""
        self._wishes = np.zeros(corridors, dtype=np.bool_)

    @property
    def driven_for(self) -> NDArray[np.bool_]:
        """Which VUTs only accelerate and have merged: they are driven for, (K,)."""
        only_accelerate: NDArray[np.bool_] = self.merged & ~self._states_wishes
        return only_accelerate

    def begin(self, corridor: int) -> None:
        """Forget a corridor: a VUT begins on the ramp."""
        self.merged[corridor] = self._states_wishes[corridor] = self._wishes[corridor] = False

    def take(
        self,
        wishes: NDArray[np.int8] | None,
        answer: FloatArray,
        x_m: FloatArray,
        v_mps: FloatArray,
    ) -> None:
        """Take the wishes of VUTs, (K,), in states, (A, K); limit their answers in (A, K)."""
        next_m = x_m[VUT] + v_mps[VUT] * DT_S
        if wishes is None:
            wishes = np.full(len(self.merged), NO_WISH, dtype=np.int8)
        self._states_wishes |= wishes != NO_WISH
        self._wishes = np.where(self._states_wishes, wishes == MERGE, next_m >= 0.0)
        if self.driven_for.any():
            followed = follow_mps2(x_m, v_mps, self._scenario)
            answer[VUT] = np.where(self.driven_for, followed, answer[VUT])
        if self._stops:
            stopping = stopping_mps(self.end_m - END_MARGIN_M - next_m, -self._scenario.a_min_mps2)
            most = (stopping - v_mps[VUT]) / DT_S
            leaves = self.merged | self._granted(next_m)
            answer[VUT] = np.where(leaves, answer[VUT], np.minimum(answer[VUT], most))

    def step(self, x_m: FloatArray, v_mps: FloatArray) -> NDArray[np.bool_]:
        """Return which VUTs are on the mainline after the next step of states, (A, K): (K,)."""
        next_m = x_m[VUT] + v_mps[VUT] * DT_S
        self.merged = self.merged | self._granted(next_m) | (next_m >= self.end_m)
        return self.merged

    def _granted(self, next_m: FloatArray) -> NDArray[np.bool_]:
        """Return the granted wishes, (K,), by the next places of the VUTs, (K,)."""
        return self._wishes & (next_m >= self.begin_m)
