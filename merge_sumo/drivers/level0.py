"""Level-0 drivers: fixed speed profiles, blind to the other vehicle (Wang et al., section VI-B)."""

from __future__ import annotations

import numpy as np

from merge_sumo.drivers.base import BuiltInVut, Driver, Scene
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import DT_S, Scenario


def level0_acceleration(v_vut_mps: FloatArray, scenario: Scenario) -> FloatArray:
    """Return the accelerations of the level-0 profile, constant until exactly its speed.

    Args:
        v_vut_mps: present speeds, of any shape.
        scenario: the scenario of the profile.
    """
    missing = np.maximum((scenario.level0_v_mps - v_vut_mps) / DT_S, 0.0)
    return np.minimum(missing, scenario.level0_a_mps2)


def level0_time_to(distance_m: FloatArray, v_vut_mps: FloatArray, scenario: Scenario) -> FloatArray:
    """Compute the time that a vehicle needs for a distance on the level-0 profile.

    The profile accelerates by `level0_a_mps2` to `level0_v_mps`, then keeps the speed; a faster
    vehicle keeps its own. The steps of eq. (4) lie on the parabola that begins slower by half the
    gain of speed of a step. So the time does not drift while the vehicle follows the profile.

    Args:
        distance_m: distances, not negative, of any shape.
        v_vut_mps: present speeds, of the same shape.
        scenario: the scenario of the profile.

    Returns:
        The times in s, of the same shape.
    """
    a_mps2 = scenario.level0_a_mps2
    lag, twice_a = (0.5 * DT_S) * a_mps2, 2.0 * a_mps2
    v_cruise = np.maximum(v_vut_mps, scenario.level0_v_mps)
    v_start = v_vut_mps - lag
    v_squared = v_start * v_start
    v_end = np.minimum(np.sqrt(v_squared + twice_a * distance_m), v_cruise - lag)
    run_up = (v_end * v_end - v_squared) / twice_a
    return (v_end - v_start) / a_mps2 + (distance_m - run_up) / v_cruise


class Level0Pov(Driver):
    """A POV that keeps its speed."""

    def act(self, scene: Scene) -> FloatArray:
        """Return accelerations of 0, (K,).

        Args:
            scene: the present state.
        """
        return np.zeros(self.corridors)


class Level0Vut(Driver):
    """A VUT that drives the level-0 profile of its scenario: in us23 by 1 m/s2 up to 28 m/s.

    Example:
        driver = Level0Vut(corridors=1)
        a_mps2 = driver.act(scene)
    """

    def act(self, scene: Scene) -> FloatArray:
        """Return the accelerations of the level-0 profile, (K,).

        Args:
            scene: the present state.
        """
        return level0_acceleration(scene.v_vut_mps, self.scenario)


VUTS = {"level0": BuiltInVut(Level0Vut, ramp_only=True)}
