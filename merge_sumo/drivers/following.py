"""Cars of the mainline in traffic: how they follow each other, and which of them the VUT meets.

Each of them plays its level against the VUT, but never drives faster than is safe behind the car
ahead of it. "Safe" is the speed of Krauss (1998), SUMO's original car-following model: at it a car
can still stop behind a leader that brakes as hard as it can, after a reaction time.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.level0 import level0_time_to
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import AHEAD, BEHIND, DT_S, POV, VUT

FOLLOWERS: Final = slice(POV, BEHIND + 1, BEHIND - POV)
LEADERS: Final = slice(AHEAD, None, POV - AHEAD)
"""The POV and the car behind it, and those that they follow: the car ahead and the POV."""


def safe_speed_mps(
    gap_m: FloatArray,
    v_leader_mps: FloatArray,
    decel_mps2: FloatArray | float,
    tau_s: FloatArray | float,
) -> FloatArray:
    """Return Krauss' safe speed at a distance behind a leader; arrays of one shape.

    v_safe = -b tau + sqrt((b tau)^2 + v_leader^2 + 2 b gap), S. Krauss, "Microscopic modeling of
    traffic flow", DLR-FB 98-08 (1998); a gap below 0 counts as 0.
    """
    lag = decel_mps2 * tau_s
    room = 2.0 * decel_mps2 * np.maximum(gap_m, 0.0)
    speed: FloatArray = np.sqrt(lag * lag + v_leader_mps * v_leader_mps + room) - lag
    return speed


def keep_safe(
    a_mps2: FloatArray,
    x_m: FloatArray,
    v_mps: FloatArray,
    taken_m: FloatArray | float,
    decel_mps2: FloatArray | float,
    tau_s: FloatArray | float,
) -> None:
    """Lower accelerations of the cars of the mainline, (A, K), to what is safe in states, (A, K).

    `taken_m` is what a car and the least gap before it take of the road.
    """
    gap_m = x_m[LEADERS] - x_m[FOLLOWERS] - taken_m
    safe = safe_speed_mps(gap_m, v_mps[LEADERS], decel_mps2, tau_s)
    most = (safe - v_mps[FOLLOWERS]) / DT_S
    a_mps2[FOLLOWERS] = np.minimum(a_mps2[FOLLOWERS], most)


class Following:
    """Keeps the cars of the mainline in K corridors from driving into each other."""

    def __init__(self, corridors: int) -> None:
        self._decel = np.ones(corridors)
        self._tau = np.ones(corridors)
        self._taken = np.zeros(corridors)
        self._a_mps2 = np.ones(corridors)
        self._v_mps = np.ones(corridors)

    def begin(self, corridor: int, case: Case) -> None:
        """Take the numbers of a case's scenario."""
        scenario = case.scenario
        self._decel[corridor] = -scenario.a_min_mps2
        self._tau[corridor] = scenario.tau_s
        self._taken[corridor] = scenario.pov_length_m + scenario.min_gap_m
        self._a_mps2[corridor] = scenario.level0_a_mps2
        self._v_mps[corridor] = scenario.level0_v_mps

    def limit(self, a_mps2: FloatArray, x_m: FloatArray, v_mps: FloatArray) -> None:
        """Lower accelerations, (A, K), to what is safe in states, (A, K)."""
        keep_safe(a_mps2, x_m, v_mps, self._taken, self._decel, self._tau)

    def met(self, x_m: FloatArray, v_mps: FloatArray) -> NDArray[np.int64]:
        """Return the row of the car that the VUT will meet, (K,), in states, (A, K)."""
        return car_met(x_m, v_mps, self._a_mps2, self._v_mps)


def car_met(
    x_m: FloatArray,
    v_mps: FloatArray,
    a_mps2: FloatArray | float,
    v_cruise_mps: FloatArray | float,
) -> NDArray[np.int64]:
    """Return the row of the car that the VUT will meet, (K,), in states, (A, K).

    It is the car that would be nearest to M when the VUT is there, if the car kept its speed and
    the VUT drove the scenario's level-0 profile; of cars as near the one with the lower row.
    """
    distance_m = np.maximum(-x_m[VUT], 0.0)
    t_s = level0_time_to(distance_m, v_mps[VUT], a_mps2, v_cruise_mps)
    gaps_m = np.abs(x_m + v_mps * t_s)
    gaps_m[VUT] = np.inf
    met: NDArray[np.int64] = gaps_m.argmin(axis=0)
    return met
