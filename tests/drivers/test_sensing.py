"""The sensors between the road and a VUT, against values by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.scenes import scene_of

import merge_sumo as ms
from merge_sumo.drivers.base import Driver, Scene
from merge_sumo.drivers.sensing import SensedDriver, far_m
from merge_sumo.errors import UserError
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.imperfection import Actuation, Sensing
from merge_sumo.scenario.scenario import POV, US23, VUT

FAR_M = -522.0
"""340 m, where a POV may start, behind -182 m, where the VUT starts."""


class Recorder(Driver):
    """Keeps its scenes."""

    def __init__(self, corridors=1):
        super().__init__(corridors)
        self.cases, self.scenes = [], []

    def begin(self, corridor, case):
        self.cases.append(case)

    def act(self, scene):
        self.scenes.append(scene)
        return np.zeros(self.corridors)


def case_with(x_pov0_m=-200.0, v_pov0_mps=30.0, **sense: Any) -> Case:
    scenario = replace(US23, sense=Sensing(**sense))
    return Case(level=0, x_pov0_m=x_pov0_m, v_pov0_mps=v_pov0_mps, scenario=scenario)


def seen_of(case, steps=8, v_vut_mps=18.0):
    """Return the POV as a VUT sees it, (T, 2), as both drive at constant speed; and as it is."""
    inner = Recorder()
    driver = SensedDriver(inner)
    driver.begin(0, case)
    (x_pov, v_pov), (x_vut, _) = case.starts()
    true = []
    for step in range(steps):
        state = x_pov + 0.1 * step * v_pov, v_pov, x_vut + 0.1 * step * v_vut_mps, v_vut_mps
        true.append(state)
        driver.act(scene_of(*state, step=step))
    seen = np.array([[scene.x_pov_m[0], scene.v_pov_mps[0]] for scene in inner.scenes])
    own = np.array([[scene.x_vut_m[0], scene.v_vut_mps[0]] for scene in inner.scenes])
    assert np.array_equal(own, np.array(true)[:, 2:])
    told = inner.cases[0].starts()
    assert told[POV] == tuple(seen[0])
    assert told[VUT] == case.starts()[VUT]
    return seen, np.array(true)[:, :2]


class TestByHand:
    def test_perfect_sensors_change_no_bit(self):
        seen, true = seen_of(case_with(-200.1, 30.3))
        assert np.array_equal(seen, true)

    def test_a_delay_shifts_states_and_the_road_existed_before_the_start(self):
        seen, true = seen_of(case_with(delay_s=0.3))
        assert np.array_equal(seen[3:], true[:-3])
        assert seen[:3, 0] == pytest.approx([-209.0, -206.0, -203.0], abs=1e-12)
        assert (seen[:, 1] == 30.0).all()

    def test_between_two_steps_a_car_drives_by_eq_4(self):
        seen, _ = seen_of(case_with(delay_s=0.25))
        assert seen[:, 0] == pytest.approx(-207.5 + 3.0 * np.arange(8), abs=1e-9)

    def test_noise_has_its_size_and_depends_on_the_case_alone(self):
        case = case_with(noise_x_m=2.0, noise_v_mps=0.5)
        seen, true = seen_of(case, steps=250)
        error = seen - true
        assert error.std(axis=0) == pytest.approx([2.0, 0.5], rel=0.15)
        assert abs(np.corrcoef(error.T)[0, 1]) < 0.2
        assert np.array_equal(seen_of(case, steps=250)[0], seen)
        other, true = seen_of(replace(case, x_pov0_m=-200.5), steps=250)
        assert not np.array_equal(other - true, error)

    def test_after_a_dropout_the_last_state_stays(self):
        seen, true = seen_of(case_with(dropout=0.4), steps=250)
        new = seen[:, 0] == true[:, 0]
        assert new.mean() == pytest.approx(0.6, abs=0.1)
        last = np.maximum.accumulate(np.where(new, np.arange(250), -1))
        from_start = last >= 0
        assert np.array_equal(seen[from_start], true[last[from_start]])
        assert seen_of(case_with(dropout=1.0))[0][:, 0] == pytest.approx(-203.0)

    def test_a_car_out_of_range_is_shown_out_of_the_way_at_the_speed_of_the_vut(self):
        # It comes nearer by 1.2 m a step: 18 m, 16.8 m, 15.6 m, 14.4 m.
        seen, true = seen_of(case_with(range_m=15.0))
        assert seen[:3].tolist() == [[FAR_M, 18.0]] * 3
        assert np.array_equal(seen[3:], true[3:])

    def test_a_gore_hides_cars_until_the_vut_is_there(self):
        # The VUT is at -182, -180.2, -178.4, -176.6 m.
        seen, true = seen_of(case_with(occluded_until_m=-178.0))
        assert seen[:3].tolist() == [[FAR_M, 18.0]] * 3
        assert np.array_equal(seen[3:], true[3:])

    def test_a_car_that_is_not_seen_is_as_far_away_as_one_may_start(self):
        assert far_m(US23) == FAR_M
        one_lane = replace(US23, mainline=("main_in", "main_out"), ramp=("main_in", "main_out"))
        assert far_m(one_lane) == -182.0 + 340.0


def test_in_traffic_the_conflicting_car_is_one_that_is_seen():
    scenario = replace(named_scenario("us23-traffic"), sense=Sensing(range_m=40.0))
    case = Case(
        level=0,
        x_pov0_m=-300.0,
        v_pov0_mps=30.0,
        headway_ahead_s=3.0,
        headway_behind_s=3.0,
        scenario=scenario,
    )
    inner = Recorder()
    driver = SensedDriver(inner)
    driver.begin(0, case)
    x_m, v_mps = np.array(case.starts()).T[..., None]
    conflicting = np.array([POV])
    driver.act(Scene(np.array([True]), np.array([0]), x_m, v_mps, conflicting=conflicting))
    (scene,) = inner.scenes
    # The car ahead, at -210 m, is 28 m away; the POV and the car behind are not seen.
    assert scene.x_m[:, 0].tolist() == [far_m(scenario), -182.0, -210.0, far_m(scenario)]
    assert scene.conflicting.tolist() == [2]


def test_a_vut_of_sumo_takes_no_sensors():
    with pytest.raises(UserError, match="reads other cars from SUMO"):
        ms.run("sumo:IDM", x_pov0_m=-250.0, v_pov0_mps=29.0, sense="delay_s=0.1")


class TestSettings:
    def test_are_recorded_and_run_again(self, tmp_path):
        run = ms.campaign(
            "design2",
            level=0,
            cases=12,
            sense="delay_s=0..0.5,noise_x_m=0.5",
            act=Actuation(lag_s=0.2),
            out=tmp_path / "run",
        )
        recorded = run.recorded.record["scenario"]
        assert recorded["sense"] == {"delay_s": [0.0, 0.5], "noise_x_m": 0.5}
        assert recorded["act"] == {"lag_s": 0.2}
        delays = [row["sense_delay_s"] for row in run.cases]
        assert 0.0 <= min(delays) < 0.2
        assert 0.3 < max(delays) <= 0.5
        assert not ms.rerun(run).worse
        again = ms.run(recorded=(run, 3))
        assert again.measures == run.recorded.outcome(3).measures
        assert "sensing delay" in run.report().read_text(encoding="utf-8")

    @pytest.mark.parametrize(
        ("text", "said"),
        [
            ("delay=1", "`sense`: sensing has no 'delay': it has "),
            ("delay_s=x", "`sense`: delay_s is 'x': it must be a number or two numbers"),
            ("delay_s=9", "`sense`: delay_s is 9: choose 0 to 5"),
            ("delay_s=0.5..0.2", "`sense`: delay_s is 0.5..0.2: write the lower number of a range"),
        ],
    )
    def test_that_are_wrong_are_refused(self, text, said):
        with pytest.raises(UserError) as error:
            ms.run("design2", x_pov0_m=-250.0, v_pov0_mps=29.0, sense=text)
        assert str(error.value).startswith(said)

    def test_of_a_range_need_a_number_in_a_case(self):
        with pytest.raises(UserError, match="`sense_delay_s` is missing"):
            ms.run("design2", x_pov0_m=-250.0, v_pov0_mps=29.0, sense="delay_s=0..1")
        with pytest.raises(UserError, match="`sense_delay_s` is not a coordinate"):
            ms.run("design2", at={"sense_delay_s": 0.1}, x_pov0_m=-250.0, v_pov0_mps=29.0)
