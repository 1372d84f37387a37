"""An imperfect actuator between a driver and its vehicle: dead time, lag and limited power."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.base import Driver, DriverWrapper, Scene
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S

ROUNDING_MPS2 = 1e-9
"""Smaller differences between a command and a limit are rounding errors."""


def whole_steps(time_s: float) -> tuple[int, float]:
    """Return the whole steps of a time, and the rest as a share of a step.

    Args:
        time_s: a time.
    """
    steps = round(time_s / DT_S, 9)
    return int(steps), steps % 1.0


class _Actuator:
    """The actuator of one episode.

    Attributes:
        is_clipped: whether the last command was outside the limits.
    """

    def __init__(self, case: Case) -> None:
        """Take the actuator of a case, without commands so far."""
        act = case.actuation
        wait, self._share = whole_steps(act.at_most("delay_s"))
        self._commands = [0.0] * (wait + 2)
        """Commands in the dead time, the oldest first."""
        lag_s = act.at_most("lag_s")
        # Shares of the distance of a from u at the end of a step, and in its mean.
        self._decay = float(np.exp(-DT_S / lag_s)) if lag_s > 0.0 else 0.0
        self._mean = lag_s / DT_S * (1.0 - self._decay)
        self._power = act.at_most("power_w_per_kg")
        self._low_mps2, self._high_mps2 = case.scenario.a_min_mps2, case.scenario.a_max_mps2
        self._a_mps2 = 0.0
        self.is_clipped = False

    def mean_mps2(self, command_mps2: float, v_mps: float) -> float:
        """Return the mean acceleration of the next step for a command at a speed.

        Power over speed limits it, at speeds from 0.1 m/s up.
        """
        command = min(max(command_mps2, self._low_mps2), self._high_mps2)
        self.is_clipped = abs(command_mps2 - command) > ROUNDING_MPS2
        self._commands = [*self._commands[1:], command]
        before, now, *_ = self._commands
        u = (1.0 - self._share) * now + self._share * before if self._share > 0.0 else now
        mean = u + (self._a_mps2 - u) * self._mean
        self._a_mps2 = u + (self._a_mps2 - u) * self._decay
        return min(mean, self._power / max(v_mps, 0.1))


class ActuatedDriver(DriverWrapper):
    """Drives by the commands of another driver, through the actuator of the case.

    A command is limited to the accelerations of the vehicle, and waits for the dead time. It then
    acts through a first-order lag, T a' = u - a with a = 0 at the start. Eq. (4) has one
    acceleration per step: the mean of a over the step, so that speeds are those of the continuous
    lag. Finally, power over speed limits it.

    Example:
        driver = ActuatedDriver(RuleBasedVut(1, DESIGNS["design2"]))
    """

    def __init__(self, driver: Driver) -> None:
        """Wrap a driver.

        Args:
            driver: gives the commands.
        """
        super().__init__(driver)
        self._actuators: dict[int, _Actuator] = {}
        self._clipped = np.zeros(driver.corridors, dtype=np.bool_)

    def begin(self, corridor: int, case: Case) -> None:
        """Take the actuator of a case.

        Args:
            corridor: index of the corridor.
            case: the case of the next episode.
        """
        self._actuators[corridor] = _Actuator(case)
        super().begin(corridor, case)

    def act(self, scene: Scene) -> FloatArray:
        """Return the accelerations of the vehicle, (K,); NaN and infinity pass at once.

        Args:
            scene: the present state.
        """
        answers = np.array(self._driver.act(scene))
        self._clipped[:] = False
        for corridor in np.flatnonzero(scene.active & np.isfinite(answers)).tolist():
            actuator = self._actuators[corridor]
            v_mps, command_mps2 = float(scene.v_vut_mps[corridor]), float(answers[corridor])
            answers[corridor] = actuator.mean_mps2(command_mps2, v_mps)
            self._clipped[corridor] = actuator.is_clipped
        return answers

    def clipped(self) -> NDArray[np.bool_]:
        """Return which of the last commands were outside the limits, (K,)."""
        return self._clipped
