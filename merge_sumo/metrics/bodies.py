"""Clearance of the bodies of cars before M, where two lanes already run together.

A body is a rectangle whose front and rear bumpers are on the centre line of its lane. The clearance
of two bodies is their distance; where they overlap, it is negative, and its size is how far one of
them would have to move aside. It is the largest separation along their four axes (the separating
axis theorem; Ericson, 2005, section 5.2.1), every 0.1 s.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import VUT
from merge_sumo.scenario.trajectory import Trajectory

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


def closest_before_m(trajectories: Sequence[Trajectory], lines: CentreLines) -> list[float]:
    """Return the smallest clearance of the VUT and a car of the mainline before M, in m.

    Episodes are computed together, because most of the time of one is the calls of numpy.

    Args:
        trajectories: the motions, of one scenario.
        lines: centre lines of the road.

    Returns:
        A clearance for each motion, over the steps in which the VUT is where the lanes run
        together; infinite where it never came there.
    """
    closest_m, parts, places = [math.inf] * len(trajectories), [], []
    for place, trajectory in enumerate(trajectories):
        x_vut_m = trajectory.motion[:, VUT, 0]
        steps = np.flatnonzero((x_vut_m > -lines.together_m) & (x_vut_m < 0.0))
        if steps.size:
            # One row for each step and car: x of the car and of the VUT.
            cars = np.delete(trajectory.motion[steps, :, 0], VUT, axis=1)
            own = np.broadcast_to(x_vut_m[steps, None], cars.shape)
            parts.append(np.stack((cars.ravel(), own.ravel()), axis=1))
            places.append(place)
    if not parts:
        return closest_m
    x_car_m, x_vut_m = np.concatenate(parts).T
    car_length_m, vut_length_m = trajectories[0].case.scenario.lengths_m
    vut = _Bodies(lines.ramp, x_vut_m, vut_length_m)
    apart_m = _separation_m(vut, _Bodies(lines.mainline, x_car_m, car_length_m))
    firsts = np.cumsum([0, *(len(part) for part in parts[:-1])])
    smallest_m = np.minimum.reduceat(apart_m, firsts).tolist()
    for place, clearance_m in zip(places, smallest_m, strict=True):
        closest_m[place] = clearance_m
    return closest_m


def _at(line: FloatArray, along_m: FloatArray) -> FloatArray:
    """Return the places, (n, 2), of lane coordinates, (n,)."""
    return np.column_stack([np.interp(along_m, line[:, 0], line[:, axis]) for axis in (1, 2)])


class _Bodies:
    """A body at n moments: its centre and heading, (n, 2), and half its length and width."""

    def __init__(self, line: FloatArray, front_m: FloatArray, length_m: float) -> None:
        front, rear = _at(line, front_m), _at(line, front_m - length_m)
        chord = front - rear
        self.heading = chord / np.maximum(np.linalg.norm(chord, axis=1), 1e-9)[:, None]
        self.aside = np.column_stack([-self.heading[:, 1], self.heading[:, 0]])
        self.centre = front - 0.5 * length_m * self.heading
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
