"""Contacts of the bodies of cars, and their clearance before M, where two lanes run together.

A body is a rectangle whose front and rear bumpers are on the centre line of its lane. The clearance
of two bodies is their distance; where they overlap, it is negative, and its size is how far one of
them would have to move aside. It is the largest separation along their four axes (the separating
axis theorem; Ericson, 2005, section 5.2.1), every 0.1 s. In one lane it is the gap between bumpers,
where that is less.

A contact is the first step in which a clearance is 0 or less. Its speed is that of the one body
relative to the other, in the plane: lanes meet at an angle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import VUT, Scenario
from merge_sumo.scenario.trajectory import End, Trajectory

WIDTH_M = 1.8
"""Width of every car."""
TOUCHING_M = WIDTH_M + 0.5
"""Distance of centre lines below which bodies may touch; in a bend they stand out of line."""
LOOKED_AT_M = 300.0
"""Length before M in which the lanes are searched for where they run together."""
SPACING_M = 0.25
"""Distance of the points that are compared."""


@dataclass(frozen=True, slots=True)
class CentreLines:
    """The centre lines of both paths in the plane.

    Attributes:
        mainline: lane coordinate, x and y of points, (n, 3), in m; the lane coordinate ascends and
            is 0 at M.
        ramp: the same of the ramp.
        together_m: distance before M from which on bodies on the lines may touch.
    """

    mainline: FloatArray
    ramp: FloatArray
    together_m: float

    @classmethod
    def of(cls, mainline: FloatArray, ramp: FloatArray) -> CentreLines:
        """Return the lines of two paths, with the place from which they run together.

        Args:
            mainline: lane coordinate, x and y of points, (n, 3), in m.
            ramp: the same of the ramp.
        """
        along_m = -np.arange(0.0, LOOKED_AT_M, SPACING_M)
        places = _at(ramp, along_m)[:, None] - _at(mainline, along_m)[None]
        apart = np.linalg.norm(places, axis=2).min(axis=1) >= TOUCHING_M
        steps = int(np.argmax(apart)) if apart.any() else len(apart)
        return cls(mainline, ramp, SPACING_M * steps)


ONE_LANE = CentreLines(*2 * (np.array([[-1e4, -1e4, 0.0], [1e4, 1e4, 0.0]]),), -math.inf)
"""Centre lines of an unknown road: one straight lane, from M on."""


class Encounter(NamedTuple):
    """How near the VUT comes to the cars of the mainline.

    Attributes:
        before_m: smallest clearance before M, where the lanes run together, in m; infinite where
            the VUT never came there.
        overlap_m: smallest clearance of an episode with a contact, else infinite.
        row: row of the whole motion at which the contact begins; None without one.
        impact_mps: relative speed there.
    """

    before_m: float = math.inf
    overlap_m: float = math.inf
    row: int | None = None
    impact_mps: float | None = None


NONE_MET = Encounter()


def encounters(trajectories: Sequence[Trajectory], lines: CentreLines | None) -> list[Encounter]:
    """Return the encounters of motions of one scenario.

    They are computed together, because most of the time of one is the calls of numpy.

    Args:
        trajectories: the motions.
        lines: centre lines of the road; None to look from M on only.
    """
    if not trajectories:
        return []
    lines = lines or ONE_LANE
    rows, merged, motions = [], [], []
    for trajectory in trajectories:
        whole, merge = trajectory.whole, one_lane_row(trajectory)
        together = whole[:, VUT, 0] > -lines.together_m
        rows.append(np.flatnonzero(together | (np.arange(len(whole)) >= merge)))
        motions.append(whole[rows[-1]])
        merged.append(rows[-1] >= merge)
    scenario, motion = trajectories[0].case.scenario, np.concatenate(motions)
    apart = _apart(scenario, motion, np.concatenate(merged), lines)
    x_m, ends = motion[:, VUT, 0], np.cumsum(list(map(len, rows)))[:-1]
    before = np.split((x_m > -lines.together_m) & (x_m < 0.0), ends)
    return list(map(_encounter, rows, before, np.split(apart, ends, axis=1)))


def one_lane_row(trajectory: Trajectory) -> int:
    """Return the first row of the whole motion with all vehicles in one lane; its end if in none.

    Args:
        trajectory: the motion.
    """
    scenario, merges = trajectory.case.scenario, trajectory.end is End.MERGED
    if scenario.ramp == scenario.mainline:
        return 0
    return len(trajectory.motion) - 1 if merges else len(trajectory.motion)


def gaps_m(after: FloatArray, lengths_m: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    """Return the bumper gaps and closing speeds of the VUT and each other car in one lane.

    Args:
        after: x and v of all vehicles, (T, A, 2) or more columns, in m and m/s.
        lengths_m: lengths of a car of the mainline and of the VUT.

    Returns:
        Gaps, negative where bodies overlap, and speeds, negative where gaps open: (T, A - 1) each.
    """
    apart = np.delete(after, VUT, axis=1) - after[:, [VUT]]
    dx, dv = apart[:, :, 0], apart[:, :, 1]
    length_m = np.where(dx >= 0.0, *lengths_m)
    return np.abs(dx) - length_m, np.where(dx >= 0.0, -dv, dv)


def times_to_collision_s(gap_m: FloatArray, closing_mps: FloatArray) -> FloatArray:
    """Return gaps over closing speeds, in s; infinite where no gap closes.

    Args:
        gap_m: gaps, of any shape.
        closing_mps: closing speeds, of the same shape.
    """
    return np.divide(gap_m, closing_mps, out=gap_m + np.inf, where=closing_mps > 0.0)


def _apart(
    scenario: Scenario, motion: FloatArray, merged: NDArray[np.bool_], lines: CentreLines
) -> FloatArray:
    """Return clearance and relative speed of the VUT and each other car, (2, T, A - 1)."""
    x_m, length_m = motion[:, VUT, 0], scenario.vut_length_m
    ends = _ends(lines.ramp, x_m, length_m)
    if scenario.lane_m is not None:
        ends[:, merged] = _ends(lines.mainline, x_m[merged], length_m)
    vut = _Bodies(ends, motion[:, VUT, 1], length_m)
    gap_m, _ = gaps_m(motion, scenario.lengths_m)
    gap_m[~merged] = np.inf
    apart, length_m = np.stack((gap_m, gap_m)), scenario.pov_length_m
    for place, (x_m, v_mps, _) in enumerate(np.delete(motion, VUT, axis=1).transpose(1, 2, 0)):
        car = _Bodies(_ends(lines.mainline, x_m, length_m), v_mps, length_m)
        apart[0, :, place] = np.minimum(_separation_m(vut, car), gap_m[:, place])
        apart[1, :, place] = np.linalg.norm(car.v_mps - vut.v_mps, axis=1)
    return apart


def _encounter(rows: NDArray[np.intp], before: NDArray[np.bool_], apart: FloatArray) -> Encounter:
    clearance_m, v_mps = apart
    before_m, touching = float(clearance_m[before].min(initial=math.inf)), clearance_m <= 0.0
    if not touching.any():
        return Encounter(before_m)
    first = touching.any(axis=1).argmax()
    impact_mps = float(v_mps[first, touching[first]].max())
    return Encounter(before_m, float(clearance_m.min()), int(rows[first]), impact_mps)


def _at(line: FloatArray, along_m: FloatArray) -> FloatArray:
    """Return the places, (n, 2), of lane coordinates, (n,)."""
    return np.column_stack([np.interp(along_m, line[:, 0], line[:, axis]) for axis in (1, 2)])


def _ends(line: FloatArray, front_m: FloatArray, length_m: float) -> FloatArray:
    """Return the places of front and rear bumpers, (2, n, 2)."""
    return np.stack((_at(line, front_m), _at(line, front_m - length_m)))


class _Bodies:
    """A body at n moments: centre, heading and velocity, (n, 2), and half its length and width."""

    def __init__(self, ends: FloatArray, v_mps: FloatArray, length_m: float) -> None:
        chord = ends[0] - ends[1]
        self.heading = chord / np.maximum(np.linalg.norm(chord, axis=1), 1e-9)[:, None]
        self.aside = np.column_stack([-self.heading[:, 1], self.heading[:, 0]])
        self.centre = ends[0] - 0.5 * length_m * self.heading
        self.v_mps = v_mps[:, None] * self.heading
        self._half_length_m = 0.5 * length_m

    def reach_m(self, axis: FloatArray) -> FloatArray:
        """Return how far the body reaches from its centre along unit vectors, (n, 2)."""
        along, across = ((axis * side).sum(axis=1) for side in (self.heading, self.aside))
        reach = self._half_length_m * np.abs(along) + 0.5 * WIDTH_M * np.abs(across)
        return np.asarray(reach, dtype=np.float64)


def _separation_m(a: _Bodies, b: _Bodies) -> FloatArray:
    """Return the clearance of two bodies at n moments, (n,)."""
    apart = b.centre - a.centre
    along = [
        np.abs((apart * axis).sum(axis=1)) - a.reach_m(axis) - b.reach_m(axis)
        for axis in (a.heading, a.aside, b.heading, b.aside)
    ]
    return np.asarray(np.max(along, axis=0), dtype=np.float64)
