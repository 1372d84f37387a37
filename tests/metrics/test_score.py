"""The score and the named measures, by hand."""

# mypy: no-strict-optional

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from metrics.test_timeline import drive
from support.histories import CASE

from merge_sumo.metrics.measures import Measures, sustained_brake_mps2
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.paper import FAILURE_SCORE, time_to_collision
from merge_sumo.scenario.scenario import DT_S, POV, VUT
from merge_sumo.scenario.trajectory import End, Trajectory


def ending(dx, v_pov=30.0, v_vut=26.0, end=End.MERGED, steps=10, a_vut=0.0):
    """Return an episode at constant speeds in which the VUT is 1 m past M at the end."""
    t = np.arange(-steps, 1) * DT_S
    motion = np.zeros((steps + 1, 2, 3))
    motion[:, POV, 0], motion[:, POV, 1] = 1.0 + dx + v_pov * t, v_pov
    motion[:, VUT, 0], motion[:, VUT, 1] = 1.0 + v_vut * t, v_vut
    motion[:-1, VUT, 2] = a_vut
    return Trajectory(CASE, motion, end)


def eq4(x_pov, v_pov, a_pov, x_vut, v_vut, a_vut):
    """Return the episode of eq. (4) with constant accelerations, until the VUT is at M."""
    steps = np.ones(301)
    pov, vut = drive(x_pov, v_pov, a_pov * steps), drive(x_vut, v_vut, a_vut * steps)
    arrived = np.flatnonzero(vut[:, 0] >= 0.0)
    last = arrived[0] if arrived.size else 300
    motion = np.stack([pov, vut], axis=1)[: last + 1]
    motion[-1, :, 2] = 0.0
    return Trajectory(CASE, motion, End.MERGED if arrived.size else End.TIMEOUT)


class TestScore:
    def test_the_safety_part_by_hand(self):
        # |dx| = 21 m: exp(-1) of 8/9 of 450; POV ahead and faster, so no TTC.
        assert Measures.of(ending(21.0)).score == pytest.approx(-400.0 * math.exp(-1.0))
        # POV 21 m behind and 6 m/s faster: TTC 3.5 s costs half of 50.
        score = Measures.of(ending(-21.0, v_pov=32.0)).score
        assert score == pytest.approx(-400.0 * math.exp(-1.0) - 25.0)

    def test_a_collision_costs_more_the_deeper_it_is(self):
        # -110 for the crash, -450 (1 + overlap / 6).
        assert Measures.of(ending(3.0)).score == pytest.approx(-110.0 - 450.0 * 1.5)
        assert Measures.of(ending(0.0)).score == pytest.approx(-110.0 - 900.0)

    def test_the_task_part_by_hand(self):
        # Final speed 14.6 m/s: 10 below the highway's; the rest of the task is done.
        score = Measures.of(ending(300.0, v_pov=14.6, v_vut=14.6)).score
        assert score == pytest.approx(-45.0 / 4 * 10 / 24.6, abs=0.01)
        # Braking by 4 m/s2 throughout, but for the last row.
        score = Measures.of(ending(300.0, v_pov=26.0, a_vut=-4.0)).score
        assert score == pytest.approx(-45.0 / 4 * 10 / 11, abs=0.01)

    def test_a_timeout_is_no_failure_and_has_no_gap(self):
        trajectory = eq4(-250.0, 30.0, 0.0, -182.0, 0.0, 0.0)
        measures = Measures.of(trajectory)
        assert measures.end is End.TIMEOUT
        gaps = (measures.dx_m, measures.ttc_s, measures.pet_s, measures.merged_first)
        assert gaps == (None, None, None, None)
        # Standing for 30 s: fully slow, off the range, and not done: three quarters of 45.
        assert measures.score == pytest.approx(-45.0 * 3 / 4)

    @given(
        dx=st.floats(-60.0, 60.0),
        v_pov=st.floats(0.0, 95.0),
        v_vut=st.floats(0.1, 80.0),
        a_vut=st.floats(-4.0, 2.0),
    )
    def test_below_minus_500_exactly_when_there_is_a_collision(self, dx, v_pov, v_vut, a_vut):
        trajectory = ending(dx, v_pov, v_vut, a_vut=a_vut)
        measures = Measures.of(trajectory)
        last = trajectory.motion[-1]
        assert measures.score <= 0.0
        assert (measures.score < FAILURE_SCORE) == (abs(last[POV, 0] - last[VUT, 0]) < 6.0)
        assert Outcome(0, 0, CASE, measures).failed == measures.is_close

    def test_no_verdict_on_what_did_not_run_properly(self):
        for end in (End.VUT_ERROR, End.SIM_ERROR):
            trajectory = Trajectory(CASE, ending(0.0).motion, end, "why")
            measures = Measures.of(trajectory)
            assert measures.score is None
            assert measures.end is end
            assert measures.error == "why"
            assert not Outcome(0, 0, CASE, measures).failed


