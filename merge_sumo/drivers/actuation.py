"""An imperfect actuator between a driver and its vehicle: dead time, lag and limited power."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.base import Driver, DriverWrapper, Scene
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S

ROUNDING_MPS2: Final = 1e-9
"""A command this little outside the limits is a rounding error."""
SLOWEST_MPS: Final = 0.1
"""Power over speed is no limit below this speed."""


def whole_steps(time_s: float) -> tuple[int, float]:
    """Return the whole steps of a time, and the share of a step that is left over."""
    steps = round(time_s / DT_S, 9)
    return int(steps), steps % 1.0


class ActuatedDriver(DriverWrapper):
    """Drives as another driver commands, through an actuator that the case describes.

    A command is limited to what the vehicle can do, and waits for the dead time. It then acts
    through a first-order lag, T a' = u - a with a = 0 at the start. As eq. (4) knows one
    acceleration per step, a step has the mean of a over it, so that speeds are those of the
    continuous lag. At last, power over speed limits it.
    """

    def __init__(self, driver: Driver, longest_s: float) -> None:
        """Take the driver, and the longest dead time of its cases."""
        super().__init__(driver)
        corridors = driver.corridors
        self._commands = np.zeros((whole_steps(longest_s)[0] + 2, corridors))
        """The last commands, (D, K), a ring of rows."""
        self._row = 0
        self._wait, self._waits_on = np.zeros(corridors, dtype=np.int64), np.zeros(corridors)
        """Dead time: whole steps, and the share of a further one."""
        self._mean, self._decay = np.zeros(corridors), np.zeros(corridors)
        """What a step leaves of the distance of a from u: in its mean, and at its end."""
        self._power = np.full(corridors, np.inf)
        self._a_mps2 = np.zeros(corridors)
        """The lagged acceleration at the end of the last step."""
        self._a_min, self._a_max = np.zeros(corridors), np.zeros(corridors)
        self._clipped = np.zeros(corridors, dtype=np.bool_)

    def begin(self, corridor: int, case: Case) -> None:
        """Take the actuator of a case, which has commanded nothing so far."""
        act = case.actuation
        self._wait[corridor], self._waits_on[corridor] = whole_steps(act.at_most("delay_s"))
        lag_s = act.at_most("lag_s")
        decay = np.exp(-DT_S / lag_s) if lag_s > 0.0 else 0.0
        self._decay[corridor], self._mean[corridor] = decay, lag_s / DT_S * (1.0 - decay)
        self._power[corridor] = act.at_most("power_w_per_kg")
        self._a_min[corridor] = case.scenario.a_min_mps2
        self._a_max[corridor] = case.scenario.a_max_mps2
        self._commands[:, corridor] = self._a_mps2[corridor] = 0.0
        self._driver.begin(corridor, case)

    def act(self, scene: Scene) -> FloatArray:
        """Return the accelerations of the vehicle, (K,); what is no number is passed on at once."""
        asked = self._driver.act(scene)
        command = np.minimum(np.maximum(asked, self._a_min), self._a_max)
        self._clipped = np.abs(asked - command) > ROUNDING_MPS2
        finite = np.isfinite(asked)
        rows, places, share = len(self._commands), np.arange(self.corridors), self._waits_on
        self._commands[self._row] = np.where(finite, command, 0.0)
        now = self._commands[(self._row - self._wait) % rows, places]
        before = self._commands[(self._row - self._wait - 1) % rows, places]
        self._row = (self._row + 1) % rows
        u = np.where(share > 0.0, (1.0 - share) * now + share * before, now)
        mean = u + (self._a_mps2 - u) * self._mean
        self._a_mps2 = u + (self._a_mps2 - u) * self._decay
        limited = np.minimum(mean, self._power / np.maximum(scene.v_vut_mps, SLOWEST_MPS))
        return np.where(finite, limited, asked)

    def clipped(self) -> NDArray[np.bool_]:
        """Return which of the last commands were outside the limits, (K,)."""
        return self._clipped
