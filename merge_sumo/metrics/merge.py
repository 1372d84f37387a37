"""The merge and the time after it: bumper gaps, severity, the first conflict, and ways out.

At M both vehicles drive in one lane. The bumper gap is from the front bumper of the one behind to
the rear bumper of the one ahead. The one behind has to brake so that bodies never touch while the
one ahead keeps its speed; it begins after a reaction time. With the gap g and the closing speed w
that is w^2 / (2 (g - w tau)).
"""

from __future__ import annotations

import math
from enum import StrEnum
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from merge_sumo.errors import UserError
from merge_sumo.metrics.bodies import (
    CentreLines,
    encounters,
    gaps_m,
    one_lane_row,
    times_to_collision_s,
)
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import DT_S, VUT, Scenario
from merge_sumo.scenario.trajectory import End, Trajectory

REACTION_S = 0.75
"""tau, from seeing the danger to braking, of the competent and careful driver of UN Regulation No.
157 (`drivers/reference_drivers.py`)."""
STANDS_MPS = 0.1
"""Speed below which a VUT stands."""
HARSH_MPS2 = 3.0
"""The most that a lane change may ask of a vehicle that approaches from behind: UN Regulation
No. 79, 5.6.4.7."""


def gaps_at_m(trajectory: Trajectory) -> tuple[FloatArray, FloatArray]:
    """Return bumper gaps and closing speeds (`gaps_m`) at M; none where the VUT did not merge.

    Args:
        trajectory: the motion.
    """
    at_m = trajectory.motion[-1:] if trajectory.end is End.MERGED else trajectory.motion[:0]
    gap_m, closing_mps = gaps_m(at_m, trajectory.case.scenario.lengths_m)
    return gap_m.ravel(), closing_mps.ravel()


def place_of_merge_m(trajectory: Trajectory) -> float:
    """Return the place where the VUT merges, in m: M, or where it left the acceleration lane.

    Args:
        trajectory: the motion.
    """
    on_road = trajectory.case.scenario.lane_m is not None
    return float(trajectory.x_vut_m[-1]) if on_road else 0.0


def merged_rows(trajectory: Trajectory) -> NDArray[np.bool_]:
    """Return the rows, (T + 1,), of the whole motion in which the VUT has left its lane.

    There are none without an acceleration lane: ramp and mainline have the same lanes after M.

    Args:
        trajectory: the motion.
    """
    after = np.arange(len(trajectory.whole)) >= len(trajectory.motion) - 1
    return after & (trajectory.case.scenario.lane_m is not None and trajectory.end is End.MERGED)


def brakes_needed_mps2(trajectory: Trajectory) -> FloatArray:
    """Return the decelerations that the VUT and each other car need after the merge.

    Args:
        trajectory: the motion.

    Returns:
        Deceleration of the one behind in m/s2, (A - 1,): 0 where it need not brake, and infinite
        where bodies overlap or no braking is in time. Nothing without a merge.
    """
    gap_m, closing_mps = gaps_at_m(trajectory)
    closing_mps = np.maximum(closing_mps, 0.0)
    room_m = gap_m - closing_mps * REACTION_S
    needed_mps2: FloatArray = np.full(len(room_m), math.inf)
    np.divide(np.square(closing_mps), 2.0 * room_m, out=needed_mps2, where=room_m > 0.0)
    return needed_mps2


def brake_after_mps2(trajectory: Trajectory) -> float:
    """Return the largest of `brakes_needed_mps2`, in m/s2.

    Args:
        trajectory: the motion.
    """
    return float(brakes_needed_mps2(trajectory).max(initial=0.0))


class Severity(StrEnum):
    """Classes of encounters, the most severe first; an episode is of the first that fits."""

    CONTACT = "contact"
    CONFLICT = "conflict"
    HARSH = "harsh"
    SAFE = "safe"


def meanings(scenario: Scenario) -> dict[Severity, str]:
    """Return the meaning of each severity in a scenario.

    Args:
        scenario: the scenario.
    """
    soon = f"within {scenario.follow_up_s:g} s after"
    found = {
        Severity.CONTACT: f"bodies overlap before M or {soon} it",
        Severity.CONFLICT: f"front bumpers within {scenario.dx_crash_m:g} m at M, no contact",
        Severity.HARSH: f"a car behind brakes harder than {HARSH_MPS2:g} m/s² {soon} M",
        Severity.SAFE: "none of the other classes",
    }
    if not scenario.follow_up_s:
        del found[Severity.HARSH]
        found[Severity.CONTACT] = "bodies overlap, up to M"
    return {severity: scenario.wording(meaning) for severity, meaning in found.items()}


