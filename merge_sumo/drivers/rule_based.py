"""The three-stage rule-based VUT of Wang et al., section VII-A."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from merge_sumo.drivers.base import BuiltInVut, Design, Scene
from merge_sumo.drivers.level0 import Level0Vut, level0_time_to
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S


@dataclass(frozen=True, kw_only=True, slots=True)
class RuleBasedDesign(Design):
    """Parameters of a rule-based VUT.

    Attributes:
        x1_m: distance before M at which stage 2 begins.
        x2_m: distance before M at which stage 3 begins; beyond `x1_m`, with stage 2.
        gap_m: a predicted |dx| at M below this is "too close".
        target_m: the dx at M that the PID of stage 3 aims at; positive, so the VUT yields.
        kp: proportional gain, m/s2 per m of gap error.
        ki: integral gain, m/s2 per m s.
        kd: derivative gain, m/s2 per m/s.
        lag_s: time constant of a first-order actuator; 0 for none.
    """

    x1_m: float
    x2_m: float
    gap_m: float
    target_m: float
    kp: float
    ki: float = 0.0
    kd: float = 0.0
    lag_s: float = 0.0


DESIGNS = {
    "design1": RuleBasedDesign(x1_m=96.1, x2_m=30.8, gap_m=13.7, target_m=13.8, kp=0.683, kd=0.252),
    "design2": RuleBasedDesign(
        x1_m=139.1, x2_m=22.3, gap_m=16.2, target_m=9.43, kp=1.4, lag_s=0.355
    ),
}
"""Found by `tools/calibrate.py`: `design1` reacts late, `design2` sooner and harder."""


class RuleBasedVut(Level0Vut):
    """A VUT that follows the level-0 profile, coasts for a short gap, then regulates the gap.

    All stages predict dx at M with the POV at constant speed and the VUT on the level-0 profile.
    Before x1 the VUT follows that profile. From x1 to x2 it coasts while the predicted |dx| is too
    small. From x2 on it then sets its acceleration by a PID on the predicted dx, towards +target:
    it gives way and falls back behind the POV.

    Example:
        driver = RuleBasedVut(corridors=1, design=DESIGNS["design2"])

    Attributes:
        design: the parameters.
    """

    def __init__(self, corridors: int, design: RuleBasedDesign) -> None:
        """Begin in stage 1 in all corridors.

        Args:
            corridors: number of corridors, K.
            design: the parameters.
        """
        super().__init__(corridors)
        self.design = design
        self._integral = np.zeros(corridors)
        self._last_error = np.zeros(corridors)
        self._regulated = np.zeros(corridors, dtype=bool)
        self._actuator = np.zeros(corridors)

    def begin(self, corridor: int, case: Case) -> None:
        """Reset the PID and the actuator of a corridor.

        Args:
            corridor: index of the corridor.
            case: the case of the next episode.
        """
        super().begin(corridor, case)
        self._regulated[corridor] = False
        self._actuator[corridor] = 0.0

    def act(self, scene: Scene) -> FloatArray:
        """Return the commanded acceleration, (K,), after the lag of the actuator.

        Args:
            scene: the present state.
        """
        design = self.design
        distance = scene.distance_m
        dx_at_m = scene.dx_at_m(level0_time_to(distance, scene.v_vut_mps, self.scenario))
        command = super().act(scene)
        too_close = (np.abs(dx_at_m) < design.gap_m) & (distance <= design.x1_m)
        command[too_close] = 0.0
        regulate = too_close & (distance <= design.x2_m)
        command = np.where(regulate, self._pid(dx_at_m), command)
        self._regulated = regulate
        if design.lag_s <= 0.0:
            return command
        self._actuator = self._actuator + (command - self._actuator) * min(DT_S / design.lag_s, 1.0)
        return self._actuator

    def _pid(self, dx_at_m: FloatArray) -> FloatArray:
        """Return the PID's acceleration; integral and rate start at 0 when it takes over."""
        design = self.design
        error = dx_at_m - design.target_m
        self._integral = self._integral * self._regulated + error * DT_S
        rate = (error - self._last_error) * self._regulated / DT_S
        self._last_error = error
        pid = design.kp * error + design.ki * self._integral + design.kd * rate
        return np.clip(pid, self.scenario.a_min_mps2, self.scenario.a_max_mps2)


VUTS = {name: BuiltInVut(RuleBasedVut, design) for name, design in DESIGNS.items()}
