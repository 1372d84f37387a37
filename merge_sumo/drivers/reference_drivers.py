"""Reference drivers: published models (`reference_models.py`) applied to a merge.

The models are of rear-end conflicts on one lane; UN Regulation No. 157 covers cut-ins there. The
transposition to a merge is ours, and no claim of compliance follows from it.

`ReferenceVut` drives the VUT and has to yield. It predicts the state at M twice, with the other
vehicle at its present speed:

- nominal: the VUT drives the level-0 profile of the scenario;
- present: the VUT keeps its speed. A standing VUT never arrives.

The vehicle that is behind at M is the rear one. The gap is |dx| less `dx_crash_m`, and the speeds
are those at M. A prediction has a conflict if the gap is negative or unsafe under the model. The
VUT *can fall behind* if it brakes at its limit after the rest of its delay and then stops before M,
or reaches M at least `dx_crash_m` behind the other vehicle.

1. Free: the VUT drives the level-0 profile, until the nominal prediction has a conflict, the model
   says that it is time to react (`is_due`), and the VUT is the rear vehicle or can fall behind.
2. Delay: it continues, or releases the pedal (`careful`).
3. Reaction, in each step from then on. The VUT drives the level-0 profile if the nominal prediction
   has no conflict. Otherwise it keeps its speed if the present prediction has none. Otherwise it
   brakes as the model says, if it is the rear vehicle or can fall behind. Otherwise it is too late
   to brake, and the VUT drives the level-0 profile. The deceleration grows from 0 by the jerk of
   the model, and begins again at 0 after a step without braking.

The angle of the ramp in a drawing is arbitrary, so the lateral conditions of the models became
times to M. `tests/drivers/test_cut_in.py` compares the models with their published code, and
`test_reference_drivers.py` the VUTs with a table of another implementation of these rules.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import NamedTuple

import numpy as np

from merge_sumo.drivers.base import BuiltInVut, Driver, Scene
from merge_sumo.drivers.level0 import Level0Vut, level0_time_to
from merge_sumo.drivers.reference_models import (
    JERK_MPS3,
    CarefulModel,
    Flags,
    FsmModel,
    Pair,
    Reaction,
    ReferenceModel,
    Reg157Model,
    RssModel,
    bumper_ttc_s,
    rss_distance_m,
)
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S

SLOWEST_MPS = 1e-9
"""A slower vehicle stands."""


class MergePrediction(NamedTuple):
    """A prediction of the state at M, each array of shape (K,).

    Attributes:
        t_s: time until the VUT is at M; infinite where it never arrives.
        pair: the rear and the front vehicle at M; their gap is |dx| less `dx_crash_m`.
        is_rear: whether the VUT is the rear vehicle.
        conflict: whether the gap is negative or unsafe under the model.
    """

    t_s: FloatArray
    pair: Pair
    is_rear: Flags
    conflict: Flags


class ReferenceVut(Level0Vut):
    """Drives the level-0 profile, and gives way when a model predicts a conflict at M.

    Example:
        driver = FsmVut(corridors=1)
        driver.begin(0, case)
        a_mps2 = driver.act(scene)

    Attributes:
        model: when the driver reacts, and how hard it brakes.
    """

    model: ReferenceModel

    def __init__(self, corridors: int) -> None:
        """Begin in phase 1 in all corridors.

        Args:
            corridors: number of corridors, K.
        """
        super().__init__(corridors)
        self._reacts = np.zeros(corridors, dtype=np.bool_)
        """Whether the driver has left phase 1."""
        self._delay_steps, self._conflict_steps = np.zeros((2, corridors), dtype=np.int64)
        """Steps of phase 2 that are left, and steps of the present nominal conflict."""
        self._braking_mps2 = np.zeros(corridors)

    def begin(self, corridor: int, case: Case) -> None:
        """Forget the last episode of a corridor.

        Args:
            corridor: index of the corridor.
            case: the case of the next episode.
        """
        super().begin(corridor, case)
        self.forget(corridor)

    def forget(self, corridors: int | Flags) -> None:
        """Return to phase 1.

        Args:
            corridors: index of a corridor, or a mask of corridors, (K,).
        """
        for state in (self._reacts, self._delay_steps, self._conflict_steps, self._braking_mps2):
            state[corridors] = 0

    @property
    def limit_mps2(self) -> float:
        """Hardest deceleration of the model that the scenario allows, positive."""
        return min(-self.scenario.a_min_mps2, self.model.hardest_mps2)

    @abstractmethod
    def is_due(self, scene: Scene, nominal: MergePrediction) -> Flags:
        """Return whether a nominal conflict, if any, is a reason to react now, (K,).

        Args:
            scene: the present state.
            nominal: the nominal prediction.
        """

    def act(self, scene: Scene) -> FloatArray:
        """Return the acceleration in each corridor, (K,).

        Args:
            scene: the present state.
        """
        v_mps, distance_m, scenario = scene.v_vut_mps, scene.distance_m, self.scenario
        t_s = level0_time_to(distance_m, v_mps, scenario)
        most_mps = np.maximum(v_mps, scenario.level0_v_mps)
        v_at_m_mps = np.minimum(v_mps + scenario.level0_a_mps2 * t_s, most_mps)
        nominal = self._predict(scene, t_s, v_at_m_mps)
        moves = (v_mps > SLOWEST_MPS) | (distance_m == 0.0)
        t_s = np.where(moves, distance_m / np.maximum(v_mps, SLOWEST_MPS), np.inf)
        present = self._predict(scene, t_s, v_mps)
        self._begin_delay(scene, nominal)
        waits = self._reacts & (self._delay_steps > 0)
        self._delay_steps -= waits
        reacts = self._reacts & ~waits & nominal.conflict
        gives_way = present.is_rear | self._can_fall_behind(scene, self.limit_mps2)
        brakes = reacts & present.conflict & gives_way
        most_mps2 = np.minimum(self._demand_mps2(scene, present), self.limit_mps2)
        harder_mps2 = np.minimum(self._braking_mps2 + self.model.growth_mps2, most_mps2)
        released_mps2 = np.where(waits, self.model.released_mps2, 0.0)
        self._braking_mps2 = np.where(brakes, harder_mps2, released_mps2)
        keeps_speed = reacts & ~present.conflict
        return np.select(
            [brakes | (released_mps2 > 0.0), keeps_speed],
            [-self._braking_mps2, np.zeros(self.corridors)],
            super().act(scene),
        )

    def _begin_delay(self, scene: Scene, nominal: MergePrediction) -> None:
        """Begin the delay where it is time to react to a nominal conflict."""
        conflict, model = nominal.conflict, self.model
        self._conflict_steps = np.where(conflict, self._conflict_steps + 1, 0)
        # The first prediction is 0 s old.
        missing = np.maximum(model.perception_steps - (self._conflict_steps - 1), 0)
        left_s = model.delay_s + missing * DT_S
        due = conflict & ~self._reacts & self.is_due(scene, nominal)
        due &= nominal.is_rear | self._can_fall_behind(scene, self.limit_mps2, left_s)
        self._reacts |= due
        self._delay_steps = np.where(due, model.delay_steps + missing, self._delay_steps)

    def _predict(self, scene: Scene, t_s: FloatArray, v_vut_mps: FloatArray) -> MergePrediction:
        """Predict the state at M by the VUT's time to M and its speed there, (K,) each."""
        v_pov_mps = scene.v_pov_mps
        arrives = np.isfinite(t_s)
        dx_m = scene.dx_at_m(np.where(arrives, t_s, 0.0))
        is_rear = dx_m >= 0.0
        gap_m = np.where(arrives, np.abs(dx_m) - self.scenario.dx_crash_m, np.inf)
        v_rear = np.where(is_rear, v_vut_mps, v_pov_mps)
        pair = Pair(gap_m, v_rear, np.where(is_rear, v_pov_mps, v_vut_mps))
        unsafe = np.where(is_rear, self.model.is_unsafe(pair), self.model.endangers(pair))
        return MergePrediction(t_s, pair, is_rear, arrives & ((gap_m < 0.0) | unsafe))

    def _can_fall_behind(
        self, scene: Scene, brake_mps2: float, delay_s: FloatArray | float = 0.0
    ) -> Flags:
        """Return whether the VUT can be behind the other vehicle at M, or stop before it, (K,).

        Args:
            scene: the present state.
            brake_mps2: deceleration after the delay, positive.
            delay_s: time in which the VUT keeps its speed, (K,) or one.
        """
        v_mps, distance_m = scene.v_vut_mps, scene.distance_m
        room_m = distance_m - v_mps * delay_s
        left = v_mps * v_mps - 2.0 * brake_mps2 * room_m
        t_s = delay_s + (v_mps - np.sqrt(np.maximum(left, 0.0))) / brake_mps2
        t_s = np.where(room_m > 0.0, t_s, distance_m / np.maximum(v_mps, SLOWEST_MPS))
        stops = (room_m > 0.0) & (left <= 0.0)
        return stops | (scene.dx_at_m(t_s) >= self.scenario.dx_crash_m)

    def _demand_mps2(self, scene: Scene, present: MergePrediction) -> FloatArray:
        """Return the deceleration that the model demands, (K,), by the present prediction."""
        return self.model.demand_mps2(present.pair)


