"""Reference drivers: published models of how a careful car avoids a collision, moved to a merge.

The models are of rear-end conflicts: a car ahead cuts in, or brakes, and the one behind has to
react. UN Regulation No. 157 covers cut-ins on a lane; the transposition to merging is ours, and no
claim of compliance follows from it. It is the same for all of them:

- The conflict is where the lanes meet. A driver foresees the two at M, the VUT on the scenario's
  level-0 profile and the other at its speed. Whoever is ahead there has cut in, the other follows:
  the gap is |dx| at M less `dx_crash_m`, the speeds are those at M.
- A model says of gap and speeds how hard to brake; 0 is "no risk". It does so whether the VUT
  would lead or follow: who merges must neither run into a car nor make one run into it.
- Without risk the VUT drives the level-0 profile. A risk is perceived after the perception time;
  then, for the reaction time, the VUT holds its speed; then it brakes as the model says, by its
  jerk, and no harder than the scenario lets it. By eq. (4) a braking moves the vehicle one step
  later: that step is the last of the reaction time. Who has reacted stays alert.
- To give way is to fall behind. Where braking as hard as it can does not get the VUT behind the
  other any more, it goes on.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.base import Scene
from merge_sumo.drivers.level0 import Level0Vut, level0_time_to
from merge_sumo.values.case import Case, FloatArray
from merge_sumo.values.scenario import DT_S, US23

JERK_MPS3: Final = 12.65
"""UN R157, Annex 3, Appendix 3: the careful driver brakes harder by so much a second."""
HARDEST_MPS2: Final = 0.774 * 9.81
"""The same: as hard as this."""


class ReferenceDriver(Level0Vut):
    """Drives the level-0 profile, and gives way as a model says when it foresees a conflict at M.

    Attributes:
        perception_s: a risk is perceived after so long.
        reaction_s: then the driver takes so long to brake.
        jerk_mps3: braking grows by so much a second.
        hardest_mps2: up to so much, positive, and never beyond the limit of the scenario.
    """

    perception_s: float = 0.0
    reaction_s: float = 0.75
    jerk_mps3: float = JERK_MPS3
    hardest_mps2: float = HARDEST_MPS2

    def __init__(self, corridors: int) -> None:
        """Prepare for a number of corridors."""
        super().__init__(corridors)
        self.limit_mps2 = np.full(corridors, min(-US23.a_min_mps2, self.hardest_mps2))
        self.others_mps2 = np.full(corridors, -US23.a_min_mps2)
        self.accel_mps2 = np.full(corridors, US23.a_max_mps2)
        self.crash_m = np.full(corridors, US23.dx_crash_m)
        self._risk_steps = np.zeros(corridors, dtype=np.int64)
        self._braking_mps2 = np.zeros(corridors)

    def begin(self, corridor: int, case: Case) -> None:
        """Forget; take the limits of the case's scenario."""
        super().begin(corridor, case)
        self.limit_mps2[corridor] = min(-case.scenario.a_min_mps2, self.hardest_mps2)
        self.others_mps2[corridor] = -case.scenario.a_min_mps2
        self.accel_mps2[corridor] = case.scenario.a_max_mps2
        self.crash_m[corridor] = case.scenario.dx_crash_m
        self._risk_steps[corridor] = 0
        self._braking_mps2[corridor] = 0.0

    @abstractmethod
    def braking_mps2(
        self, gap_m: FloatArray, v_rear_mps: FloatArray, v_front_mps: FloatArray
    ) -> FloatArray:
        """Return how hard the model brakes, (K,), positive; 0 where there is no risk.

        Args:
            gap_m: between the two at M; negative where they overlap.
            v_rear_mps: speed of the one behind at M.
            v_front_mps: speed of the one ahead at M.
        """

    def act(self, scene: Scene) -> FloatArray:
        """Return the acceleration in each corridor, (K,)."""
        return self._answer(self._foreseen(scene), super().act(scene))

    def _foreseen(self, scene: Scene) -> FloatArray:
        """Return how hard the model brakes for what is foreseen at M, (K,)."""
        distance_m, v_mps = np.maximum(-scene.x_vut_m, 0.0), scene.v_vut_mps
        t_s = level0_time_to(distance_m, v_mps, self.a_mps2, self.v_cruise_mps)
        v_at_m = np.sqrt(v_mps * v_mps + 2.0 * self.a_mps2 * distance_m)
        v_at_m = np.minimum(v_at_m, np.maximum(v_mps, self.v_cruise_mps))
        # Behind M, where an episode may go on, the two are as they are.
        x_pov_m = scene.x_pov_m - np.maximum(scene.x_vut_m, 0.0)
        dx_m = x_pov_m + scene.v_pov_mps * t_s
        follows = dx_m >= 0.0
        demand = self.braking_mps2(
            np.abs(dx_m) - self.crash_m,
            np.where(follows, v_at_m, scene.v_pov_mps),
            np.where(follows, scene.v_pov_mps, v_at_m),
        )
        # Braking at the limit from here on it is at M later, or never.
        left = v_mps * v_mps - 2.0 * self.limit_mps2 * distance_m
        t_late_s = (v_mps - np.sqrt(np.maximum(left, 0.0))) / self.limit_mps2
        helps = (left <= 0.0) | (x_pov_m + scene.v_pov_mps * t_late_s >= self.crash_m)
        return np.where(helps, demand, 0.0)

    def forget_risk(self, where: NDArray[np.bool_]) -> None:
        """See and do as if nothing had been seen so far in some corridors, (K,)."""
        self._risk_steps[where] = 0
        self._braking_mps2[where] = 0.0

    def _answer(self, demand: FloatArray, calm: FloatArray) -> FloatArray:
        """Return accelerations, (K,): braking by perception, reaction and jerk, else calm ones."""
        at_risk = demand > 0.0
        self._risk_steps += at_risk
        lasted_s = (self._risk_steps - 1) * DT_S + 1e-9
        perceives = at_risk & (lasted_s >= self.perception_s)
        brakes = at_risk & (lasted_s >= self.perception_s + self.reaction_s - DT_S)
        most = np.minimum(demand, self.limit_mps2)
        harder = np.minimum(self._braking_mps2 + self.jerk_mps3 * DT_S, most)
        self._braking_mps2 = np.where(brakes, harder, 0.0)
        answer: FloatArray = np.where(brakes, -self._braking_mps2, np.where(perceives, 0.0, calm))
        return answer


