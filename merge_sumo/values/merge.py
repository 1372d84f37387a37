"""The state in which the VUT merges: bodies instead of points, and what those behind must do then.

At M both drive in one lane. The bumper gap is from the front bumper of the one behind to the rear
bumper of the one ahead. The one behind has to brake so that the bodies never touch while the one
ahead keeps its speed; it begins after the time that a driver takes to react. With the gap g and
the closing speed w that is w^2 / (2 (g - w tau)).
"""

from __future__ import annotations

import math
from enum import StrEnum
from typing import Final

import numpy as np

from merge_sumo.values.scenario import VUT
from merge_sumo.values.trajectory import End, Trajectory

REACTION_S: Final = 0.75
"""tau: from seeing the danger to braking, as the competent and careful driver of UN Regulation
No. 157 takes (`drivers/reference.py`)."""


HARSH_MPS2: Final = 3.0
"""The most that a lane change may ask of a vehicle that approaches from behind: UN Regulation
No. 79, 5.6.4.7."""


class AfterMerge(StrEnum):
    """What the merge asks of whoever is behind then: nothing, harsh braking, or too much."""

    NONE = "none"
    HARSH = "harsh"
    FORCED = "forced"


def after_merge(trajectory: Trajectory) -> AfterMerge | None:
    """Return what the merge asks of whoever is behind; None where the VUT did not merge.

    Harsh is more than 3 m/s2, forced more than the vehicles of the scenario can: the bodies touch,
    or the one ahead has to give way.
    """
    if trajectory.end is not End.MERGED:
        return None
    needed = brake_after_mps2(trajectory)
    if needed > -trajectory.case.scenario.a_min_mps2:
        return AfterMerge.FORCED
    return AfterMerge.HARSH if needed > HARSH_MPS2 else AfterMerge.NONE


def bumper_gap_m(trajectory: Trajectory) -> float:
    """Return the smallest bumper gap at M, negative where bodies overlap; infinite without a merge.

    In traffic it is that to the nearest body of the mainline.
    """
    return min((gap for gap, _ in _neighbours(trajectory)), default=math.inf)


def brake_after_mps2(trajectory: Trajectory) -> float:
    """Return the deceleration, in m/s2, that somebody needs after the merge.

    0 where nobody has to brake or the VUT never merged, infinite where bodies overlap or no braking
    is in time. In traffic it is the largest that any car or the VUT needs.
    """
    return max((_needed_mps2(*pair) for pair in _neighbours(trajectory)), default=0.0)


def followed_up(trajectory: Trajectory) -> tuple[float, float, float] | None:
    """Return the least bumper gap, the lowest time to collision and the hardest braking behind M.

    In m, s and m/s2, at any step of the follow-up and with any car; None where there was none. The
    time to collision is between bumpers, infinite where the gap never closes and 0 where bodies
    touch; the braking is the DRAC (Cooper and Ferguson, 1976), infinite where they touch.
    """
    if trajectory.after is None:
        return None
    scenario = trajectory.case.scenario
    cars, vut = np.delete(trajectory.after, VUT, axis=1), trajectory.after[:, [VUT]]
    dx, dv = ((cars - vut)[:, :, column] for column in (0, 1))
    length_m = np.where(dx >= 0.0, scenario.pov_length_m, scenario.vut_length_m)
    gap_m, closing_mps = np.abs(dx) - length_m, np.where(dx >= 0.0, -dv, dv)
    least_m = float(gap_m.min())
    if least_m <= 0.0:
        return least_m, 0.0, math.inf
    closes = closing_mps > 0.0
    if not closes.any():
        return least_m, math.inf, 0.0
    gap_m, closing_mps = gap_m[closes], closing_mps[closes]
    hardest_mps2 = float((np.square(closing_mps) / (2.0 * gap_m)).max())
    return least_m, float((gap_m / closing_mps).min()), hardest_mps2


def _neighbours(trajectory: Trajectory) -> list[tuple[float, float]]:
    """Return the bumper gap and the closing speed at M of the VUT and each car of the mainline."""
    if trajectory.end is not End.MERGED:
        return []
    scenario, last = trajectory.case.scenario, trajectory.motion[-1]
    x_vut, v_vut = last[VUT, :2].tolist()
    found = []
    for row, (x, v, _) in enumerate(last.tolist()):
        if row == VUT:
            continue
        if x >= x_vut:
            found.append((x - x_vut - scenario.pov_length_m, v_vut - v))
        else:
            found.append((x_vut - x - scenario.vut_length_m, v - v_vut))
    return found


def _needed_mps2(gap_m: float, closing_mps: float) -> float:
    if gap_m <= 0.0:
        return math.inf
    if closing_mps <= 0.0:
        return 0.0
    room_m = gap_m - closing_mps * REACTION_S
    return closing_mps**2 / (2.0 * room_m) if room_m > 0.0 else math.inf
