"""Car-following models (Krauss, IDM, ACC), and the car of the mainline that conflicts with the VUT.

Each car of the mainline plays its level against the VUT, but at most at the safe speed of Krauss
behind the car ahead. The other models drive after a merge.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.level0 import level0_time_to
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import AHEAD, BEHIND, DT_S, POV, VUT, Scenario

A_MPS2 = 1.5
B_MPS2 = 2.0
"""Acceleration and comfortable deceleration of IDM and ACC. Kesting, Treiber and Helbing (2010)."""
LEAST_GAP_M = 0.01
"""Smaller gaps, and overlaps, count as this."""
FOLLOWERS = slice(POV, BEHIND + 1, BEHIND - POV)
LEADERS = slice(AHEAD, None, POV - AHEAD)
"""Rows of the POV and the car behind it, and of the car ahead and the POV, which they follow."""


def safe_speed_mps(
    gap_m: FloatArray, v_leader_mps: FloatArray, decel_mps2: float, tau_s: float
) -> FloatArray:
    """Compute the safe speed of Krauss behind a leader, SUMO's original car-following model.

    At this speed a car can still stop behind a leader that brakes as hard as it can:
    v_safe = -b tau + sqrt((b tau)^2 + v_leader^2 + 2 b gap). S. Krauss, "Microscopic modeling of
    traffic flow", DLR-FB 98-08 (1998).

    Args:
        gap_m: distances from bumper to bumper; a gap below 0 counts as 0.
        v_leader_mps: speeds of the leaders, of the same shape.
        decel_mps2: hardest braking b, positive.
        tau_s: reaction time tau.

    Returns:
        The speeds in m/s, of the same shape.
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
    """Find the conflicting car in each corridor.

    It is nearest to M when the VUT is there, if all cars keep their speeds and the VUT follows the
    level-0 profile. Of two equally near cars it is the one with the lower row.

    Args:
        x_m: positions of all vehicles, (A, K).
        v_mps: their speeds, (A, K).
        scenario: the scenario of the profile.

    Returns:
        The rows of the cars, (K,).
    """
    distance_m = np.maximum(-x_m[VUT], 0.0)
    gaps_m = np.abs(x_m + v_mps * level0_time_to(distance_m, v_mps[VUT], scenario))
    gaps_m[VUT] = np.inf
    return np.asarray(gaps_m.argmin(axis=0))


def idm_mps2(
    gap_m: FloatArray,
    v_mps: FloatArray,
    v_leader_mps: FloatArray,
    v_desired_mps: FloatArray | float,
) -> FloatArray:
    """Return the accelerations, (K,), of the intelligent driver model behind leaders.

    Treiber, Hennecke and Helbing (2000). The time headway is 1 s, the gap at a stand 2 m.

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
    """Return the accelerations, (K,), of adaptive cruise control behind leaders.

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


def car_ahead(x_m: FloatArray) -> tuple[FloatArray, tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Find the nearest car ahead of the VUT in each corridor.

    Args:
        x_m: positions of all vehicles, (A, K).

    Returns:
        The distance between the front bumpers, (K,), infinite without such a car; and the index of
        that car in arrays of shape (A, K): rows and corridors, (K,) each.
    """
    ahead_m = x_m - x_m[VUT]
    ahead_m[VUT] = -1.0
    ahead_m = np.where(ahead_m >= 0.0, ahead_m, np.inf)
    return ahead_m.min(axis=0), (ahead_m.argmin(axis=0), np.arange(x_m.shape[1]))


def follow_mps2(x_m: FloatArray, v_mps: FloatArray, scenario: Scenario) -> FloatArray:
    """Return the accelerations, (K,), by IDM of VUTs after their merges.

    It follows the nearest car ahead and desires the level-0 speed.

    Args:
        x_m: positions of all vehicles, (A, K).
        v_mps: their speeds, (A, K).
        scenario: the scenario of the episodes.
    """
    ahead_m, leader = car_ahead(x_m)
    gap_m = ahead_m - scenario.pov_length_m
    return idm_mps2(gap_m, v_mps[VUT], v_mps[leader], scenario.level0_v_mps)
