"""POVs after a merge, in a follow-up or along an acceleration lane."""

from __future__ import annotations

import numpy as np

from merge_sumo.drivers.base import Driver, DriverWrapper, Scene
from merge_sumo.drivers.car_following import acc_mps2
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S, OWN, VUT


class PovAfterMerge(DriverWrapper):
    """Drives cars of the mainline by a driver that expects a merge at M; after a merge, by ACC.

    While the VUT is before M, the driver decides. On an acceleration lane the VUT may pass M
    without a merge: the driver then sees the end of the lane as M, and a car that has passed the
    VUT returns to its first speed. After the merge every car returns to its first speed, and a car
    behind the VUT follows it no closer than ACC. A POV of the user decides for itself until the
    merge, and after it where it is ahead of the VUT.

    Example:
        pov = PovAfterMerge(Level0Pov(corridors=1))
    """

    def __init__(self, driver: Driver) -> None:
        """Take the driver until the merge.

        Args:
            driver: drives the C cars of the mainline of K corridors; car c of corridor k has the
                index c K + k.
        """
        super().__init__(driver)
        self._v_first_mps = np.zeros(driver.corridors)
        self._is_own = np.zeros(driver.corridors, dtype=np.bool_)
        self._v_vut_mps = np.zeros(driver.corridors)
        """Speeds of the VUTs a step ago."""

    def begin(self, corridor: int, case: Case) -> None:
        """Take the first speed of a car.

        Args:
            corridor: index of the corridor of the car.
            case: the case of the next episode.
        """
        super().begin(corridor, case)
        self._v_first_mps[corridor] = case.v_pov0_mps
        self._is_own[corridor] = case.level == OWN
        self._v_vut_mps[corridor] = case.starts()[VUT][1]

    def act(self, scene: Scene) -> FloatArray:
        """Return the accelerations of the cars, (K,).

        Args:
            scene: the present state of the corridors of all cars.
        """
        merged = np.zeros(self.corridors, np.bool_) if scene.merged is None else scene.merged
        x_pov, v_pov, x_vut, v_vut = scene.x_pov_m, scene.v_pov_mps, scene.x_vut_m, scene.v_vut_mps
        after_m = ~merged & ~self._is_own & (x_vut >= 0.0)
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
