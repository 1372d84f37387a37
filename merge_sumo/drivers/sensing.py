"""Imperfect sensors between the road and a VUT: delay, noise, dropouts, range, occlusion."""

from __future__ import annotations

import numpy as np

from merge_sumo.drivers.actuation import whole_steps
from merge_sumo.drivers.base import Driver, DriverWrapper, Scene
from merge_sumo.drivers.car_following import conflicting_car
from merge_sumo.scenario.case import Case, FloatArray, ObservedCase
from merge_sumo.scenario.scenario import DT_S, VUT, Scenario

X, V = range(2)
"""Rows of a state."""


def far_m(scenario: Scenario) -> float:
    """Return the distant position at which a hidden car is shown, in m.

    Args:
        scenario: the scenario.
    """
    ahead = 1.0 if scenario.mainline == scenario.ramp else -1.0
    return scenario.x_vut0_m + ahead * scenario.farthest_start_m


class _Sensors:
    """The sensors of one episode, and their measurements so far.

    A state has the positions and the speeds of the A vehicles, (2, A).
    """

    def __init__(self, case: Case) -> None:
        """Measure the start, and the steps before it, in which all keep their first speeds."""
        scenario, sense = case.scenario, case.sensing
        self._before = whole_steps(scenario.sense.at_most("delay_s"))[0] + 1
        self._far_m = far_m(scenario)
        whole, share = whole_steps(sense.at_most("delay_s"))
        self._late_steps = whole + (share > 0.0)
        self._drives_on_s = (1.0 - share) * DT_S if share > 0.0 else 0.0
        self._noise = np.array([[sense.at_most("noise_x_m")], [sense.at_most("noise_v_mps")]])
        self._dropout, self._range_m = sense.at_most("dropout"), sense.at_most("range_m")
        self._occluded_until_m = sense.at_most("occluded_until_m", -np.inf)
        steps = scenario.max_steps + round(scenario.follow_up_s / DT_S) + self._before + 1
        rng = np.random.default_rng([26, case.seed])  # a stream of its own
        self._errors = rng.standard_normal((steps, 2, scenario.vehicles))
        self._arrives = rng.random((steps, scenario.vehicles))
        self._measured: list[FloatArray] = []
        x_m, v_mps = np.array(case.starts()).T
        for step in range(-self._before, 1):
            self.start = np.array((x_m + v_mps * (step * DT_S), v_mps))
            self.measure(step, self.start)

    def measure(self, step: int, state: FloatArray) -> None:
        """Measure a state, with NaN for hidden cars."""
        row = step + self._before
        del self._measured[row:]  # the start is measured again as the first step
        seen = state + self._noise * self._errors[row]
        seen[V] = np.maximum(seen[V], 0.0)
        hidden = np.abs(state[X] - state[X, VUT]) > self._range_m
        hidden |= state[X, VUT] < self._occluded_until_m
        seen[:, hidden] = np.nan
        if row > 0:  # before, nothing has arrived that could stay
            lost = self._arrives[row] < self._dropout
            seen = np.where(lost, self._measured[-1], seen)
        self._measured.append(seen)

    def shown(self, state: FloatArray) -> FloatArray:
        """Return the state that the VUT sees when the vehicles are in a state, (2, A) each."""
        shown = self._measured[-1 - self._late_steps].copy()
        shown[X] += shown[V] * self._drives_on_s
        unseen = np.isnan(shown[X])
        shown[X, unseen], shown[V, unseen] = self._far_m, state[V, VUT]
        shown[:, VUT] = state[:, VUT]
        return shown


class SensedDriver(DriverWrapper):
    """Drives a VUT by another driver, which sees other cars through the sensors of the case.

    In each step every car is measured with noise, or it is hidden: out of range, or occluded until
    the VUT has passed a position. Some measurements are lost, and the last one stays. After the
    delay the VUT sees the rest. Between two steps, and before the start, a car keeps its speed.

    A hidden car is shown out of the way, at the speed of the VUT: as far behind the start of the
    VUT as a car may start before M (on a road of one lane, as far ahead of it). The VUT's own state
    is exact and has no delay.

    Example:
        driver = SensedDriver(RuleBasedVut(1, DESIGNS["design2"]))
    """

    def __init__(self, driver: Driver) -> None:
        """Wrap a driver.

        Args:
            driver: sees what the sensors show.
        """
        super().__init__(driver)
        self._sensors: dict[int, _Sensors] = {}

    def begin(self, corridor: int, case: Case) -> None:
        """Take the sensors of a case; the driver begins with the start that they show.

        Args:
            corridor: index of the corridor.
            case: the case of the next episode.
        """
        self._sensors[corridor] = sensors = _Sensors(case)
        shown = ObservedCase(
            observed=tuple(map(tuple, sensors.shown(sensors.start).T.tolist())),
            level=case.level,
            svo_rad=case.svo_rad,
            v_vut0_mps=case.v_vut0_mps,
            draw=case.draw,
            scenario=case.scenario,
        )
        super().begin(corridor, shown)

    def act(self, scene: Scene) -> FloatArray:
        """Return the answers of the driver to the scene that it sees, (K,).

        Args:
            scene: the present state.
        """
        x_m, v_mps, conflicting = scene.x_m.copy(), scene.v_mps.copy(), scene.conflicting
        for corridor in np.flatnonzero(scene.active).tolist():
            sensors = self._sensors[corridor]
            state = np.array((scene.x_m[:, corridor], scene.v_mps[:, corridor]))
            sensors.measure(int(scene.step[corridor]), state)
            x_m[:, corridor], v_mps[:, corridor] = sensors.shown(state)
        if conflicting is not None:
            conflicting = conflicting_car(x_m, v_mps, self.scenario)
        return self._driver.act(scene._replace(x_m=x_m, v_mps=v_mps, conflicting=conflicting))
