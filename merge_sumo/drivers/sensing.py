"""Imperfect sensors between the road and a VUT: age, noise, dropouts, range, blind stretch."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.actuation import whole_steps
from merge_sumo.drivers.base import Driver, DriverWrapper, Scene
from merge_sumo.drivers.following import car_met
from merge_sumo.scenario.case import Case, FloatArray, ToldCase
from merge_sumo.scenario.scenario import DT_S, VUT, Scenario

STREAM: Final = 26
"""Of the random numbers of a case, which others draw from, too."""
X, V, ARRIVES = range(3)
"""Random numbers of a car in a step: errors of position and speed, and whether a state arrives."""


def far_m(scenario: Scenario) -> float:
    """Return the place, out of the way, of a car that a VUT does not see."""
    ahead = 1.0 if scenario.pov_edges == scenario.vut_edges else -1.0
    return scenario.x_vut0_m + ahead * scenario.farthest_start_m


class SensedDriver(DriverWrapper):
    """Drives a VUT by another driver, which sees other cars as the sensors of the case show them.

    In each step every car is measured, with noise, or not seen: it is out of range, or the VUT is
    before the place until which cars are hidden. Of some steps nothing arrives, and the last state
    stays. After the delay the VUT sees what is left. Between two steps a car drives as eq. (4)
    says, at the speed of the step; before the start all drove as they start.

    A car that is not seen is shown where it is in nobody's way, at the speed of the VUT: as far
    behind the start of the VUT as a car may start before M (on a road of one lane, as far ahead of
    it). The VUT's own state is exact and of now.
    """

    def __init__(self, driver: Driver, scenario: Scenario) -> None:
        """Take the driver, and the scenario of its cases."""
        super().__init__(driver)
        corridors, cars = driver.corridors, scenario.vehicles
        self._before = whole_steps(scenario.sense.at_most("delay_s"))[0] + 1
        """Steps before the start that are measured, too."""
        self._seen = np.full((self._before + 1, 2, cars, corridors), np.nan)
        """The last measured positions and speeds, (D, 2, A, K), a ring of rows; NaN if not seen."""
        self._row = 0
        steps = scenario.max_steps + round(scenario.follow_up_s / DT_S) + self._before + 1
        self._is_random = scenario.sense.is_random
        self._random = np.zeros((steps if self._is_random else 1, 3, cars, corridors))
        self._wait, self._drives_on_s = np.zeros(corridors, dtype=np.int64), np.zeros(corridors)
        """Rows back to what the VUT sees, and for how long cars have driven on since."""
        self._noise = np.zeros((2, corridors))
        self._dropout = np.zeros(corridors)
        self._range_m = np.full(corridors, np.inf)
        self._occluded_until_m = np.full(corridors, -np.inf)
        self._far_m = np.zeros(corridors)
        self._level0 = np.ones((2, corridors))
        """Acceleration and speed of the level-0 profile."""

    def begin(self, corridor: int, case: Case) -> None:
        """Take the sensors of a case; the driver is told the start as they show it."""
        scenario = case.scenario
        sense = case.sensing
        whole, share = whole_steps(sense.at_most("delay_s"))
        self._wait[corridor] = whole + (share > 0.0)
        self._drives_on_s[corridor] = (1.0 - share) * DT_S if share > 0.0 else 0.0
        self._noise[:, corridor] = sense.at_most("noise_x_m"), sense.at_most("noise_v_mps")
        self._dropout[corridor] = sense.at_most("dropout")
        self._range_m[corridor] = sense.at_most("range_m")
        self._occluded_until_m[corridor] = sense.at_most("occluded_until_m", -np.inf)
        self._far_m[corridor] = far_m(scenario)
        self._level0[:, corridor] = scenario.level0_a_mps2, scenario.level0_v_mps
        if self._is_random:
            rng = np.random.default_rng([STREAM, case.seed])
            steps, _, cars, _ = self._random.shape
            self._random[:, :ARRIVES, :, corridor] = rng.standard_normal((steps, 2, cars))
            self._random[:, ARRIVES, :, corridor] = rng.random((steps, cars))
        x_m, v_mps = np.array(case.starts()).T
        one = slice(corridor, corridor + 1)
        for step in range(-self._before, 1):
            state = x_m + v_mps * (step * DT_S), v_mps
            self._measure(self._row + step, np.array([step]), np.array(state)[..., None], one)
        start = np.array((x_m, v_mps))[..., None]
        told = tuple(map(tuple, self._shown(self._row, start, one)[..., 0].T.tolist()))
        same = {
            name: getattr(case, name)
            for name in ("level", "svo_rad", "v_vut0_mps", "draw", "scenario")
        }
        self._driver.begin(corridor, ToldCase(told=told, **same))

    def act(self, scene: Scene) -> FloatArray:
        """Return the answers of the driver to what it sees, (K,)."""
        state, everywhere = np.array((scene.x_m, scene.v_mps)), slice(None)
        self._measure(self._row, scene.step, state, everywhere)
        x_m, v_mps = self._shown(self._row, state, everywhere)
        self._row += 1
        facing = scene.facing
        if facing is not None:
            facing = car_met(x_m, v_mps, *self._level0)
        return self._driver.act(scene._replace(x_m=x_m, v_mps=v_mps, facing=facing))

    def _measure(
        self, row: int, step: NDArray[np.int64], state: FloatArray, corridors: slice
    ) -> None:
        """Measure states, (2, A, K), of corridors at their steps, (K,), into a row."""
        rows = len(self._seen)
        places = np.arange(self.corridors)[corridors]
        number = step + self._before
        is_first, number = number == 0, np.minimum(number, len(self._random) - 1)
        random = self._random[number, :, :, places].transpose(1, 2, 0)
        seen = state + self._noise[:, None, corridors] * random[:ARRIVES]
        seen[V] = np.maximum(seen[V], 0.0)
        x_vut_m = state[X, VUT]
        hidden = np.abs(state[X] - x_vut_m) > self._range_m[corridors]
        hidden |= x_vut_m < self._occluded_until_m[corridors]
        seen[:, hidden] = np.nan
        # Before the first step nothing has arrived that could stay.
        lost = (random[ARRIVES] < self._dropout[corridors]) & ~is_first
        last = self._seen[(row - 1) % rows][..., corridors]
        self._seen[row % rows][..., corridors] = np.where(lost, last, seen)

    def _shown(self, row: int, state: FloatArray, corridors: slice) -> FloatArray:
        """Return the states that VUTs see, (2, A, K), at a row with the states (2, A, K)."""
        places = np.arange(self.corridors)[corridors]
        back = (row - self._wait[corridors]) % len(self._seen)
        shown: FloatArray = self._seen[back, :, :, places].transpose(1, 2, 0)
        shown[X] += shown[V] * self._drives_on_s[corridors]
        unseen = np.isnan(shown[X])
        shown[X] = np.where(unseen, self._far_m[corridors], shown[X])
        shown[V] = np.where(unseen, state[V, VUT], shown[V])
        shown[:, VUT] = state[:, VUT]
        return shown
