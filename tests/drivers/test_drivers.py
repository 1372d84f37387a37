"""Level-0 and rule-based drivers, by hand."""

from __future__ import annotations

import numpy as np
import pytest
from support.histories import CASE
from support.scenes import scene_of

from merge_sumo.drivers.level0 import Level0Pov, Level0Vut, level0_time_to
from merge_sumo.drivers.rule_based import RuleBasedDesign, RuleBasedVut
from merge_sumo.scenario.scenario import US23

DESIGN = RuleBasedDesign(x1_m=100.0, x2_m=40.0, gap_m=15.0, target_m=15.0, kp=0.2, ki=0.1, kd=0.05)


def seconds_to_m(distance, v):
    return float(level0_time_to(np.array(distance), np.array(v), US23))


def pov_that_meets(gap, x_vut, v_vut, v_pov=30.0):
    """Return the POV position from which dx at M is predicted as `gap`."""
    return gap - v_pov * seconds_to_m(-x_vut, v_vut)


class TestLevel0:
    def test_the_pov_keeps_its_speed(self):
        assert Level0Pov(3).act(scene_of([-300.0, -200.0, 5.0])).tolist() == [0.0, 0.0, 0.0]

    def test_the_vut_accelerates_by_1_until_28_and_meets_it_exactly(self):
        answer = Level0Vut(5).act(scene_of(v_vut_mps=[0.0, 18.0, 27.95, 28.0, 33.0]))
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
    def make(self, design=DESIGN):
        vut = RuleBasedVut(1, design)
        vut.begin(0, CASE)
        return vut

    @pytest.mark.parametrize(
        ("gap", "x_vut", "expected"),
        [
            (0.0, -150.0, 1.0),  # stage 1 follows the level-0 profile
            (-14.9, -80.0, 0.0),  # stage 2 coasts when it will be too close
            (14.9, -80.0, 0.0),
            (-15.1, -80.0, 1.0),  # stages 2 and 3 follow the profile when the gap is wide
            (15.1, -20.0, 1.0),
            # Stage 3 falls back behind the POV. Errors of -3, -10, -20 m: 0.2 e + 0.1 e * 0.1 s, no
            # rate in the first step.
            (12.0, -30.0, -0.63),
            (5.0, -30.0, -2.1),
            (-5.0, -30.0, -4.0),
        ],
    )
    def test_the_first_answer_in_each_stage(self, gap, x_vut, expected):
        x_pov = pov_that_meets(gap, x_vut, 20.0)
        answer = self.make().act(scene_of(x_pov, 30.0, x_vut, 20.0))
        assert answer == pytest.approx([expected])

    def test_the_pid_adds_integral_and_rate_in_the_second_step(self):
        vut = self.make()
        for gap, expected in (
            (5.0, -0.2 * 10 - 0.1 * 1.0),
            (6.0, -0.2 * 9 - 0.1 * 1.9 + 0.05 * 10),
        ):
            x_pov = pov_that_meets(gap, -30.0, 20.0)
            assert vut.act(scene_of(x_pov, 30.0, -30.0, 20.0)) == pytest.approx([expected])

    def test_an_actuator_with_a_lag_of_a_second_gives_a_tenth_in_the_first_step(self):
        lagged = RuleBasedDesign(x1_m=100, x2_m=40, gap_m=15, target_m=15, kp=0.2, lag_s=1.0)
        vut = self.make(lagged)
        answers = [vut.act(scene_of()).item() for _ in range(3)]
        assert answers == pytest.approx([0.1, 0.19, 0.271])