def ttc_s(gap_m: FloatArray, v_rear_mps: FloatArray, v_front_mps: FloatArray) -> FloatArray:
    """Return the time to collision, (K,): 0 where they overlap, infinite where the gap opens."""
    closing = v_rear_mps - v_front_mps
    times = np.where(closing > 0.0, gap_m / np.where(closing > 0.0, closing, 1.0), np.inf)
    found: FloatArray = np.where(gap_m <= 0.0, 0.0, times)
    return found


class CarefulVut(ReferenceDriver):
    """A careful and competent human driver: UN R157, Annex 3, Appendix 3, performance model 1.

    A risk is a time to collision of less than 2 s at the cut-in. The driver perceives it in 0.4 s,
    reacts in 0.75 s, and brakes up to 0.774 g by 12.65 m/s3. Where R157's driver sees a car leave
    the middle of its lane, ours has seen the lanes run together from the start.
    """

    perception_s = 0.4
    ttc_s = 2.0

    def braking_mps2(
        self, gap_m: FloatArray, v_rear_mps: FloatArray, v_front_mps: FloatArray
    ) -> FloatArray:
        """Return all there is below a time to collision of 2 s."""
        return np.where(ttc_s(gap_m, v_rear_mps, v_front_mps) < self.ttc_s, self.hardest_mps2, 0.0)


