"""The motion of all vehicles in one episode."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from merge_sumo.printable import printable
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S, POV, VUT
from merge_sumo.scenario.signals import Signals


class End(StrEnum):
    """Reason of the end of an episode."""

    MERGED = "MERGED"
    TIMEOUT = "TIMEOUT"
    VUT_ERROR = "VUT_ERROR"
    SIM_ERROR = "SIM_ERROR"

    @property
    def is_error(self) -> bool:
        """Whether the VUT or the simulation, to which the POV belongs, failed."""
        return self in (End.VUT_ERROR, End.SIM_ERROR)


REASON_CHARACTERS = 600
"""Maximum length of the reason of an error."""
_ADDRESS = re.compile("0x[0-9a-fA-F]{6,}")


def as_reason(text: str) -> str:
    """Return the reason of an error as records hold it.

    Args:
        text: the message.

    Returns:
        One printable line of at most `REASON_CHARACTERS`, without memory addresses, in which
        records of equal runs would differ.
    """
    without = _ADDRESS.sub("0x...", text[: 2 * REASON_CHARACTERS])
    return printable(without[:REASON_CHARACTERS])[:REASON_CHARACTERS]


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Positions, speeds and accelerations of all vehicles in one episode.

    A motion is an array of shape (T + 1, A, 3):

    - one row for each step of 0.1 s, from t = 0 to the end;
    - A vehicles: POV, VUT and, in traffic, the cars ahead of and behind the POV;
    - x in m, v in m/s and a in m/s2. The acceleration of a row acts until the next row, and is 0 in
      the last row.

    Attributes:
        case: the case.
        motion: motion up to M.
        end: reason of the end. It is MERGED whenever the VUT reached M, also after a contact.
        error: message of an error of the controller or of the simulation; None without an error. If
            `end` is MERGED, the error happened after M.
        clipped_steps: number of steps in which the answer of the VUT was clipped to its limits.
        after: motion after M, from the row of the merge on; None without a follow-up.
        signals: signals of the VUT for each row of `whole`; None without signals.
        in_vain: TraCI commands of the VUT that were accepted without effect.

    Example:
        ```python
        trajectory = run.trajectory(0)
        print(trajectory.x_vut_m[0], trajectory.t_end_s)
        ```
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
        """Return the size and the end of the motion, without its numbers."""
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
        """Positions of the POV in m, (T + 1,)."""
        return self.motion[:, POV, 0]

    @property
    def v_pov_mps(self) -> FloatArray:
        """Speeds of the POV in m/s, (T + 1,)."""
        return self.motion[:, POV, 1]

    @property
    def a_pov_mps2(self) -> FloatArray:
        """Accelerations of the POV in m/s2, (T + 1,)."""
        return self.motion[:, POV, 2]

    @property
    def x_vut_m(self) -> FloatArray:
        """Positions of the VUT in m, (T + 1,)."""
        return self.motion[:, VUT, 0]

    @property
    def v_vut_mps(self) -> FloatArray:
        """Speeds of the VUT in m/s, (T + 1,)."""
        return self.motion[:, VUT, 1]

    @property
    def a_vut_mps2(self) -> FloatArray:
        """Accelerations of the VUT in m/s2, (T + 1,)."""
        return self.motion[:, VUT, 2]

    @property
    def nearest(self) -> int:
        """Index of the car on the mainline that is nearest to the VUT at the end of `motion`."""
        return self.nearest_at(len(self.motion) - 1)

    def nearest_at(self, row: int) -> int:
        """Return the index of the car on the mainline that is nearest to the VUT.

        Args:
            row: row of `whole`.
        """
        x_m = self.whole[row, :, 0]
        apart_m = np.abs(x_m - x_m[VUT])
        apart_m[VUT] = np.inf
        return int(np.argmin(apart_m))

    @property
    def t_end_s(self) -> float:
        """Time of the last row of `motion`, in s."""
        return round((len(self.motion) - 1) * DT_S, 1)


def cut_at(whole: FloatArray, row: int) -> tuple[FloatArray, FloatArray | None]:
    """Split a motion at the merge.

    Args:
        whole: motion of the episode, (T + 1, A, 3).
        row: row of the merge.

    Returns:
        The motion up to the merge, with accelerations of 0 in its last row, and the motion from
        there; None where the episode ends at the merge.
    """
    if len(whole) <= row + 1:
        return whole, None
    motion = whole[: row + 1].copy()
    motion[-1, :, 2] = 0.0
    return motion, whole[row:]
