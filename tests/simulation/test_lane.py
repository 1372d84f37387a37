"""Merging from an acceleration lane: merge requests, faults after a merge, and measures."""

from __future__ import annotations

from dataclasses import replace
from operator import attrgetter

import numpy as np
import pytest
from simulation.test_kinematic_simulator import uniform
from support.plans import plan_for

from merge_sumo.drivers.acceleration_lane import Merging
from merge_sumo.drivers.base import MERGE, NO_REQUEST, STAY
from merge_sumo.metrics.measures import Measures
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import DT_S, POV, US23, VUT, Scenario
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.simulation.evaluate import simulate_part

LANE = replace(US23, name="lane", lane_m=(-70.0, 130.0), follow_up_s=5.0)


class TestAMergeRequest:
    """It is granted on the lane, in the next step; at the end of the lane a merge is forced."""

    def step(self, x_m: float, merge_request: int | None, scenario: Scenario = LANE) -> bool:
        merging = Merging(1, scenario)
        merging.begin(0)
        state = np.array([[-500.0], [x_m]]), np.full((2, 1), 20.0)
        requests = None if merge_request is None else np.array([merge_request], dtype=np.int8)
        merging.take(requests, np.zeros((2, 1)), *state)
        return bool(merging.step(*state)[0])

    @pytest.mark.parametrize(
        ("x_m", "merge_request", "merged"),
        [
            (-72.1, MERGE, False),
            (-72.0, MERGE, True),
            (100.0, STAY, False),
            (127.9, STAY, False),
            (128.0, STAY, True),
            (-2.1, NO_REQUEST, False),
            (-2.0, NO_REQUEST, True),
            (-2.0, None, True),
        ],
    )
    def test_by_hand(self, x_m, merge_request, merged):
        assert self.step(x_m, merge_request) is merged

    def test_that_never_comes_stops_before_the_end(self):
        merging = Merging(1, replace(LANE, lane_end="stop"))
        x_m, v_mps = np.array([[-500.0], [60.0]]), np.full((2, 1), 22.0)
        hardest = 0.0
        for _ in range(200):
            answer = np.full((2, 1), 2.0)
            merging.take(np.array([STAY], dtype=np.int8), answer, x_m, v_mps)
            assert not merging.step(x_m, v_mps)[0]
            a = np.clip(answer, -4.0, 2.0)
            hardest = min(hardest, float(answer[VUT, 0]))
            x_m, v_mps = x_m + v_mps * DT_S, np.maximum(v_mps + a * DT_S, 0.0)
        assert v_mps[VUT, 0] == pytest.approx(0.0, abs=1e-9)
        assert 128.0 < x_m[VUT, 0] < 130.0
        assert hardest >= -4.0 - 1e-9


RAISING = """
class Raises:
    "Knows nothing after M."

    def act(self, seen):
        if seen.merged:
            raise ValueError("after M")
        return {answer}
"""


class TestAControllerThatRaisesAfterItsMerge:
    ROAD = named_scenario("us23-lane")
    CASES = uniform(20, 0, ROAD)

    def raising(self, tmp_path, answer):
        (tmp_path / "raises.py").write_text(RAISING.format(answer=answer))
        plan = plan_for(f"{tmp_path / 'raises.py'}:Raises", scenario=self.ROAD)
        return simulate_part(plan, self.CASES, attrgetter("trajectory"))

    def test_follows_by_idm_where_it_only_accelerates(self, tmp_path):
        answer = "min(max((28.0 - seen.v_vut_mps) / 0.1, 0.0), 1.0)"
        plan = plan_for("level0", scenario=self.ROAD).with_engine("kinematic")
        others = simulate_part(plan, self.CASES, attrgetter("trajectory"))
        for raising, calm in zip(self.raising(tmp_path, answer), others, strict=True):
            assert raising.end is End.MERGED
            np.testing.assert_allclose(raising.after, calm.after, rtol=0.0, atol=1e-9)

    def test_is_an_error_where_it_chooses_to_merge(self, tmp_path):
        for raising in self.raising(tmp_path, "1.0, True"):
            assert raising.end is End.VUT_ERROR
            assert raising.error.startswith("ValueError: after M")
            assert raising.after is None


class TestAnEpisode:
    def merged(self, x_pov: float, v_pov: float, x_vut: float, v_vut: float) -> Trajectory:
        case = Case(level=0, x_pov0_m=-200.0, v_pov0_mps=30.0, scenario=LANE)
        before = [[x_pov - v_pov * DT_S, v_pov, 0.0], [x_vut - v_vut * DT_S, v_vut, 0.0]]
        motion = np.array([before, [[x_pov, v_pov, 0.0], [x_vut, v_vut, 0.0]]])
        return Trajectory(case, motion, End.MERGED, after=motion[1:])

    def test_is_measured_at_the_place_of_the_merge(self):
        measures = Measures.of(self.merged(40.0, 30.0, 30.0, 20.0))
        assert measures.x_merge_m == 30.0
        assert measures.lane_share == 0.5
        assert (measures.gap_ahead_m, measures.time_gap_ahead_s) == (5.0, 0.25)
        assert (measures.gap_behind_m, measures.time_gap_behind_s) == (None, None)
        assert measures.dx_m == 10.0

    def test_of_a_vut_that_stood_has_the_time_since_the_pov_passed(self):
        case = Case(level=0, x_pov0_m=-200.0, v_pov0_mps=30.0, scenario=LANE)
        motion = np.zeros((31, 2, 3))
        motion[:, VUT, 0] = 30.0
        motion[:, POV, 0] = -27.0 + 3.0 * np.arange(31)  # passes the VUT after 1.9 s
        motion[:, POV, 1] = 30.0
        measures = Measures.of(Trajectory(case, motion, End.MERGED, after=motion[-1:]))
        assert measures.stood_s == 3.1
        assert measures.pet_s == pytest.approx(1.1)

    def test_is_measured_with_a_car_behind(self):
        measures = Measures.of(self.merged(10.0, 30.0, 30.0, 20.0))
        assert (measures.gap_behind_m, measures.time_gap_behind_s) == (15.0, 0.5)
        assert measures.gap_ahead_m is None
        assert measures.pet_s == pytest.approx(20.0 / 30.0)
        # 10 m/s, 15 m less the way of the reaction: 7.5 m.
        assert measures.brake_after_mps2 == pytest.approx(100.0 / 15.0)