class Reg157Vut(ReferenceDriver):
    """What R157 asks of lane-keeping systems in a cut-in (5.2.5.2), taken as a way to drive.

    A system has to avoid a collision where TTC > v_rel / (2 * 6 m/s2) + 0.35 s when the other
    intrudes into its lane. So this one brakes by 6 m/s2 at once, 0.35 s after TTC is down to that,
    a step earlier: looking every 0.1 s, it would else be too late for what it has to avoid.
    """

    reaction_s = 0.35
    jerk_mps3 = np.inf
    hardest_mps2 = 6.0
    late_s = DT_S
    """TTC is down to the bound up to a step before it is seen to be."""

    def braking_mps2(
        self, gap_m: FloatArray, v_rear_mps: FloatArray, v_front_mps: FloatArray
    ) -> FloatArray:
        """Return 6 m/s2 where the time to collision is not above the bound of R157."""
        bound_s = (v_rear_mps - v_front_mps) / (2.0 * self.hardest_mps2) + self.reaction_s
        times_s = ttc_s(gap_m, v_rear_mps, v_front_mps)
        late = times_s <= np.maximum(bound_s + self.late_s, 0.0)
        return np.where(late, self.hardest_mps2, 0.0)


class RssVut(ReferenceDriver):
    """Responsibility-sensitive safety (Shalev-Shwartz, Shammah, Shashua, arXiv:1708.06374, 2017).

    It brakes as hard as it can while the gap is shorter than the safe distance of definition 1, of
    which both limits of braking, and that of acceleration, are those of the scenario.
    """

    def braking_mps2(
        self, gap_m: FloatArray, v_rear_mps: FloatArray, v_front_mps: FloatArray
    ) -> FloatArray:
        """Return all there is where the gap is shorter than the safe distance."""
        limits = self.reaction_s, self.accel_mps2, self.limit_mps2, self.others_mps2
        safe_m = rss_distance_m(v_rear_mps, v_front_mps, *limits)
        return np.where(gap_m < np.maximum(safe_m, 1e-9), self.hardest_mps2, 0.0)


def rss_distance_m(
    v_rear_mps: FloatArray,
    v_front_mps: FloatArray,
    response_s: float,
    accel_mps2: FloatArray | float,
    brake_min_mps2: FloatArray | float,
    brake_max_mps2: FloatArray | float,
) -> FloatArray:
    """Return the safe distance of RSS: the one behind accelerates for the response time at most.

    [v_r rho + a rho^2 / 2 + (v_r + rho a)^2 / (2 b_min) - v_f^2 / (2 b_max)]+.
    """
    fastest = v_rear_mps + response_s * accel_mps2
    stops_m = v_rear_mps * response_s + 0.5 * accel_mps2 * response_s**2
    stops_m = stops_m + fastest * fastest / (2.0 * brake_min_mps2)
    safe_m: FloatArray = np.maximum(
        stops_m - v_front_mps * v_front_mps / (2.0 * brake_max_mps2), 0.0
    )
    return safe_m


class FsmVut(ReferenceDriver):
    """The fuzzy safety model: R157's performance model 2 (Mattas et al., 2020 and 2022).

    Where the critical metric CFS is above 0 it brakes between comfortably and as hard as it can,
    else, where the proactive metric PFS is, up to comfortably. Brakings are the published ones as
    far as the scenario has them.
    """

    comfortable_mps2 = 4.0
    hardest_mps2 = 6.0
    leader_mps2 = 7.0
    margin_m = 2.0

    def braking_mps2(
        self, gap_m: FloatArray, v_rear_mps: FloatArray, v_front_mps: FloatArray
    ) -> FloatArray:
        """Return CFS (b_max - b_comf) + b_comf where CFS > 0, else PFS b_comf."""
        most = self.limit_mps2
        comfortable = np.minimum(self.comfortable_mps2, most)
        leader = np.minimum(self.leader_mps2, self.others_mps2)
        speeds = v_rear_mps, v_front_mps
        delay = self.reaction_s
        critical = cfs(gap_m, *speeds, delay, comfortable, most)
        ahead = pfs(gap_m, *speeds, delay, comfortable, most, leader, self.margin_m)
        hard = critical * (most - comfortable) + comfortable
        braking: FloatArray = np.where(critical > 0.0, hard, ahead * comfortable)
        return braking


