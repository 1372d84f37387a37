"""Traffic on the mainline: the cars follow each other, and one of them conflicts with the VUT.

Each car plays its level against the VUT, but at most at the safe speed behind the car ahead.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.level0 import level0_time_to
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import AHEAD, BEHIND, DT_S, POV, VUT, Scenario

FOLLOWERS = slice(POV, BEHIND + 1, BEHIND - POV)
LEADERS = slice(AHEAD, None, POV - AHEAD)
"""Rows of the POV and the car behind it, and of the car ahead and the POV, which they follow."""


def safe_speed_mps(
    gap_m: FloatArray, v_leader_mps: FloatArray, decel_mps2: float, tau_s: float
) -> FloatArray:
    """Return the safe speed of Krauss behind a leader, SUMO's original car-following model.

    At this speed a car can still stop behind a leader that brakes as hard as it can:
    v_safe = -b tau + sqrt((b tau)^2 + v_leader^2 + 2 b gap). S. Krauss, "Microscopic modeling of
    traffic flow", DLR-FB 98-08 (1998).

    Args:
        gap_m: distances from bumper to bumper; a gap below 0 counts as 0.
        v_leader_mps: speeds of the leaders, of the same shape.
        decel_mps2: hardest braking b, positive.
        tau_s: reaction time tau.
    """
    lag = decel_mps2 * tau_s
    room = 2.0 * decel_mps2 * np.maximum(gap_m, 0.0)
    return np.sqrt(lag * lag + v_leader_mps * v_leader_mps + room) - lag


def keep_safe(a_mps2: FloatArray, x_m: FloatArray, v_mps: FloatArray, scenario: Scenario) -> None:
    """Lower accelerations of the cars of the mainline to safe ones, in place.

    Args:
        a_mps2: accelerations of all vehicles, (A, K).
        x_m: their positions, (A, K).
        v_mps: their speeds, (A, K).
        scenario: gives the length of a car, the least gap, the hardest braking and the reaction
            time.
    """
    gap_m = x_m[LEADERS] - x_m[FOLLOWERS] - (scenario.pov_length_m + scenario.min_gap_m)
    safe = safe_speed_mps(gap_m, v_mps[LEADERS], -scenario.a_min_mps2, scenario.tau_s)
    most = (safe - v_mps[FOLLOWERS]) / DT_S
    a_mps2[FOLLOWERS] = np.minimum(a_mps2[FOLLOWERS], most)


def conflicting_car(x_m: FloatArray, v_mps: FloatArray, scenario: Scenario) -> NDArray[np.int64]:
    """Return the row of the conflicting car, (K,).

    It is nearest to M when the VUT is there, if all cars keep their speeds and the VUT follows the
    level-0 profile. Of two equally near cars it is the one with the lower row.

    Args:
        x_m: positions of all vehicles, (A, K).
        v_mps: their speeds, (A, K).
        scenario: the scenario of the profile.
    """
    distance_m = np.maximum(-x_m[VUT], 0.0)
    gaps_m = np.abs(x_m + v_mps * level0_time_to(distance_m, v_mps[VUT], scenario))
    gaps_m[VUT] = np.inf
    return np.asarray(gaps_m.argmin(axis=0))
