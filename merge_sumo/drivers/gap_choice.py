"""A rule-based VUT for acceleration lanes: it merges into the first gap that is long enough."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.base import MERGE, NO_WISH, STAY, BuiltInVut, Design, Scene
from merge_sumo.drivers.lane import acc_mps2, stopping_mps
from merge_sumo.drivers.level0 import Level0Vut
from merge_sumo.errors import UserError
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S, US23, VUT

END_MARGIN_M: Final = 1.0
"""It stands so far before the end of the lane."""
FREE_M: Final = 1e6
"""A leader that is farther is none."""


@dataclass(frozen=True, kw_only=True, slots=True)
class GapChoice(Design):
    """Parameters of a VUT that chooses a gap.

    Attributes:
        headway_s: the least time gaps, ahead and behind, of a gap that it accepts.
        brake_mps2: deceleration with which it comes to a stand before the lane's end, positive.
    """

    headway_s: float = 0.8
    brake_mps2: float = 3.0

    def __post_init__(self) -> None:
        Design.__post_init__(self)
        if self.brake_mps2 == 0.0:
            raise UserError("brake_mps2 is 0: a VUT that cannot brake comes to no stand")


HEADWAY: Final = GapChoice()


class GapChoiceVut(Level0Vut):
    """Drives the level-0 profile along the acceleration lane, and merges into the first gap.

    A time gap is the distance from bumper to bumper, over the speed of the car behind. The VUT
    wishes to merge where, in the next step, the time gaps to the car ahead of it and to the car
    behind it are both at least `headway_s`; their positions in that step follow from eq. (4).
    Without such a gap it goes on, no faster than a speed from which `brake_mps2` stops it before
    the lane's end, and waits there. On the mainline it drives the level-0 profile, and follows the
    car ahead no closer than ACC does. Where there is no lane it is the level-0 VUT.
    """

    def __init__(self, corridors: int, choice: GapChoice = HEADWAY) -> None:
        """Prepare a controller with these parameters for each corridor."""
        super().__init__(corridors)
        self.choice = choice
        self._lane_m = np.zeros((2, corridors))
        """Begins and ends of the lanes; 0 and 0 without one."""
        self._pov_length_m = np.full(corridors, US23.pov_length_m)
        self._vut_length_m = np.full(corridors, US23.vut_length_m)
        self._before_mps: FloatArray | None = None
        """Speeds of all vehicles a step ago, (A, K)."""
        self._wishes = np.full(corridors, NO_WISH, dtype=np.int8)

    def begin(self, corridor: int, case: Case) -> None:
        """Take the profile, the lane and the lengths of the case's scenario."""
        super().begin(corridor, case)
        scenario = case.scenario
        self._lane_m[:, corridor] = scenario.lane_m or (0.0, 0.0)
        self._pov_length_m[corridor] = scenario.pov_length_m
        self._vut_length_m[corridor] = scenario.vut_length_m
        if self._before_mps is not None:
            self._before_mps[:, corridor] = [v_mps for _, v_mps in case.starts()]

    def act(self, scene: Scene) -> FloatArray:
        """Return the acceleration in each corridor, and take the wishes."""
        begin_m, end_m = self._lane_m
        on_lane = np.zeros(self.corridors, np.bool_) if scene.merged is None else ~scene.merged
        on_lane &= begin_m < end_m
        next_m = scene.x_m + scene.v_mps * DT_S
        merges = on_lane & (next_m[VUT] >= begin_m) & self._accepts(next_m, scene.v_mps)
        self._wishes = np.where(merges, MERGE, np.where(on_lane, STAY, NO_WISH)).astype(np.int8)
        answer = super().act(scene)
        stays = on_lane & ~merges
        stopping = stopping_mps(end_m - END_MARGIN_M - next_m[VUT], self.choice.brake_mps2)
        slower = np.minimum(answer, (stopping - scene.v_vut_mps) / DT_S)
        answer = np.where(stays, slower, answer)
        if scene.merged is not None:
            follows = (scene.merged | merges) & (begin_m < end_m)
            answer = np.where(follows, np.minimum(answer, self._following_mps2(scene)), answer)
        self._before_mps = scene.v_mps.copy()
        return answer

    def _accepts(self, x_m: FloatArray, v_mps: FloatArray) -> NDArray[np.bool_]:
        """Return the corridors in which both time gaps suffice in states, (A, K): (K,)."""
        others, headway_s = np.arange(len(x_m)) != VUT, self.choice.headway_s
        x_other, v_other = x_m[others], v_mps[others]
        ahead = x_other - self._pov_length_m - x_m[VUT] >= headway_s * v_mps[VUT]
        behind = x_m[VUT] - self._vut_length_m - x_other >= headway_s * v_other
        gap: NDArray[np.bool_] = np.where(x_other >= x_m[VUT], ahead, behind).all(axis=0)
        return gap

    def _following_mps2(self, scene: Scene) -> FloatArray:
        """Return the acceleration of ACC behind the car ahead, (K,)."""
        ahead_m = scene.x_m - scene.x_vut_m
        ahead_m[VUT] = -1.0
        ahead_m = np.where(ahead_m >= 0.0, ahead_m, FREE_M)
        leader, places = ahead_m.argmin(axis=0), np.arange(self.corridors)
        before = scene.v_mps if self._before_mps is None else self._before_mps
        v_leader = scene.v_mps[leader, places]
        a_leader = (v_leader - before[leader, places]) / DT_S
        gap_m = ahead_m[leader, places] - self._pov_length_m
        following = acc_mps2(gap_m, scene.v_vut_mps, v_leader, a_leader, self.v_cruise_mps)
        return np.where(ahead_m[leader, places] < FREE_M, following, np.inf)


VUTS: Final = {"gap": BuiltInVut(GapChoiceVut, HEADWAY, ramp_only=True)}
