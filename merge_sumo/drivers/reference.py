"""Reference drivers: published models of a careful driver (`safety_models.py`), applied to a merge.

The models are of rear-end conflicts on one lane; UN Regulation No. 157 covers cut-ins there. The
transposition to a merge is ours, and no claim of compliance follows from it.

`RampDriver` drives the VUT and has to yield. It predicts the state at M in two ways, on the level-0
profile of the scenario (P0) and at its present speed (P1; a standing VUT waits), and the other
vehicle at its present speed. The vehicle that is behind at M is the rear one, the gap is |dx| less
`dx_crash_m`, the speeds are those at M. A plan has a conflict where the gap is negative or unsafe
under the model. The VUT can fall behind where braking at the limit, after the rest of its delay,
stops it before M or brings it there at least `dx_crash_m` behind the other vehicle.

1. Free: it takes the level-0 profile, until P0 has a conflict, the model says that it is time to
   react (`is_due`), and the VUT is the rear vehicle or can fall behind.
2. Delay: it continues, or releases the pedal (the careful driver).
3. From then on, in each step: it takes the level-0 profile where P0 has no conflict, holds its
   speed where P1 has none, brakes as the model says for P1 where it is the rear vehicle in P1 or
   can fall behind, and takes the level-0 profile where that is too late. The deceleration grows
   from 0 by the model's jerk, and begins again at 0 after a step without braking.

The angle of the ramp in a drawing is arbitrary, so the lateral conditions of the models became
times to M. `tests/drivers/test_cut_in.py` compares the models with their published code, and
`test_reference_drivers.py` the ramp driver with a table of another implementation of these rules.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import NamedTuple

import numpy as np

from merge_sumo.drivers.base import BuiltInVut, Driver, Scene
from merge_sumo.drivers.level0 import Level0Vut, level0_time_to
from merge_sumo.drivers.safety_models import (
    JERK_MPS3,
    CarefulModel,
    Flags,
    FsmModel,
    Pair,
    Reaction,
    Reg157Model,
    RssModel,
    SafetyModel,
    rss_distance_m,
    ttc_s,
)
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S

SLOWEST_MPS = 1e-9
"""A slower vehicle stands."""


class Plan(NamedTuple):
    """A prediction of the state at M, each array of shape (K,).

    Attributes:
        t_s: time at which the VUT is at M; infinite where it never is.
        pair: the rear and the front vehicle at M; their gap is |dx| less `dx_crash_m`.
        is_rear: whether the VUT is the rear vehicle.
        conflict: whether the gap is negative or unsafe under the model.
    """

    t_s: FloatArray
    pair: Pair
    is_rear: Flags
    conflict: Flags


class RampDriver(Level0Vut):
    """Takes the level-0 profile, and gives way when a model predicts a conflict at M."""

    model: SafetyModel

    def __init__(self, corridors: int) -> None:
        super().__init__(corridors)
        self._reacts = np.zeros(corridors, dtype=np.bool_)
        """Whether the driver has left phase 1."""
        self._delay_steps, self._conflict_steps = np.zeros((2, corridors), dtype=np.int64)
        """Steps of phase 2 that are left, and steps of the present conflict of P0."""
        self._braking_mps2 = np.zeros(corridors)

    def begin(self, corridor: int, case: Case) -> None:
        """Forget the last episode of a corridor."""
        super().begin(corridor, case)
        self.forget(corridor)

    def forget(self, corridors: int | Flags) -> None:
        """Reset a corridor, or those of a mask, (K,)."""
        self._reacts[corridors] = False
        self._delay_steps[corridors] = 0
        self._conflict_steps[corridors] = 0
        self._braking_mps2[corridors] = 0.0

    @property
    def limit_mps2(self) -> float:
        """Hardest deceleration of the model that the scenario allows, positive."""
        return min(-self.scenario.a_min_mps2, self.model.hardest_mps2)

    @abstractmethod
    def is_due(self, scene: Scene, nominal: Plan) -> Flags:
        """Return whether a conflict of P0, if any, is a reason to react now, (K,)."""

    def act(self, scene: Scene) -> FloatArray:
        """Return the acceleration in each corridor, (K,)."""
        calm = super().act(scene)
        v_mps, distance_m, scenario = scene.v_vut_mps, _distance_m(scene), self.scenario
        # P0: the VUT takes the level-0 profile.
        t_s = level0_time_to(distance_m, v_mps, scenario)
        most_mps = np.maximum(v_mps, scenario.level0_v_mps)
        nominal = self._plan(scene, t_s, np.minimum(v_mps + scenario.level0_a_mps2 * t_s, most_mps))
        # P1: it keeps its speed.
        moves = (v_mps > SLOWEST_MPS) | (distance_m == 0.0)
        t_s = np.where(moves, distance_m / np.maximum(v_mps, SLOWEST_MPS), np.inf)
        present = self._plan(scene, t_s, v_mps)
        self._start(scene, nominal)
        waits = self._reacts & (self._delay_steps > 0)
        self._delay_steps -= waits
        acts = self._reacts & ~waits & nominal.conflict
        behind = present.is_rear | self._can_fall_behind(scene, 0.0, self.limit_mps2)
        brakes = acts & present.conflict & behind
        harder = self._braking_mps2 + self.model.growth_mps2
        most = np.minimum(self._demand_mps2(scene, present), self.limit_mps2)
        released = np.where(waits, self.model.released_mps2, 0.0)
        self._braking_mps2 = np.where(brakes, np.minimum(harder, most), released)
        answer: FloatArray = np.where(acts & ~present.conflict, 0.0, calm)
        answer = np.where(waits & (released > 0.0), -released, answer)
        return np.where(brakes, -self._braking_mps2, answer)

    def _start(self, scene: Scene, nominal: Plan) -> None:
        """Begin the delay where it is time to react to the conflict that is predicted."""
        conflict, model = nominal.conflict, self.model
        self._conflict_steps = np.where(conflict, self._conflict_steps + 1, 0)
        # The first prediction is 0 s old.
        missing = np.maximum(model.perception_steps - (self._conflict_steps - 1), 0)
        left_s = model.delay_s + missing * DT_S
        due = conflict & ~self._reacts & self.is_due(scene, nominal)
        due &= nominal.is_rear | self._can_fall_behind(scene, left_s, self.limit_mps2)
        self._reacts |= due
        self._delay_steps = np.where(due, model.delay_steps + missing, self._delay_steps)

    def _plan(self, scene: Scene, t_s: FloatArray, v_vut_mps: FloatArray) -> Plan:
        v_pov_mps = scene.v_pov_mps
        arrives = np.isfinite(t_s)
        dx_m = _x_pov_m(scene) + v_pov_mps * np.where(arrives, t_s, 0.0)
        is_rear = dx_m >= 0.0
        gap_m = np.where(arrives, np.abs(dx_m) - self.scenario.dx_crash_m, np.inf)
        v_rear = np.where(is_rear, v_vut_mps, v_pov_mps)
        pair = Pair(gap_m, v_rear, np.where(is_rear, v_pov_mps, v_vut_mps))
        unsafe = np.where(is_rear, self.model.is_unsafe(pair), self.model.endangers(pair))
        return Plan(t_s, pair, is_rear, arrives & ((gap_m < 0.0) | unsafe))

    def _can_fall_behind(
        self, scene: Scene, delay_s: FloatArray | float, limit_mps2: float
    ) -> Flags:
        """Return whether the VUT can be behind the other vehicle at M, or stop before it, (K,).

        Args:
            scene: the present state.
            delay_s: time in which the VUT keeps its speed, (K,) or one.
            limit_mps2: its deceleration from then on.
        """
        v_mps, distance_m = scene.v_vut_mps, _distance_m(scene)
        room_m = distance_m - v_mps * delay_s
        left = v_mps * v_mps - 2.0 * limit_mps2 * room_m
        t_s = delay_s + (v_mps - np.sqrt(np.maximum(left, 0.0))) / limit_mps2
        t_s = np.where(room_m > 0.0, t_s, distance_m / np.maximum(v_mps, SLOWEST_MPS))
        stops = (room_m > 0.0) & (left <= 0.0)
        return stops | (_x_pov_m(scene) + scene.v_pov_mps * t_s >= self.scenario.dx_crash_m)

    def _demand_mps2(self, scene: Scene, present: Plan) -> FloatArray:
        """Return the deceleration that the model demands in P1, (K,)."""
        return self.model.demand_mps2(present.pair)


class CarefulVut(RampDriver):
    """The careful and competent human driver: reacts when a collision is less than 2 s away."""

    model = CarefulModel()

    def is_due(self, scene: Scene, nominal: Plan) -> Flags:
        """Return whether the times to M and from there to the collision are below 2 s together."""
        return nominal.t_s + ttc_s(*nominal.pair[:3]) < self.model.critical_ttc_s


class FsmVut(RampDriver):
    """The fuzzy safety model: reacts at once."""

    model = FsmModel()

    def is_due(self, scene: Scene, nominal: Plan) -> Flags:
        """Return True everywhere."""
        return np.ones(self.corridors, dtype=np.bool_)

    def _demand_mps2(self, scene: Scene, present: Plan) -> FloatArray:
        """Return the deceleration of the model; where bodies would overlap, the needed one."""
        comfortable = min(self.model.comfortable_mps2, self.limit_mps2)
        enough = self._can_fall_behind(scene, 0.0, comfortable)
        overlap = np.where(enough, self.model.comfortable_mps2, self.model.hardest_mps2)
        demand = super()._demand_mps2(scene, present)
        return np.where(present.pair.gap_m < 0.0, overlap, demand)


class Reg157Vut(RampDriver):
    """The bound of UN R157: reacts when it would just stop before M."""

    model = Reg157Model()

    def is_due(self, scene: Scene, nominal: Plan) -> Flags:
        """Return whether the delay and braking at the limit take all of the distance to M."""
        v_mps = scene.v_vut_mps
        stop_m = v_mps * v_mps / (2.0 * self.limit_mps2)
        return _distance_m(scene) <= self.model.delay_s * v_mps + stop_m


class RssVut(RampDriver):
    """Responsibility-sensitive safety: reacts when M is within the safe distance."""

    model = RssModel()

    def is_due(self, scene: Scene, nominal: Plan) -> Flags:
        """Return whether a VUT that accelerates in its delay could only just stop before M.

        Half of the time in which the deceleration grows counts as delay.
        """
        limit_mps2 = self.limit_mps2
        delay_s = self.model.delay_s + 0.5 * limit_mps2 / JERK_MPS3
        limits = delay_s, self.scenario.a_max_mps2, limit_mps2, limit_mps2
        return _distance_m(scene) < rss_distance_m(scene.v_vut_mps, 0.0, *limits)


class CarefulPov(Driver):
    """The careful driver on the mainline: keeps its speed, and brakes for a VUT that cuts in.

    The state at M is predicted with both at their present speeds. It reacts to a VUT that is ahead
    of it, where it would not be ahead by `dx_crash_m` at M, and where the time to M and the time to
    collision from there are less than 2 s together.
    """

    def __init__(self, corridors: int) -> None:
        super().__init__(corridors)
        self._reaction = Reaction(corridors, CarefulModel())

    def begin(self, corridor: int, case: Case) -> None:
        """Forget the last episode of a corridor."""
        super().begin(corridor, case)
        self._reaction.forget(corridor)

    def act(self, scene: Scene) -> FloatArray:
        """Return the acceleration of the POV in each corridor, (K,)."""
        v_vut, v_pov, crash_m = scene.v_vut_mps, scene.v_pov_mps, self.scenario.dx_crash_m
        limit_mps2 = min(-self.scenario.a_min_mps2, CarefulModel.hardest_mps2)
        t_s = _distance_m(scene) / np.maximum(v_vut, SLOWEST_MPS)
        dx_m = _x_pov_m(scene) + v_pov * t_s
        collides_s = t_s + ttc_s(-dx_m - crash_m, v_pov, v_vut)
        ahead = (scene.x_vut_m > scene.x_pov_m) & (dx_m < crash_m)
        unsafe: Flags = ahead & (collides_s < CarefulModel.critical_ttc_s)
        return self._reaction.acceleration_mps2(unsafe, limit_mps2)


def _distance_m(scene: Scene) -> FloatArray:
    """Return the distance of the VUT to M, (K,); 0 after M."""
    return np.maximum(-scene.x_vut_m, 0.0)


def _x_pov_m(scene: Scene) -> FloatArray:
    """Return the position of the POV, (K,); after M relative to the VUT."""
    return scene.x_pov_m - np.maximum(scene.x_vut_m, 0.0)


REFERENCES: dict[str, type[RampDriver]] = {
    "careful": CarefulVut,
    "fsm": FsmVut,
    "reg157": Reg157Vut,
    "rss": RssVut,
}
"""The reference drivers by name, as VUTs."""


VUTS = {name: BuiltInVut(driver) for name, driver in REFERENCES.items()}