class CarefulVut(ReferenceVut):
    """The careful and competent human driver, who reacts when a collision is less than 2 s away."""

    model = CarefulModel()

    def is_due(self, scene: Scene, nominal: MergePrediction) -> Flags:
        """Return whether the times to M and from there to the collision are below 2 s together.

        Args:
            scene: the present state.
            nominal: the nominal prediction.
        """
        return nominal.t_s + bumper_ttc_s(*nominal.pair[:3]) < self.model.critical_ttc_s


class FsmVut(ReferenceVut):
    """The fuzzy safety model, which reacts at once."""

    model = FsmModel()

    def is_due(self, scene: Scene, nominal: MergePrediction) -> Flags:
        """Return True everywhere.

        Args:
            scene: the present state.
            nominal: the nominal prediction.
        """
        return np.ones(self.corridors, dtype=np.bool_)

    def _demand_mps2(self, scene: Scene, present: MergePrediction) -> FloatArray:
        """Return the deceleration of the model; where bodies would overlap, the needed one."""
        comfortable = min(self.model.comfortable_mps2, self.limit_mps2)
        enough = self._can_fall_behind(scene, comfortable)
        overlap = np.where(enough, self.model.comfortable_mps2, self.model.hardest_mps2)
        demand = super()._demand_mps2(scene, present)
        return np.where(present.pair.gap_m < 0.0, overlap, demand)