class TestMeasures:
    def test_time_to_collision_is_finite_only_when_the_gap_closes(self):
        assert time_to_collision(-20.0, 5.0) == pytest.approx(4.0)  # POV behind, faster
        assert time_to_collision(20.0, -5.0) == pytest.approx(4.0)  # POV ahead, slower
        assert time_to_collision(20.0, 5.0) is None
        assert time_to_collision(-20.0, 0.0) is None

    @pytest.mark.parametrize(
        ("trajectory", "name", "value"),
        [
            # The POV is 15 m before M when the VUT is 1 m past it: 1/26 s earlier it was there.
            (ending(-16.0, v_pov=30.0, v_vut=26.0), "pet_s", 0.5 + 1 / 26),
            (ending(29.0, v_pov=30.0), "pet_s", 1.0 - 1 / 26),
            (ending(-30.0, v_pov=0.0), "pet_s", None),
            # POV 26 m behind and 4 m/s faster: 16 / (2 * 20).
            (ending(-26.0), "drac_mps2", 0.4),
            (ending(26.0), "drac_mps2", 0.0),
            (ending(2.0), "drac_mps2", None),
            (ending(-30.0), "merged_first", "VUT"),
            (ending(30.0), "merged_first", "POV"),
            (ending(-30.0), "impact_speed_mps", None),
            (ending(-3.0), "impact_speed_mps", 4.0),
            (eq4(-300.0, 30.0, -1.5, -50.0, 20.0, -2.5), "pov_max_brake_mps2", 1.5),
            (eq4(-300.0, 30.0, -1.5, -50.0, 20.0, -2.5), "vut_max_brake_mps2", 2.5),
            (eq4(-300.0, 30.0, 1.0, -50.0, 20.0, 0.0), "pov_slowdown_mps", 0.0),
            (ending(30.0), "avoidable", None),
        ],
    )
    def test_by_hand(self, trajectory, name, value):
        assert getattr(Measures.of(trajectory), name) == pytest.approx(value)

    def test_sustained_braking_is_the_hardest_mean_over_1_6_s(self):
        # 3 m/s2 for half a second among 1 m/s2: (1.5 + 1.1) m/s in 1.6 s.
        v_mps = 30.0 - np.cumsum([0.0, *([0.1] * 20), *([0.3] * 5), *([0.1] * 20)])
        assert sustained_brake_mps2(v_mps) == pytest.approx(2.6 / 1.6)
        assert sustained_brake_mps2(v_mps[20:26]) == pytest.approx(3.0), "shorter than 1.6 s"
        assert sustained_brake_mps2(v_mps[:1]) == sustained_brake_mps2(v_mps[::-1]) == 0.0

    def test_slow_down_is_from_the_highest_speed_before(self):
        # 1.5 m/s2 for the 2.5 s and more that the VUT takes for 50 m at 20 m/s.
        trajectory = eq4(-300.0, 30.0, -1.5, -50.0, 20.0, 0.0)
        slowdown_mps = 1.5 * trajectory.t_end_s
        assert Measures.of(trajectory).pov_slowdown_mps == pytest.approx(slowdown_mps)
        # Recovering at the end takes nothing back; what was gained before is lost, too.
        v_mps = trajectory.motion[:, POV, 1]
        v_mps[3], v_mps[-1] = 40.0, 29.0
        assert Measures.of(trajectory).pov_slowdown_mps == pytest.approx(slowdown_mps - 0.15 + 10.0)

    def test_a_collision_on_a_long_ramp_was_avoidable_by_waiting_until_late(self):
        # Both constant at 20 m/s, side by side, 100 m before M. Waiting: a stop takes 50 m.
        measures = Measures.of(eq4(-100.0, 20.0, 0.0, -100.0, 20.0, 0.0))
        assert measures.is_close
        assert measures.avoidable is True
        # Brake by 4 m/s2 for t seconds over 20 t - 2 t^2 = remaining; 6 m behind takes
        # 2 t^2 = 6, t = 1.73 s, 28.6 m; accelerating by 2 m/s2 it is t^2 = 6, 2.45 s, 55 m.
        assert measures.last_avoidable_s == pytest.approx((100 - 28.6) / 20, abs=0.1)

    def test_the_last_way_out_is_a_time_of_the_record(self):
        """Not 6.6000000000000005, as 66 times 0.1 is."""
        for start_m in range(-200, -50):
            found = Measures.of(eq4(start_m, 20.0, 0.0, start_m, 20.0, 0.0)).last_avoidable_s
            assert repr(found) == f"{found:.1f}"

    def test_a_collision_right_at_the_start_was_not_avoidable(self):
        measures = Measures.of(eq4(-4.0, 20.0, 0.0, -4.0, 20.0, 0.0))
        assert measures.is_close
        assert (measures.avoidable, measures.last_avoidable_s) == (False, None)
