"""Controllers whose failures neither the state of a step nor failures nearby foretell.

    merge-sumo campaign --vut tools/held_out_vuts.py:Shell
    python tools/bench_samplers.py --held-out

Choices of a sampler may be made on DEVELOPMENT, and are reported on HELD_OUT, with other seeds. All
act in K corridors at once.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

DT_S = 0.1
ACCELERATION_MPS2 = 1.0
CRUISE_MPS = 28.0
SLOWEST_MPS = 8.0
X_POV0_M = (-340.0, -180.0)
V_POV0_MPS = (25.0, 35.0)
"""What the POV may begin with in `us23`."""


def chance(*numbers: FloatArray) -> FloatArray:
    """Return numbers between 0 and 1 that look like chance, and are the same in every run."""
    mixed = sum(number * scale for number, scale in zip(numbers, (12.9898, 78.233), strict=False))
    return np.asarray((np.sin(mixed) * 43758.5453) % 1.0)


def gap_at_merge(x_pov_m: FloatArray, v_pov_mps: FloatArray, seen: Any) -> FloatArray:
    """Return the gap at M if the POV keeps its speed and the VUT accelerates to 28 m/s.

    The time that the VUT needs for 182 m and less, from 18 m/s and more, is within .1 s.
    """
    v, distance = seen.v_vut_mps, np.maximum(-seen.x_vut_m, 0.0)
    run_up_m = np.maximum(CRUISE_MPS**2 - v**2, 0.0) / (2.0 * ACCELERATION_MPS2)
    speeding = np.sqrt(v**2 + 2.0 * ACCELERATION_MPS2 * np.minimum(distance, run_up_m)) - v
    time_s = speeding / ACCELERATION_MPS2 + np.maximum(distance - run_up_m, 0.0) / CRUISE_MPS
    return np.asarray(x_pov_m + v_pov_mps * time_s)


def profile(v_mps: FloatArray) -> FloatArray:
    """Return the acceleration towards the cruising speed."""
    return np.clip((CRUISE_MPS - v_mps) / DT_S, 0.0, ACCELERATION_MPS2)


class FirstSight(ABC):
    """Decides by what it sees first, of the POV, whether it errs in this case.

    Where it errs, it drives towards a gap of 0 at M; elsewhere towards `keeps_m` or more on the
    side on which the POV would be.
    """

    keeps_m = 14.0

    def __init__(self, corridors: int) -> None:
        """Prepare for K corridors."""
        self.errs = np.zeros(corridors, dtype=bool)

    @abstractmethod
    def erring(self, x: FloatArray, v: FloatArray, gap_m: FloatArray) -> NDArray[np.bool_]:
        """Return where it errs, (K,), by place and speed of the POV in the unit square."""

    def act_batch(self, seen: Any) -> FloatArray:
        """Return accelerations, (K,)."""
        gap = gap_at_merge(seen.x_pov_m, seen.v_pov_mps, seen)
        x = (seen.x_pov_m - X_POV0_M[0]) / (X_POV0_M[1] - X_POV0_M[0])
        v = (seen.v_pov_mps - V_POV0_MPS[0]) / (V_POV0_MPS[1] - V_POV0_MPS[0])
        self.errs = np.where(seen.t_s == 0.0, self.erring(x, v, gap), self.errs)
        side = np.where(gap >= 0.0, 1.0, -1.0)
        keeps = np.where(np.abs(gap) < self.keeps_m, 0.15 * (side * self.keeps_m - gap), 0.0)
        # To be later by a second changes the gap by about the POV's speed.
        wanted = np.where(self.errs, 0.08 * gap, -keeps)
        answer = profile(seen.v_vut_mps) + wanted
        return np.asarray(np.where((answer < 0.0) & (seen.v_vut_mps < SLOWEST_MPS), 0.0, answer))


class Lots(FirstSight):
    """Errs in one case of twelve, by lot."""

    def erring(self, x: FloatArray, v: FloatArray, gap_m: FloatArray) -> NDArray[np.bool_]:
        """Return where it errs, (K,)."""
        return chance(x, v) < 0.08


class Cells(FirstSight):
    """Errs in some cells of a fine table of what it sees first."""

    def erring(self, x: FloatArray, v: FloatArray, gap_m: FloatArray) -> NDArray[np.bool_]:
        """Return where it errs, (K,)."""
        return (chance(np.floor(32.0 * x), np.floor(33.0 * v)) < 0.1) & (gap_m < 60.0)


class Stripes(FirstSight):
    """Errs near the change of order at speeds of the POV that come again every 1.1 m/s."""

    def erring(self, x: FloatArray, v: FloatArray, gap_m: FloatArray) -> NDArray[np.bool_]:
        """Return where it errs, (K,)."""
        return (np.mod(10.0 * v, 1.1) < 0.25) & (np.abs(gap_m) < 25.0)


class Islands(FirstSight):
    """Errs on islands that come again with the speed of the POV, on either side of the change."""

    def erring(self, x: FloatArray, v: FloatArray, gap_m: FloatArray) -> NDArray[np.bool_]:
        """Return where it errs, (K,)."""
        waves = np.sin(2.0 * np.pi * v / 0.08) + np.sin(2.0 * np.pi * gap_m / 30.0)
        return (waves > 1.5) & (np.abs(gap_m) < 45.0)


class Ring(FirstSight):
    """Errs on a thin ring, where the VUT is far ahead."""

    def erring(self, x: FloatArray, v: FloatArray, gap_m: FloatArray) -> NDArray[np.bool_]:
        """Return where it errs, (K,)."""
        return np.abs(np.hypot(x - 0.25, v - 0.35) - 0.2) < 0.012


class Shell(FirstSight):
    """Errs in a thin shell along the change of order, but far from it."""

    def erring(self, x: FloatArray, v: FloatArray, gap_m: FloatArray) -> NDArray[np.bool_]:
        """Return where it errs, (K,)."""
        return np.abs(gap_m + 50.0) < 2.5


class NoisySensors:
    """Keeps its distance by what noisy sensors tell it: each step another error of place and speed.

    It gives way in the last 70 m where the POV would be near, and hurries in the last 25 m where
    the POV is still behind it.
    """

    NOISE_M, NOISE_MPS = 4.0, 1.5

    def __init__(self, corridors: int) -> None:
        """Prepare for K corridors."""

    def act_batch(self, seen: Any) -> FloatArray:
        """Return accelerations, (K,)."""
        first = 2.0 * chance(seen.x_pov_m, seen.x_vut_m) - 1.0
        second = 2.0 * chance(seen.x_vut_m, seen.x_pov_m) - 1.0
        x_pov, v_pov = (
            seen.x_pov_m + self.NOISE_M * first,
            seen.v_pov_mps + self.NOISE_MPS * second,
        )
        gap, distance = gap_at_merge(x_pov, v_pov, seen), -seen.x_vut_m
        yields = (gap > -4.0) & (gap < 14.0) & (distance < 70.0)
        hurries = (gap <= -4.0) & (gap > -14.0) & (distance < 60.0)
        answer = np.where(hurries, 2.0, profile(seen.v_vut_mps))
        return np.asarray(np.where(yields & (seen.v_vut_mps > SLOWEST_MPS), -2.0, answer))


class Slots:
    """Reserves slots of time at M: the slot after the POV's where its own is the POV's.

    Neighbouring slots are taken to be apart, so that it fails where both arrive about a boundary.
    """

    SLOT_S = 2.0

    def __init__(self, corridors: int) -> None:
        """Prepare for K corridors."""

    def act_batch(self, seen: Any) -> FloatArray:
        """Return accelerations, (K,)."""
        v, distance = np.maximum(seen.v_vut_mps, 1.0), np.maximum(-seen.x_vut_m, 0.0)
        due_s = seen.t_s + distance / (0.5 * (v + CRUISE_MPS))
        pov_s = seen.t_s - seen.x_pov_m / np.maximum(seen.v_pov_mps, 1.0)
        same = np.floor(due_s / self.SLOT_S) == np.floor(pov_s / self.SLOT_S)
        waits = same & (distance > 5.0) & (seen.v_vut_mps > SLOWEST_MPS)
        return np.asarray(np.where(waits, -2.0, profile(seen.v_vut_mps)))
