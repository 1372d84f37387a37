"""The score P of an episode (Wang et al., section V-A).

P = MU_CRASH I_crash + MU_SAFETY P_safety + MU_TASK P_task is never positive, and P < -500 exactly
when the front bumpers are within 6 m as the VUT reaches M, which the paper calls a crash; bodies
need not touch then (`merge.py`). A surrogate must be able to learn P, so it falls smoothly over
tens of metres towards that limit, jumps little there, and continues to fall beyond it.
"""

from __future__ import annotations

import math

import numpy as np

from merge_sumo.scenario.scenario import VUT
from merge_sumo.scenario.trajectory import End, Trajectory

FAILURE_SCORE = -500.0
"""lambda: a case fails by the paper's criterion when its score is below."""

# The bounds that make "P < -500" and the paper's crash the same: without one P_safety and
# P_task are at least -1, so P >= -495; with one P_safety is at most -1, so P <= -560.
MU_CRASH = -110.0
MU_SAFETY = 450.0
MU_TASK = 45.0
GAP_SCALE_M = 15.0
"""Length over which P_safety decays with the gap; tens of metres, so that a surrogate sees it."""
TTC_SHARE = 1.0 / 9.0
"""Part of P_safety that a short time to collision can cost; the gap has the rest."""


def margin_of(score: float | None) -> float | None:
    """Return the margin of a score P: how far it is above lambda, in units of lambda.

    Args:
        score: the score; None after an error.
    """
    return None if score is None else (score - FAILURE_SCORE) / abs(FAILURE_SCORE)


def time_to_collision(dx_m: float, dv_mps: float) -> float | None:
    """Return TTC = -dx/dv in seconds where the gap closes (dx dv < 0), else None (section VI-C).

    Args:
        dx_m: x_POV - x_VUT, in m.
        dv_mps: v_POV - v_VUT, in m/s.
    """
    return -dx_m / dv_mps if dx_m * dv_mps < 0 else None


def merge_score(trajectory: Trajectory) -> float | None:
    """Return the score P of a merge; None after an error.

    Args:
        trajectory: the motion.
    """
    if trajectory.end.is_error:
        return None
    scenario = trajectory.case.scenario
    crash = p_safety = 0.0
    if trajectory.end is End.MERGED:
        pov, vut = trajectory.motion[-1, [trajectory.nearest, VUT], :2].tolist()
        dx_m = pov[0] - vut[0]
        ttc_s = time_to_collision(dx_m, pov[1] - vut[1])
        overlap_m = scenario.dx_crash_m - abs(dx_m)
        if overlap_m > 0.0:
            crash = MU_CRASH
            p_safety = -1.0 - overlap_m / scenario.dx_crash_m
        else:
            short_ttc = 0.0 if ttc_s is None else max(0.0, 1.0 - ttc_s / scenario.ttc_min_s)
            near = math.exp(overlap_m / GAP_SCALE_M)
            p_safety = -(1.0 - TTC_SHARE) * near - TTC_SHARE * short_ttc
    return crash + MU_SAFETY * p_safety + MU_TASK * _task(trajectory)


def _task(trajectory: Trajectory) -> float:
    """Return P_task in [-1, 0]: a slow ramp, a final speed off the highway's, harshness, no end."""
    v_vut, scenario = trajectory.v_vut_mps, trajectory.case.scenario
    v_end = float(v_vut[-1])
    steps = len(v_vut)
    # The sums are a third of the time of `mean`, and the same to the last bit.
    slow = float(np.add.reduce(np.maximum(scenario.v_min_mps - v_vut, 0.0)) / steps)
    slow /= scenario.v_min_mps
    off_range = max(scenario.v_hw_min_mps - v_end, v_end - scenario.v_hw_max_mps, 0.0)
    off_range = min(off_range / scenario.v_hw_min_mps, 1.0)
    hardest = max(-scenario.a_min_mps2, scenario.a_max_mps2)
    harsh = float(np.add.reduce(np.square(trajectory.a_vut_mps2)) / steps) / hardest**2
    return -(slow + off_range + harsh + (trajectory.end is End.TIMEOUT)) / 4.0