def pfs(
    gap_m: FloatArray,
    v_rear_mps: FloatArray,
    v_front_mps: FloatArray,
    delay_s: float,
    comfortable_mps2: FloatArray | float,
    hardest_mps2: FloatArray | float,
    leader_mps2: FloatArray | float,
    margin_m: float,
) -> FloatArray:
    """Return the proactive fuzzy surrogate metric, (K,), 0 (safe) to 1: what if the leader brakes.

    With d = gap - d1: 1 below d_unsafe = v_r tau + v_r^2 / (2 b_max) - v_f^2 / (2 b_l), 0 above
    d_safe = v_r tau + v_r^2 / (2 b_comf) - v_f^2 / (2 b_l) + d1, linear between (R157, Annex 3).
    """
    leader_m = v_front_mps * v_front_mps / (2.0 * leader_mps2)
    rear = v_rear_mps * v_rear_mps / 2.0
    safe_m: FloatArray = v_rear_mps * delay_s + rear / comfortable_mps2 - leader_m + margin_m
    unsafe_m: FloatArray = v_rear_mps * delay_s + rear / hardest_mps2 - leader_m
    return _between(gap_m - margin_m, safe_m, unsafe_m)


def cfs(
    gap_m: FloatArray,
    v_rear_mps: FloatArray,
    v_front_mps: FloatArray,
    delay_s: float,
    comfortable_mps2: FloatArray | float,
    hardest_mps2: FloatArray | float,
) -> FloatArray:
    """Return the critical fuzzy surrogate metric, (K,), 0 to 1: what if the leader goes on.

    At M neither accelerates: with the closing speed u, the one behind comes nearer by u tau before
    it brakes, then by u^2 / (2 b). 1 below that with b_max, 0 above that with b_comf, linear
    between; 0 where the gap opens.
    """
    closing = np.maximum(v_rear_mps - v_front_mps, 0.0)
    before_m, stop = closing * delay_s, closing * closing / 2.0
    found = _between(gap_m, before_m + stop / comfortable_mps2, before_m + stop / hardest_mps2)
    metric: FloatArray = np.where((closing > 0.0) | (gap_m <= 0.0), found, 0.0)
    return metric


def _between(gap_m: FloatArray, safe_m: FloatArray, unsafe_m: FloatArray) -> FloatArray:
    """Return 1 up to the unsafe distance, 0 from the safe one on, and linear between."""
    width = np.maximum(safe_m - unsafe_m, 1e-9)
    found: FloatArray = np.clip((safe_m - gap_m) / width, 0.0, 1.0)
    return found


class CarefulPov(CarefulVut):
    """The careful driver on the mainline: holds its speed, and brakes for the VUT that cuts in.

    To give way is to fall behind the VUT, also here: it goes on where braking as hard as it can
    would not get it there by the time at which the VUT is at M.
    """

    def act(self, scene: Scene) -> FloatArray:
        """Return the acceleration of the POV in each corridor, (K,)."""
        distance_m = np.maximum(-scene.x_vut_m, 0.0)
        v_vut = scene.v_vut_mps
        t_s = level0_time_to(distance_m, v_vut, self.a_mps2, self.v_cruise_mps)
        v_at_m = np.sqrt(v_vut * v_vut + 2.0 * self.a_mps2 * distance_m)
        v_at_m = np.minimum(v_at_m, np.maximum(v_vut, self.v_cruise_mps))
        v_pov = scene.v_pov_mps
        x_pov_m = scene.x_pov_m - np.maximum(scene.x_vut_m, 0.0)
        dx_m = x_pov_m + v_pov * t_s
        follows = dx_m < 0.0
        demand = self.braking_mps2(
            np.abs(dx_m) - self.crash_m,
            np.where(follows, v_pov, v_at_m),
            np.where(follows, v_at_m, v_pov),
        )
        t_brake = np.minimum(t_s, v_pov / self.limit_mps2)
        dx_late = x_pov_m + (v_pov - 0.5 * self.limit_mps2 * t_brake) * t_brake
        demand = np.where(dx_late <= -self.crash_m, demand, 0.0)
        return self._answer(demand, np.zeros(self.corridors))


REFERENCES: Final[dict[str, type[ReferenceDriver]]] = {
    "careful": CarefulVut,
    "fsm": FsmVut,
    "reg157": Reg157Vut,
    "rss": RssVut,
}
"""The reference drivers by name, as VUTs."""
