"""What a controller can know when it decides: the inputs of the model of the controller."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.following import car_met
from merge_sumo.drivers.levelk import prospects
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import AHEAD, BEHIND, POV, VUT, Scenario

Inputs = NDArray[np.float32]
"""As trees read them."""

LAGS: Final = (3, 6, 10)
"""Steps, 0.3, 0.6 and 1 s, after which a slow controller may answer to a state."""
EARLIER: Final = 4
"""Accelerations before the last one that are looked at."""
DEPTH: Final = max(*LAGS, EARLIER) + 1
JUMP_MPS2: Final = 0.25
"""A change of the acceleration within a step that is a new decision."""
GAP_SCALE: Final = 80.0
"""Gaps at M are compressed beyond so many m: what happens near 0 decides."""
NOW: Final = 17
"""Inputs of the present state where there is one car on the mainline,"""
OF_EACH_CAR: Final = 2
"""what comes on top for each where there are several,"""
HISTORY: Final = 4 + EARLIER + 4 * len(LAGS)
"""and inputs of what was before."""


class Observation:
    """Sees R episodes step by step and gives what the VUT may decide by.

    What it knows now is the state, the last acceleration and what follows from them. A controller
    with a delay or a memory decides also by what was before.
    """

    def __init__(self, scenario: Scenario, rows: int) -> None:
        """Begin `rows` episodes of a scenario."""
        self._scenario = scenario
        cars = scenario.vehicles - 1
        self.now = NOW + (1 + OF_EACH_CAR * cars if cars > 1 else 0)
        """How many of the inputs are those of the present."""
        self._step = 0
        self._inputs: Inputs = np.empty((self.now + HISTORY, rows), dtype=np.float32)
        self._past: Inputs = np.empty((DEPTH, 5, rows), dtype=np.float32)
        self._since_jump = np.zeros(rows)
        self._lowest = np.zeros(rows)
        self._highest = np.zeros(rows)

    def keep(self, rows: NDArray[np.bool_]) -> None:
        """Forget all episodes but some."""
        self._inputs, self._past = self._inputs[:, rows], self._past[:, :, rows]
        self._since_jump, self._lowest = self._since_jump[rows], self._lowest[rows]
        self._highest = self._highest[rows]

    def see(self, x_m: FloatArray, v_mps: FloatArray, a_last_mps2: FloatArray) -> Inputs:
        """Take the next states, (A, R), and the last accelerations of the VUT, (R,).

        Returns:
            (R, inputs): first those of the present, `now` of them, then those of the past. They
            are good until the next call.
        """
        scenario, inputs, past, t = self._scenario, self._inputs, self._past, self._step
        x_pov, v_pov, x_vut, v_vut = x_m[POV], v_mps[POV], x_m[VUT], v_mps[VUT]
        if len(x_m) > 2:
            met = car_met(x_m, v_mps, scenario.level0_a_mps2, scenario.level0_v_mps)
            place = np.arange(x_m.shape[1])
            x_pov, v_pov = x_m[met, place], v_mps[met, place]
            inputs[NOW] = met
            for number, car in enumerate((POV, AHEAD, BEHIND)):
                row = NOW + 1 + OF_EACH_CAR * number
                inputs[row], inputs[row + 1] = x_m[car] - x_vut, v_mps[car]
        times, gaps, v_level0, v_full = prospects(x_pov, v_pov, x_vut, v_vut, scenario)
        inputs[0], inputs[1], inputs[2] = a_last_mps2, x_pov - x_vut, v_pov - v_vut
        inputs[3], inputs[4], inputs[5], inputs[6] = x_pov, v_pov, x_vut, v_vut
        inputs[7:10] = times
        near = np.array(gaps)
        inputs[10:15] = near / (1.0 + np.abs(near) / GAP_SCALE)
        inputs[15], inputs[16] = v_level0, v_full
        # The five that are remembered.
        remembered = inputs[[1, 2, 10, 6, 0]]
        if t == 0:
            past[:] = remembered
        jumped = np.abs(remembered[4] - past[(t - 1) % DEPTH, 4]) > JUMP_MPS2
        past[t % DEPTH] = remembered
        self._since_jump = np.where(jumped, 0.0, self._since_jump + 1.0)
        self._lowest = np.minimum(self._lowest, a_last_mps2)
        self._highest = np.maximum(self._highest, a_last_mps2)
        first = self.now
        inputs[first] = t
        inputs[first + 1] = self._since_jump
        inputs[first + 2], inputs[first + 3] = self._lowest, self._highest
        first += 4
        for lag in range(1, EARLIER + 1):
            inputs[first] = past[(t - lag) % DEPTH, 4]
            first += 1
        for lag in LAGS:
            inputs[first : first + 4] = past[(t - lag) % DEPTH, :4]
            first += 4
        self._step += 1
        return inputs.T
