"""A rule-based VUT for acceleration lanes, which merges into the first gap that is long enough."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.acceleration_lane import stopping_mps
from merge_sumo.drivers.base import MERGE, NO_REQUEST, STAY, BuiltInVut, Design, Scene
from merge_sumo.drivers.car_following import acc_mps2, car_ahead
from merge_sumo.drivers.level0 import Level0Vut
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import BEHIND, DT_S, VUT

END_MARGIN_M = 1.0
"""Distance before the end of the lane at which it stops."""


@dataclass(frozen=True, kw_only=True, slots=True)
class GapChoiceDesign(Design):
    """Parameters of a VUT that chooses a gap.

    Attributes:
        headway_s: least time gaps, ahead and behind, of a gap that it accepts.
        brake_mps2: deceleration with which it stops before the end of the lane, positive.
    """

    headway_s: float = 0.8
    brake_mps2: float = 3.0


DESIGN = GapChoiceDesign()


class GapChoiceVut(Level0Vut):
    """A VUT that drives the level-0 profile along the lane and merges into the first gap.

    A time gap is the distance from bumper to bumper, over the speed of the following car. The VUT
    requests a merge where, in the next step by eq. (4), the time gaps to the car ahead of it and to
    the car behind it are both at least `headway_s`. Without such a gap it keeps a speed from which
    `brake_mps2` stops it before the end of the lane, and waits there. On the mainline it drives the
    level-0 profile, and follows the car ahead no closer than ACC. Without a lane it is the level-0
    VUT.

    Example:
        driver = GapChoiceVut(corridors=1, design=GapChoiceDesign(headway_s=1.2))

    Attributes:
        design: the parameters.
    """

    def __init__(self, corridors: int, design: GapChoiceDesign = DESIGN) -> None:
        """Begin without requests in all corridors.

        Args:
            corridors: number of corridors, K.
            design: the parameters.
        """
        super().__init__(corridors)
        self.design = design
        self._before_mps = np.zeros((BEHIND + 1, corridors))
        """Speeds of the vehicles a step ago, by row and corridor."""

    def begin(self, corridor: int, case: Case) -> None:
        """Take the speeds at the start of a case.

        Args:
            corridor: index of the corridor.
            case: the case of the next episode.
        """
        super().begin(corridor, case)
        for row, (_, v_mps) in enumerate(case.starts()):
            self._before_mps[row, corridor] = v_mps

    def act(self, scene: Scene) -> FloatArray:
        """Return the acceleration in each corridor, (K,), and make the merge requests.

        Args:
            scene: the present state.
        """
        answer = super().act(scene)
        if self.scenario.lane_m is None or scene.merged is None:
            self._merge_requests = np.full(self.corridors, NO_REQUEST, dtype=np.int8)
            return answer
        begin_m, end_m = self.scenario.lane_m
        on_lane = ~scene.merged
        next_m = scene.x_m + scene.v_mps * DT_S
        merges = on_lane & (next_m[VUT] >= begin_m) & self._accepts(next_m, scene.v_mps)
        stays = on_lane & ~merges
        self._merge_requests = np.select([merges, stays], [MERGE, STAY], NO_REQUEST).astype(np.int8)
        stopping = stopping_mps(end_m - END_MARGIN_M - next_m[VUT], self.design.brake_mps2)
        slower = np.minimum(answer, (stopping - scene.v_vut_mps) / DT_S)
        follows = np.minimum(answer, self._following_mps2(scene))
        self._before_mps[: len(scene.v_mps)] = scene.v_mps
        return np.where(stays, slower, follows)

    def _accepts(self, x_m: FloatArray, v_mps: FloatArray) -> NDArray[np.bool_]:
        """Return whether both time gaps suffice in states, (A, K): (K,)."""
        headway_s = self.design.headway_s
        ahead = x_m - self.scenario.pov_length_m - x_m[VUT] >= headway_s * v_mps[VUT]
        behind = x_m[VUT] - self.scenario.vut_length_m - x_m >= headway_s * v_mps
        suffices = np.where(x_m >= x_m[VUT], ahead, behind)
        suffices[VUT] = True
        return np.asarray(suffices.all(axis=0))

    def _following_mps2(self, scene: Scene) -> FloatArray:
        """Return the acceleration of ACC behind the car ahead, (K,)."""
        ahead_m, leader = car_ahead(scene.x_m)
        v_leader = scene.v_mps[leader]
        a_leader = (v_leader - self._before_mps[leader]) / DT_S
        is_free = np.isinf(ahead_m)
        gap_m = np.where(is_free, 1e6, ahead_m) - self.scenario.pov_length_m
        v_desired = self.scenario.level0_v_mps
        following = acc_mps2(gap_m, scene.v_vut_mps, v_leader, a_leader, v_desired)
        return np.where(is_free, np.inf, following)


VUTS = {"gap": BuiltInVut(GapChoiceVut, DESIGN, ramp_only=True)}
