"""Level-0 and rule-based drivers, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from merge_sumo.controllers.built_in import BUILT_IN_VUTS
from merge_sumo.controllers.kinds import load
from merge_sumo.drivers.base import Scene
from merge_sumo.drivers.level0 import Level0Pov, Level0Vut, level0_time_to
from merge_sumo.drivers.rule_based import RuleBasedDesign, RuleBasedVut
from merge_sumo.errors import UserError
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import US23

CASE = Case(level=0, x_pov0_m=-250.0, v_pov0_mps=30.0, scenario=US23)
DESIGN = RuleBasedDesign(x1_m=100.0, x2_m=40.0, gap_m=15.0, target_m=15.0, kp=0.2, ki=0.1, kd=0.05)


def scene(x_pov=-250.0, v_pov=30.0, x_vut=-182.0, v_vut=18.0, step=0):
    columns = [np.atleast_1d(np.asarray(c, dtype=float)) for c in (x_pov, v_pov, x_vut, v_vut)]
    k = max(len(c) for c in columns)
    columns = [np.broadcast_to(c, (k,)).copy() for c in columns]
    return Scene.of_pair(np.ones(k, dtype=bool), np.full(k, step), *columns)


def seconds_to_m(distance, v):
    return float(level0_time_to(np.array(distance), np.array(v), US23))


def pov_that_meets(gap, x_vut, v_vut, v_pov=30.0):
    """Return the POV position from which dx at M is predicted as `gap`."""
    return gap - v_pov * seconds_to_m(-x_vut, v_vut)


class TestLevel0:
    def test_the_pov_keeps_its_speed(self):
        assert Level0Pov(3).act(scene(x_pov=[-300.0, -200.0, 5.0])).tolist() == [0.0, 0.0, 0.0]

    def test_the_vut_accelerates_by_1_until_28_and_meets_it_exactly(self):
        answer = Level0Vut(5).act(scene(v_vut=[0.0, 18.0, 27.95, 28.0, 33.0]))
        assert answer == pytest.approx([1.0, 1.0, 0.5, 0.0, 0.0])

    @pytest.mark.parametrize(
        ("distance", "v", "expected"),
        [
            (0.0, 18.0, 0.0),
            (18.45, 18.0, 1.0),  # 10 steps of 18, 18.1, ... 18.9 m/s
            (229.5, 18.0, 10.0),  # 100 steps: just reaches 28
            (229.5 + 56.0, 18.0, 12.0),  # and two seconds at 28
            (49.5, 0.0, 10.0),  # from a stand
            (56.0, 28.0, 2.0),
            (80.0, 40.0, 2.0),  # faster than 28: keeps its speed
        ],
    )
    def test_time_on_the_level0_profile_by_hand(self, distance, v, expected):
        assert seconds_to_m(distance, v) == pytest.approx(expected, abs=1e-12)


class TestRuleBased:
    def make(self, design=DESIGN, corridors=1):
        vut = RuleBasedVut(corridors, design)
        for k in range(corridors):
            vut.begin(k, CASE)
        return vut

    def test_stage_1_follows_the_level0_profile_whatever_the_pov_does(self):
        x_pov = pov_that_meets(0.0, -150.0, 20.0)
        assert self.make().act(scene(x_pov, 30.0, -150.0, 20.0)).tolist() == [1.0]

    @pytest.mark.parametrize("gap", [-14.9, 0.0, 14.9])
    def test_stage_2_coasts_when_it_will_be_too_close(self, gap):
        x_pov = pov_that_meets(gap, -80.0, 20.0)
        assert self.make().act(scene(x_pov, 30.0, -80.0, 20.0)).tolist() == [0.0]

    @pytest.mark.parametrize("gap", [-15.1, 15.1])
    def test_stages_2_and_3_follow_the_profile_when_the_gap_is_wide_enough(self, gap):
        for x_vut in (-80.0, -20.0):
            x_pov = pov_that_meets(gap, x_vut, 20.0)
            assert self.make().act(scene(x_pov, 30.0, x_vut, 20.0)).tolist() == [1.0]

    @pytest.mark.parametrize(("gap", "expected"), [(12.0, -0.63), (5.0, -2.1), (-5.0, -4.0)])
    def test_stage_3_falls_back_behind_the_pov_on_whichever_side_it_is(self, gap, expected):
        # Errors of -3, -10, -20 m: 0.2 e + 0.1 e * 0.1 s, no rate in the first step.
        x_pov = pov_that_meets(gap, -30.0, 20.0)
        answer = self.make().act(scene(x_pov, 30.0, -30.0, 20.0))
        assert answer == pytest.approx([max(expected, -4.0)])

    def test_the_pid_adds_integral_and_rate_in_the_second_step(self):
        vut = self.make()
        for gap, expected in (
            (5.0, -0.2 * 10 - 0.1 * 1.0),
            (6.0, -0.2 * 9 - 0.1 * 1.9 + 0.05 * 10),
        ):
            x_pov = pov_that_meets(gap, -30.0, 20.0)
            assert vut.act(scene(x_pov, 30.0, -30.0, 20.0)) == pytest.approx([expected])

    def test_an_actuator_with_a_lag_of_a_second_gives_a_tenth_in_the_first_step(self):
        lagged = RuleBasedDesign(x1_m=100, x2_m=40, gap_m=15, target_m=15, kp=0.2, lag_s=1.0)
        vut = self.make(lagged)
        answers = [vut.act(scene()).item() for _ in range(3)]
        assert answers == pytest.approx([0.1, 0.19, 0.271])


def test_every_built_in_vut_makes_a_driver_and_unknown_names_are_refused():
    for name in BUILT_IN_VUTS:
        driver = load(name).open(4)
        for k in range(4):
            driver.begin(k, CASE)
        assert driver.act(scene(x_pov=[-300.0, -250.0, -200.0, -180.0])).shape == (4,)
    with pytest.raises(UserError, match=r"no VUT 'design9': did you mean design[12] or "):
        load("design9")
