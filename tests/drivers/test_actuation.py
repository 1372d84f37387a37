"""The actuator between a driver and its vehicle, against values by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.scenes import scene_of

from merge_sumo.drivers.actuation import ActuatedDriver
from merge_sumo.drivers.base import Driver
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.imperfection import Actuation
from merge_sumo.scenario.scenario import US23


class Commands(Driver):
    """Commands accelerations by step, the same in all corridors."""

    def __init__(self, commands, corridors=1):
        super().__init__(corridors)
        self._commands = list(commands)

    def act(self, scene):
        return np.full(self.corridors, self._commands.pop(0))


def executed(commands, v_mps=20.0, **act):
    """Return the accelerations of a vehicle, and which of its commands were clipped."""
    actuation = Actuation(**act)
    driver = ActuatedDriver(Commands(commands))
    scenario = replace(US23, act=actuation)
    driver.begin(0, Case(level=0, x_pov0_m=-200.0, v_pov0_mps=30.0, scenario=scenario))
    done, clipped = [], []
    for step in range(len(commands)):
        done.append(float(driver.act(scene_of(v_vut_mps=v_mps, step=step))[0]))
        clipped.append(bool(driver.clipped()[0]))
    return done, clipped


def test_a_perfect_actuator_passes_every_bit_on():
    commands = [0.1, -1 / 3, 2.0, -4.0, 1e-17]
    assert executed(commands)[0] == commands


def test_a_dead_time_shifts_the_commands():
    commands = [1.0, -1.0, 0.5, 2.0, -4.0, 0.0]
    assert executed(commands, delay_s=0.3)[0] == [0.0, 0.0, 0.0, 1.0, -1.0, 0.5]


def test_a_part_of_a_step_is_a_mean_of_two_commands():
    assert executed([1.0, 2.0, -4.0, 0.0], delay_s=0.125)[0] == [0.0, 0.75, 1.75, -2.5]


@pytest.mark.parametrize("lag_s", [0.2, 0.355])
def test_speeds_after_a_lag_are_those_of_the_continuous_one(lag_s):
    done, _ = executed([-4.0] * 12, lag_s=lag_s)
    t_s = 0.1 * np.arange(1, 13)
    speed = -4.0 * (t_s - lag_s * (1.0 - np.exp(-t_s / lag_s)))
    assert 0.1 * np.cumsum(done) == pytest.approx(speed, abs=1e-12)


def test_power_limits_acceleration_at_speed_and_never_braking():
    assert executed([2.0, -4.0, 0.5], v_mps=25.0, power_w_per_kg=34.0)[0] == [34 / 25, -4.0, 0.5]
    assert executed([2.0], v_mps=0.0, power_w_per_kg=34.0)[0] == [2.0]


def test_a_command_outside_the_limits_counts_as_clipped_before_the_lag():
    done, clipped = executed([-8.0, 1.0, 2.0 + 1e-12, 5.0], lag_s=0.5)
    assert clipped == [True, False, False, True]
    assert min(done) > -4.0


def test_an_answer_that_is_not_finite_passes_at_once():
    done, _ = executed([1.0, np.nan, np.inf], delay_s=1.0, lag_s=0.3)
    assert done[0] == 0.0
    assert np.isnan(done[1])
    assert done[2] == np.inf


def test_an_episode_begins_with_nothing_commanded():
    driver = ActuatedDriver(Commands([2.0] * 4))
    scenario = replace(US23, act=Actuation(delay_s=0.1, lag_s=0.2))
    case = Case(level=0, x_pov0_m=-200.0, v_pov0_mps=30.0, scenario=scenario)
    for _ in range(2):
        driver.begin(0, case)
        assert driver.act(scene_of())[0] == 0.0
        assert driver.act(scene_of())[0] > 0.0
