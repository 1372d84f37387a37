"""The first conflict of an episode: where a person who wants to know why begins to look."""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np

from merge_sumo.errors import UserError
from merge_sumo.metrics.merge import gaps_m
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import DT_S
from merge_sumo.scenario.trajectory import End, Trajectory


def check_from(from_s: float | None) -> None:
    """Raise `UserError` where `from_s` is neither None nor a finite number that is not above 0."""
    if from_s is not None and not (isinstance(from_s, int | float) and -1e300 <= from_s <= 0.0):
        raise UserError(f"`from_s` is {from_s!r:.40}: give a number not above 0, such as -3")


class Conflict(NamedTuple):
    """The row of the first conflict of an episode, and what it is.

    With the VUT in the lane of the mainline it is the contact, where bodies first overlap, else the
    lowest time to collision between bumpers, else the merge. Without a merge it is the end.
    """

    row: int
    what: str

    @classmethod
    def find(cls, motion: FloatArray, merges: int | None, lengths_m: tuple[float, float]) -> Self:
        """Find it in x and v, (T + 1, A, 2), with a VUT in that lane from a row on, or never."""
        if merges is None:
            return cls(len(motion) - 1, "the end of the episode")
        gap_m, closing_mps = gaps_m(motion[merges:], lengths_m)
        ttc_s = np.divide(gap_m, closing_mps, out=gap_m + np.inf, where=closing_mps > 0.0)
        lowest_s = np.where(gap_m <= 0.0, 0.0, ttc_s).min(axis=1)
        row = int(lowest_s.argmin())
        found = {0.0: "the contact", np.inf: "the merge" if merges else "the start"}
        return cls(merges + row, found.get(lowest_s[row], "the lowest time to collision"))

    @classmethod
    def of(cls, trajectory: Trajectory) -> Self:
        """Find it in what happened."""
        scenario = trajectory.case.scenario
        merges = len(trajectory.motion) - 1 if trajectory.end is End.MERGED else None
        in_one_lane = scenario.vut_edges == scenario.pov_edges
        return cls.find(trajectory.whole, 0 if in_one_lane else merges, scenario.lengths_m)

    def begin(self, from_s: float | None) -> tuple[int, list[str]]:
        """Return the row so long before it and that in words; the first one, without, for None."""
        if from_s is None:
            return 0, []
        row = round(max(self.row + from_s / DT_S, 0.0))
        before = f"{(self.row - row) * DT_S:g} s before {self.what} at {self.row * DT_S:.1f} s"
        return row, [f"from {row * DT_S:.1f} s, {before}"]
