"""Level-0 drivers: fixed speed profiles, blind to the other vehicle (Wang et al., section VI-B)."""

from __future__ import annotations

import numpy as np

from merge_sumo.case import FloatArray
from merge_sumo.drivers.base import Driver, Scene
from merge_sumo.scenario import DT_S, LEVEL0_A_MPS2, LEVEL0_V_MPS


def level0_acceleration(v_vut_mps: FloatArray) -> FloatArray:
    """Return the level-0 VUT's acceleration, m/s2: +1 until 28 m/s, which it meets exactly."""
    return np.minimum(np.maximum((LEVEL0_V_MPS - v_vut_mps) / DT_S, 0.0), LEVEL0_A_MPS2)


def level0_time_to(distance_m: FloatArray, v_vut_mps: FloatArray) -> FloatArray:
    """Return the seconds that a vehicle needs for a distance on the level-0 profile.

    The profile as eq. (4) drives it: 1 m/s2 up to 28 m/s, then constant; a vehicle that is faster
    keeps its speed. The steps of eq. (4) lie on the parabola that begins slower by half a step's
    gain of speed, so this time, and what is predicted with it, does not drift while the vehicle
    follows the profile. Arrays of one shape, distances not negative.
    """
    lag = 0.5 * LEVEL0_A_MPS2 * DT_S
    v_cruise = np.maximum(v_vut_mps, LEVEL0_V_MPS)
    v_start = v_vut_mps - lag
    v_squared = v_start * v_start
    v_end = np.minimum(np.sqrt(v_squared + (2.0 * LEVEL0_A_MPS2) * distance_m), v_cruise - lag)
    run_up = (v_end * v_end - v_squared) / (2.0 * LEVEL0_A_MPS2)
    time: FloatArray = (v_end - v_start) / LEVEL0_A_MPS2 + (distance_m - run_up) / v_cruise
    return time


class Level0Pov(Driver):
    """Keeps its speed."""

    def act(self, scene: Scene) -> FloatArray:
        """Return zeros."""
        return np.zeros(self.corridors)


class Level0Vut(Driver):
    """Accelerates by 1 m/s2 until 28 m/s and holds that speed."""

    def act(self, scene: Scene) -> FloatArray:
        """Return the level-0 acceleration."""
        return level0_acceleration(scene.v_vut_mps)
