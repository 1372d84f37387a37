"""The VUT that accepts gaps: exact answers by hand, at the numbers of the roundabout."""

from __future__ import annotations

import numpy as np
import pytest
from support.scenes import scene_of

from merge_sumo.drivers.gap_acceptance import ROUNDABOUT, GapAcceptanceVut
from merge_sumo.drivers.level0 import level0_time_to
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.case import Case

SCENARIO = named_scenario("roundabout")
CASE = Case(level=0, x_pov0_m=-50.0, v_pov0_mps=8.0, v_vut0_mps=6.0, scenario=SCENARIO)


@pytest.fixture
def vut():
    made = GapAcceptanceVut(1)
    made.begin(0, CASE)
    return made


def due_s(x_vut_m, v_vut_mps):
    """Return when the VUT is due at M: 1 m/s2 up to 8 m/s."""
    return float(level0_time_to(np.array(-x_vut_m), np.array(v_vut_mps), SCENARIO))


def answer(vut, x_vut_m, v_vut_mps, later_s):
    """Return the acceleration where a POV of 8 m/s is due at M so much later than the VUT."""
    x_pov_m = -8.0 * (due_s(x_vut_m, v_vut_mps) + later_s)
    return float(vut.act(scene_of(x_pov_m, 8.0, x_vut_m, v_vut_mps))[0])


class TestAGap:
    @pytest.mark.parametrize(
        ("later_s", "a_mps2"), [(1.81, 1.0), (1.79, 0.0), (0.0, 0.0), (-1.99, 0.0), (-2.01, 1.0)]
    )
    def test_is_taken_where_both_are_due_at_different_times(self, vut, later_s, a_mps2):
        assert answer(vut, -50.0, 6.0, later_s) == a_mps2

    def test_is_taken_once_and_for_all(self, vut):
        assert answer(vut, -50.0, 6.0, 5.0) == 1.0
        assert answer(vut, -20.0, 7.0, 0.0) == 1.0

    def test_is_looked_for_again_in_the_next_episode(self, vut):
        answer(vut, -50.0, 6.0, 5.0)
        vut.begin(0, CASE)
        assert answer(vut, -50.0, 6.0, 0.0) == 0.0

    def test_is_there_before_a_pov_that_stands(self, vut):
        assert vut.act(scene_of(-3.0, 0.0, -7.0, 0.0))[0] == 1.0


class TestWithoutOne:
    def test_it_brakes_as_hard_as_it_takes_to_stop_at_the_line(self, vut):
        # 9 m to the line, of which 0.3 m are driven before braking tells: 6^2 / (2 * 8.7).
        assert answer(vut, -16.0, 6.0, 0.0) == pytest.approx(-36.0 / 17.4)

    def test_it_goes_where_it_cannot_stop_at_the_line_any_more(self, vut):
        # 6^2 / (2 * 4.2) is more than 4 m/s2.
        assert answer(vut, -11.5, 6.0, 0.0) == 1.0

    def test_it_stands_at_the_line_until_there_is_one(self, vut):
        x, v = -50.0, 6.0
        for _ in range(200):
            x, v = x + 0.1 * v, max(v + 0.1 * answer(vut, x, v, 0.0), 0.0)
        assert v == 0.0
        assert x == pytest.approx(-ROUNDABOUT.line_m, abs=0.01)
        assert answer(vut, x, v, -2.5) == 1.0


def test_after_m_where_a_pov_drives_it_accelerates(vut):
    assert vut.act(scene_of(0.0, 8.0, 40.0, 6.0))[0] == 1.0