def check_from(from_s: float | None) -> None:
    """Check the time from which a case is shown.

    Args:
        from_s: the time before the first conflict, in s.

    Raises:
        UserError: it is neither None nor a finite number of 0 or below.
    """
    if from_s is not None and not (isinstance(from_s, int | float) and -1e300 <= from_s <= 0.0):
        raise UserError(f"`from_s` is {from_s!r:.40}: it must be 0 or below, such as -3")


class Conflict(NamedTuple):
    """The first conflict of an episode.

    It is the contact, where bodies first overlap. Else, with the VUT in the lane of the mainline,
    it is the lowest time to collision between bumpers, or the merge. Without a merge it is the end.

    Attributes:
        row: row of the whole motion.
        what: its kind in words, such as "the contact".

    Example:
        >>> Conflict.of(trajectory, lines)
        Conflict(row=81, what='the contact')
    """

    row: int
    what: str

    @classmethod
    def of(cls, trajectory: Trajectory, lines: CentreLines | None) -> Self:
        """Return the first conflict of an episode.

        Args:
            trajectory: the motion.
            lines: centre lines of the road; None to look for a contact from M on only.
        """
        (encounter,) = encounters([trajectory], lines)
        if encounter.row is not None:
            return cls(encounter.row, "the contact")
        merges, whole = one_lane_row(trajectory), trajectory.whole
        if merges == len(whole):
            return cls(merges - 1, "the end of the episode")
        gap_m, closing_mps = gaps_m(whole[merges:], trajectory.case.scenario.lengths_m)
        lowest_s = times_to_collision_s(gap_m, closing_mps).min(axis=1)
        row = int(lowest_s.argmin())
        if np.isinf(lowest_s[row]):
            return cls(merges + row, "the merge" if merges else "the start")
        return cls(merges + row, "the lowest time to collision")

    def begin(self, from_s: float | None) -> tuple[int, list[str]]:
        """Return the row some time before the conflict, and lines that say so.

        Args:
            from_s: time in s, not above 0; None for the first row, without a line.
        """
        if from_s is None:
            return 0, []
        row = round(max(self.row + from_s / DT_S, 0.0))
        before = f"{(self.row - row) * DT_S:g} s before {self.what} at {self.row * DT_S:.1f} s"
        return row, [f"from {row * DT_S:.1f} s, {before}"]


def last_avoidable_s(trajectory: Trajectory) -> float | None:
    """Return the last time, in s, at which the VUT could still avoid a conflict; None without one.

    The POV never moves backwards, so of all ways to arrive at M the first and the last possible
    decide: the VUT passes in front at full acceleration, or waits at full braking. Both are
    simulated from every step of the record at once. On an acceleration lane M is the place where
    the VUT merged. In traffic the VUT has to avoid every car, and does not use gaps between cars.

    Other cars move as recorded, then keep their last speed. The VUT moves by eq. (4), x += v dt and
    v += a dt with v >= 0, so that a decision moves it from the next step on.

    Args:
        trajectory: the motion.
    """
    place_m = place_of_merge_m(trajectory)
    cars, scenario = np.delete(trajectory.motion, VUT, axis=1), trajectory.case.scenario
    steps = np.arange(1, scenario.max_steps + 1)[:, None]
    beyond = steps * (cars[-1, :, 1] * DT_S) + cars[-1, :, 0]
    x_cars = np.concatenate([cars[:, :, 0], beyond])
    starts = np.arange(len(cars) - 1)
    avoidable = np.zeros(len(starts), dtype=bool)
    for acceleration in (scenario.a_max_mps2, scenario.a_min_mps2):
        x, v = trajectory.x_vut_m[:-1].copy(), trajectory.v_vut_mps[:-1].copy()
        driving = np.ones(len(starts), dtype=bool)
        for ahead in range(1, scenario.max_steps + 1):
            x = x + v * DT_S
            v = np.maximum(v + acceleration * DT_S, 0.0)
            arrived = driving & (x >= place_m - 1e-9)  # without the rounding of x
            dx = x_cars[starts[arrived] + ahead] - x[arrived, None]
            avoidable[arrived] |= (np.abs(dx) >= scenario.dx_crash_m).all(axis=1)
            driving &= ~arrived
            if not driving.any():
                break
            if acceleration < 0.0 and not v[driving].any():
                # These stop short of M and can wait there, if the POV moves on.
                avoidable[driving] |= bool((cars[-1, :, 1] > 0.0).all())
                break
    return round(float(starts[avoidable][-1]) * DT_S, 1) if avoidable.any() else None
