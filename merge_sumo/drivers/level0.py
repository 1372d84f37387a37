"""Level-0 drivers: fixed speed profiles, blind to the other vehicle (Wang et al., section VI-B)."""

from __future__ import annotations

from typing import Final

import numpy as np

from merge_sumo.drivers.base import BuiltInVut, Driver, Scene
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S, US23


def level0_acceleration(
    v_vut_mps: FloatArray,
    a_mps2: FloatArray | float,
    v_cruise_mps: FloatArray | float,
) -> FloatArray:
    """Return the level-0 VUT's acceleration, m/s2: `a_mps2` until its speed, which it meets."""
    return np.minimum(np.maximum((v_cruise_mps - v_vut_mps) / DT_S, 0.0), a_mps2)


def level0_time_to(
    distance_m: FloatArray,
    v_vut_mps: FloatArray,
    a_mps2: FloatArray | float,
    v_cruise_mps: FloatArray | float,
) -> FloatArray:
    """Return the seconds that a vehicle needs for a distance on the level-0 profile.

    The profile as eq. (4) drives it: `a_mps2` up to `v_cruise_mps`, then constant; a vehicle that
    is faster keeps its speed. The steps of eq. (4) lie on the parabola that begins slower by half a
    step's gain of speed, so this time, and what is predicted with it, does not drift while the
    vehicle follows the profile. Arrays of one shape, distances not negative.
    """
    lag, twice_a = (0.5 * DT_S) * a_mps2, 2.0 * a_mps2
    v_cruise = np.maximum(v_vut_mps, v_cruise_mps)
    v_start = v_vut_mps - lag
    v_squared = v_start * v_start
    v_end = np.minimum(np.sqrt(v_squared + twice_a * distance_m), v_cruise - lag)
    run_up = (v_end * v_end - v_squared) / twice_a
    time: FloatArray = (v_end - v_start) / a_mps2 + (distance_m - run_up) / v_cruise
    return time


class Level0Pov(Driver):
    """Keeps its speed."""

    def act(self, scene: Scene) -> FloatArray:
        """Return no acceleration, (K,)."""
        return np.zeros(self.corridors)


class Level0Vut(Driver):
    """Accelerates as the scenario's level-0 profile says and holds its speed: 1 m/s2 to 28 m/s."""

    def __init__(self, corridors: int) -> None:
        super().__init__(corridors)
        self.a_mps2 = np.full(corridors, US23.level0_a_mps2)
        self.v_cruise_mps = np.full(corridors, US23.level0_v_mps)

    def begin(self, corridor: int, case: Case) -> None:
        """Take the profile of the case's scenario."""
        self.a_mps2[corridor] = case.scenario.level0_a_mps2
        self.v_cruise_mps[corridor] = case.scenario.level0_v_mps

    def act(self, scene: Scene) -> FloatArray:
        """Return the level-0 acceleration."""
        return level0_acceleration(scene.v_vut_mps, self.a_mps2, self.v_cruise_mps)


VUTS: Final = {"level0": BuiltInVut(Level0Vut, ramp_only=True)}
