"""The state in which the VUT merges: bodies instead of points, and what those behind must do then.

At M both drive in one lane. The bumper gap is from the front bumper of the one behind to the rear
bumper of the one ahead. The one behind has to brake so that the bodies never touch while the one
ahead keeps its speed; it begins after the time that a driver takes to react. With the gap g and
the closing speed w that is w^2 / (2 (g - w tau)).
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import DT_S, VUT, lane_of
from merge_sumo.scenario.trajectory import End, Trajectory

REACTION_S: Final = 0.75
"""tau: from seeing the danger to braking, as the competent and careful driver of UN Regulation
No. 157 takes (`drivers/reference.py`)."""


STANDS_MPS: Final = 0.1
"""A slower VUT stands."""
HARSH_MPS2: Final = 3.0
"""The most that a lane change may ask of a vehicle that approaches from behind: UN Regulation
No. 79, 5.6.4.7."""


def neighbours(trajectory: Trajectory) -> list[tuple[float, float]]:
    """Return the bumper gap, in m, and the closing speed, in m/s, at M for each mainline car.

    The gap is negative where bodies overlap, the closing speed where the gap opens. Empty where the
    VUT did not merge.
    """
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


def place_of_merge_m(trajectory: Trajectory) -> float:
    """Return where the VUT merges: at M, or where it left the acceleration lane."""
    on_road = lane_of(trajectory.case.scenario) is not None
    return float(trajectory.x_vut_m[-1]) if on_road else 0.0


def merged_rows(trajectory: Trajectory) -> NDArray[np.bool_]:
    """Return the rows, (T + 1,), of the whole motion in which the VUT has left its lane.

    There are none without an acceleration lane: ramp and mainline have the same lanes behind M.
    """
    merged = np.zeros(len(trajectory.whole), dtype=np.bool_)
    leaves = lane_of(trajectory.case.scenario) is not None and trajectory.end is End.MERGED
    merged[len(trajectory.motion) - 1 :] = leaves
    return merged


def on_lane(trajectory: Trajectory) -> dict[str, float | None]:
    """Return the measures of a merge from an acceleration lane by name; none without a lane.

    The place of the merge and its share of the lane, the bumper gaps and time gaps to the cars
    ahead of and behind the VUT at that moment, and for how long it stood on the lane.
    """
    scenario, lane_m = trajectory.case.scenario, lane_of(trajectory.case.scenario)
    if lane_m is None:
        return {}
    before = trajectory.motion[:, VUT]
    stands = (before[:, 0] >= lane_m[0]) & (before[:, 1] < STANDS_MPS)
    found: dict[str, float | None] = {"stood_s": round(DT_S * int(stands.sum()), 1)}
    if trajectory.end is not End.MERGED:
        return found
    x_vut, v_vut = trajectory.motion[-1, VUT, :2].tolist()
    found |= {"x_merge_m": x_vut, "lane_share": (x_vut - lane_m[0]) / (lane_m[1] - lane_m[0])}
    cars = np.delete(trajectory.motion[-1], VUT, axis=0)[:, :2].tolist()
    ahead = [x - x_vut - scenario.pov_length_m for x, _ in cars if x >= x_vut]
    behind = [(x_vut - x - scenario.vut_length_m, v) for x, v in cars if x < x_vut]
    if ahead:
        found["gap_ahead_m"] = min(ahead)
        found["time_gap_ahead_s"] = min(ahead) / v_vut if v_vut > 0.0 else None
    if behind:
        gap_m, v_mps = min(behind)
        found["gap_behind_m"] = gap_m
        found["time_gap_behind_s"] = gap_m / v_mps if v_mps > 0.0 else None
    return found


def brake_after_mps2(trajectory: Trajectory) -> float:
    """Return the deceleration, in m/s2, that somebody needs after the merge.

    0 where nobody has to brake or the VUT never merged, infinite where bodies overlap or no braking
    is in time. In traffic it is the largest that any car or the VUT needs.
    """
    needed_mps2 = [0.0]
    for gap_m, closing_mps in neighbours(trajectory):
        room_m = gap_m - max(closing_mps, 0.0) * REACTION_S
        if room_m <= 0.0:
            return math.inf
        needed_mps2.append(max(closing_mps, 0.0) ** 2 / (2.0 * room_m))
    return max(needed_mps2)


def closest_after_m(trajectory: Trajectory) -> tuple[float, float | None]:
    """Return the smallest clearance from M on, in m, and the speed of the first contact, in m/s.

    Both are of the motion: at M, and in the follow-up where the scenario has one. The clearance is
    infinite without a merge, the speed None without a contact.
    """
    if trajectory.end is not End.MERGED:
        return math.inf, None
    after = trajectory.motion[-1:] if trajectory.after is None else trajectory.after
    gap_m, closing_mps = gaps_m(after, trajectory.case.scenario.lengths_m)
    touching = np.argwhere(gap_m <= 0.0)
    if not len(touching):
        return float(gap_m.min()), None
    first = gap_m[touching[0, 0]] <= 0.0
    return float(gap_m.min()), float(np.abs(closing_mps[touching[0, 0]][first]).max())


def braked_after_mps2(trajectory: Trajectory) -> float | None:
    """Return the hardest braking behind M, in m/s2, of those that are behind another there.

    They are the cars behind the VUT at M, and the VUT itself where the nearest car is ahead of it.
    None without a follow-up.
    """
    if trajectory.after is None:
        return None
    x_m = trajectory.after[0, :, 0]
    is_behind = x_m < x_m[VUT]
    is_behind[VUT] = x_m[trajectory.nearest] > x_m[VUT]
    return max(0.0, -float(trajectory.after[:, is_behind, 2].min(initial=0.0)))


def gaps_m(after: FloatArray, lengths_m: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    """Return the bumper gaps and closing speeds, (T, A - 1), of x and v in one lane, (T, A, 2)."""
    cars, vut = np.delete(after, VUT, axis=1), after[:, [VUT]]
    dx, dv = ((cars - vut)[:, :, column] for column in (0, 1))
    length_m = np.where(dx >= 0.0, *lengths_m)
    return np.abs(dx) - length_m, np.where(dx >= 0.0, -dv, dv)


def followed_up(trajectory: Trajectory) -> tuple[float, float, float] | None:
    """Return the least bumper gap, the lowest time to collision and the hardest braking behind M.

    In m, s and m/s2, at any step of the follow-up and with any car; None where there was none. The
    time to collision is between bumpers, infinite where the gap never closes and 0 where bodies
    touch; the braking is the DRAC (Cooper and Ferguson, 1976), infinite where they touch.
    """
    if trajectory.after is None:
        return None
    gap_m, closing_mps = gaps_m(trajectory.after, trajectory.case.scenario.lengths_m)
    least_m = float(gap_m.min())
    if least_m <= 0.0:
        return least_m, 0.0, math.inf
    closes = closing_mps > 0.0
    if not closes.any():
        return least_m, math.inf, 0.0
    gap_m, closing_mps = gap_m[closes], closing_mps[closes]
    hardest_mps2 = float((np.square(closing_mps) / (2.0 * gap_m)).max())
    return least_m, float((gap_m / closing_mps).min()), hardest_mps2