class Reg157Vut(ReferenceVut):
    """The bound of UN R157: the VUT reacts when it would just stop before M."""

    model = Reg157Model()

    def is_due(self, scene: Scene, nominal: MergePrediction) -> Flags:
        """Return whether the delay and braking at the limit take all of the distance to M.

        Args:
            scene: the present state.
            nominal: the nominal prediction.
        """
        v_mps = scene.v_vut_mps
        stop_m = v_mps * v_mps / (2.0 * self.limit_mps2)
        return scene.distance_m <= self.model.delay_s * v_mps + stop_m


class RssVut(ReferenceVut):
    """Responsibility-sensitive safety: the VUT reacts when M is within the safe distance."""

    model = RssModel()

    def is_due(self, scene: Scene, nominal: MergePrediction) -> Flags:
        """Return whether a VUT that accelerates in its delay could only just stop before M.

        Half of the time in which the deceleration grows counts as delay.

        Args:
            scene: the present state.
            nominal: the nominal prediction.
        """
        limit_mps2 = self.limit_mps2
        delay_s = self.model.delay_s + 0.5 * limit_mps2 / JERK_MPS3
        limits = delay_s, self.scenario.a_max_mps2, limit_mps2, limit_mps2
        return scene.distance_m < rss_distance_m(scene.v_vut_mps, 0.0, *limits)


class CarefulPov(Driver):
    """The careful driver on the mainline, which brakes for a VUT that cuts in.

    It predicts the state at M with both at their present speeds. It reacts to a VUT ahead of it
    that will not be ahead by `dx_crash_m` at M, if the time to M and the time to collision from
    there are less than 2 s together. Otherwise it keeps its speed.
    """

    def __init__(self, corridors: int) -> None:
        """Begin with a full delay in all corridors.

        Args:
            corridors: number of corridors, K.
        """
        super().__init__(corridors)
        self._reaction = Reaction(corridors, CarefulModel())

    def begin(self, corridor: int, case: Case) -> None:
        """Forget the last episode of a corridor.

        Args:
            corridor: index of the corridor.
            case: the case of the next episode.
        """
        super().begin(corridor, case)
        self._reaction.forget(corridor)

    def act(self, scene: Scene) -> FloatArray:
        """Return the acceleration of the POV in each corridor, (K,).

        Args:
            scene: the present state.
        """
        v_vut, v_pov, crash_m = scene.v_vut_mps, scene.v_pov_mps, self.scenario.dx_crash_m
        limit_mps2 = min(-self.scenario.a_min_mps2, CarefulModel.hardest_mps2)
        t_s = scene.distance_m / np.maximum(v_vut, SLOWEST_MPS)
        dx_m = scene.dx_at_m(t_s)
        collides_s = t_s + bumper_ttc_s(-dx_m - crash_m, v_pov, v_vut)
        ahead = (scene.x_vut_m > scene.x_pov_m) & (dx_m < crash_m)
        unsafe: Flags = ahead & (collides_s < CarefulModel.critical_ttc_s)
        return self._reaction.acceleration_mps2(unsafe, limit_mps2)


REFERENCE_DRIVERS: dict[str, type[ReferenceVut]] = {
    "careful": CarefulVut,
    "fsm": FsmVut,
    "reg157": Reg157Vut,
    "rss": RssVut,
}
"""The reference drivers by name, as VUTs."""


VUTS = {name: BuiltInVut(driver) for name, driver in REFERENCE_DRIVERS.items()}
