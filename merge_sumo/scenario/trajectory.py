"""The motion of all vehicles in one episode."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from merge_sumo.printable import printable
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S, POV, VUT
from merge_sumo.scenario.signals import Signals


class End(StrEnum):
    """Why an episode ended."""

    MERGED = "MERGED"
    TIMEOUT = "TIMEOUT"
    VUT_ERROR = "VUT_ERROR"
    SIM_ERROR = "SIM_ERROR"

    @property
    def is_tested(self) -> bool:
        """Whether the VUT reached the merge point."""
        return self is End.MERGED

    @property
    def is_error(self) -> bool:
        """Whether the VUT or the simulation went wrong; the POV is of the simulation."""
        return self in (End.VUT_ERROR, End.SIM_ERROR)


REASON_CHARACTERS = 600
_ADDRESS = re.compile("0x[0-9a-fA-F]{6,}")


def as_reason(text: str) -> str:
    """Return the reason of an error as records hold it: one printable line, not too long.

    Without memory addresses: they differ from run to run, and records of equal runs must not.
    """
    without = _ADDRESS.sub("0x...", text[: 2 * REASON_CHARACTERS])
    return printable(without[:REASON_CHARACTERS])[:REASON_CHARACTERS]


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Positions, speeds and accelerations of all vehicles in one episode.

    `motion` has shape (T + 1, A, 3): one row per step, from t = 0 to the end of the episode; the
    vehicles POV, VUT and, in traffic, the cars ahead of and behind the POV; their x, v and a in m,
    m/s and m/s2. The acceleration of a step acts from it to the next; it is 0 in the last one.

    Attributes:
        case: the case.
        motion: up to M.
        end: MERGED whenever the VUT arrived at M, also after a contact.
        error: the fault of the VUT or of the simulation; after M in a case that MERGED.
        clipped_steps: number of answers of the VUT that were clipped to its limits.
        after: the motion after M where the scenario has a follow-up, from the row of the merge on.
        signals: those of the VUT for each row of both.
        in_vain: commands of the VUT that were accepted, and changed nothing.
    """

    case: Case
    motion: FloatArray
    end: End
    error: str | None = None
    clipped_steps: int = 0
    after: FloatArray | None = None
    signals: Signals | None = None
    in_vain: tuple[str, ...] = ()

    def __repr__(self) -> str:
        """Return its end in a line: the motion is an array of hundreds of numbers."""
        cars, rows = self.motion.shape[1], len(self.motion)
        return f"<Trajectory: {cars} vehicles, {rows} rows, {self.end} at {self.t_end_s:.1f} s>"

    @property
    def whole(self) -> FloatArray:
        """The motion up to M and after it, (T + 1, A, 3)."""
        if self.after is None:
            return self.motion
        return np.concatenate((self.motion[:-1], self.after))

    @property
    def x_pov_m(self) -> FloatArray:
        """Positions of the POV, (T + 1,)."""
        return self.motion[:, POV, 0]

    @property
    def v_pov_mps(self) -> FloatArray:
        """Speeds of the POV, (T + 1,)."""
        return self.motion[:, POV, 1]

    @property
    def a_pov_mps2(self) -> FloatArray:
        """Accelerations of the POV, (T + 1,), the last one 0."""
        return self.motion[:, POV, 2]

    @property
    def x_vut_m(self) -> FloatArray:
        """Positions of the VUT, (T + 1,)."""
        return self.motion[:, VUT, 0]

    @property
    def v_vut_mps(self) -> FloatArray:
        """Speeds of the VUT, (T + 1,)."""
        return self.motion[:, VUT, 1]

    @property
    def a_vut_mps2(self) -> FloatArray:
        """Accelerations of the VUT, (T + 1,), the last one 0."""
        return self.motion[:, VUT, 2]

    @property
    def nearest(self) -> int:
        """Row of the car of the mainline that is nearest to the VUT at the end."""
        if self.motion.shape[1] == 2:
            return POV
        cars = [row for row in range(self.motion.shape[1]) if row != VUT]
        return min(cars, key=lambda row: abs(self.motion[-1, row, 0] - self.motion[-1, VUT, 0]))

    def with_pov(self, car: int) -> Trajectory:
        """Return the motion up to M of the VUT and one car of the mainline, in the POV's row."""
        return replace(self, motion=self.motion[:, [car, VUT]], after=None)

    @property
    def t_end_s(self) -> float:
        """Time of the last row."""
        return round((len(self.motion) - 1) * DT_S, 1)


def cut_at(whole: FloatArray, row: int) -> tuple[FloatArray, FloatArray | None]:
    """Return the motion up to the row of the merge, and that after it; None where it ends there.

    The acceleration in the last row of a motion is 0.
    """
    if len(whole) <= row + 1:
        return whole, None
    motion = whole[: row + 1].copy()
    motion[-1, :, 2] = 0.0
    return motion, whole[row:]
