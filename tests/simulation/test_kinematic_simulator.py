"""The kinematic engine: cases end as in SUMO."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.plans import POVS, plan_for

from merge_sumo.analysis.truth import ground_truth, known_truth
from merge_sumo.controllers.spec import ControllerOptions
from merge_sumo.drivers.levelk import features
from merge_sumo.drivers.policies import load_network
from merge_sumo.errors import UserError
from merge_sumo.metrics.criterion import Criterion
from merge_sumo.metrics.outcome import Episode
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.case import Case, from_unit
from merge_sumo.scenario.scenario import OWN, US23, VUT, Scenario
from merge_sumo.simulation.evaluate import simulate
from merge_sumo.simulation.kinematic_simulation import KinematicSimulation
from merge_sumo.simulation.kinematic_simulator import CHECKED_SHARE, drawn
from merge_sumo.simulation.plan import Engine, SimulationPlan
from merge_sumo.simulation.povs import own_pov


def uniform(count: int, level: int, scenario: Scenario = US23) -> list[Case]:
    points = np.random.default_rng([5, level]).random((count, len(scenario.dimensions(level))))
    return from_unit(points, level, scenario=scenario)


def by_both(plan: SimulationPlan, cases: list[Case]) -> tuple[list[Episode], list[Episode]]:
    """Return the results of SUMO and of the kinematic engine."""
    return simulate(plan, cases), simulate(plan.with_engine("kinematic"), cases)


def assert_alike(sumo: list[Episode], kinematic: list[Episode]) -> None:
    for one, other in zip(sumo, kinematic, strict=True):
        assert one.trajectory.end is other.trajectory.end
        after, expected = one.trajectory.after, other.trajectory.after
        np.testing.assert_allclose(
            one.trajectory.motion, other.trajectory.motion, rtol=0.0, atol=1e-9
        )
        assert (after is None) == (expected is None)
        if after is not None and expected is not None:
            np.testing.assert_allclose(after, expected, rtol=0.0, atol=1e-9)
        verdict, ours = one.outcome, other.outcome
        assert (verdict.failed, verdict.is_tested) == (ours.failed, ours.is_tested)
        assert verdict.margin == pytest.approx(ours.margin, abs=1e-9)


class TestACase:
    @pytest.mark.parametrize(
        ("scenario", "vut", "level"),
        [
            ("us23", "design1", 0),
            ("us23", "level2", 1),
            ("us23-traffic", "design2", 2),
            ("us23-lane", "level0", 1),
            ("us23-lane-traffic", "design2", 1),
        ],
    )
    def test_ends_as_in_sumo(self, scenario, vut, level):
        road = named_scenario(scenario)
        assert_alike(*by_both(plan_for(vut, scenario=road), uniform(100, level, road)))

    @pytest.mark.parametrize("fail_when", ["unsafe", "brake_after_mps2 > 2", "after_gap_m < 3"])
    def test_is_judged_by_any_criterion(self, fail_when):
        scenario = replace(US23, follow_up_s=2.0)
        plan = plan_for("design2", scenario=scenario, criterion=Criterion(fail_when))
        sumo, kinematic = by_both(plan, uniform(200, 1, scenario))
        assert_alike(sumo, kinematic)
        assert any(one.outcome.failed for one in sumo)


class TestACloseCall:
    def test_is_decided_by_sumo(self):
        """The front bumpers are 6 m apart at M, to rounding errors."""
        plan = plan_for("level0")
        case = Case(level=0, x_pov0_m=-250.0, v_pov0_mps=30.0, scenario=US23)
        (found,) = simulate(plan, [case])
        assert found.outcome.measures.dx_m is not None
        x_m = case.x_pov0_m + US23.dx_crash_m - found.outcome.measures.dx_m
        cases: list[Case] = [replace(case, x_pov0_m=x_m + k * 1e-13) for k in range(-200, 200, 4)]
        sumo, kinematic = by_both(plan, cases)
        assert all(one.in_sumo for one in kinematic)
        assert {one.outcome.failed for one in sumo} == {True, False}
        for one, other in zip(sumo, kinematic, strict=True):
            assert one.trajectory.motion.tobytes() == other.trajectory.motion.tobytes()

    def test_is_one_in_which_a_rounding_error_changes_the_last_step(self):
        scenario = replace(US23, x_vut0_m=-180.0, v_vut0_mps=20.0, level0_v_mps=20.0)
        _, kinematic = by_both(plan_for("level0", scenario=scenario), uniform(20, 0, scenario))
        assert all(one.in_sumo for one in kinematic)


class TestTheCheck:
    @pytest.mark.parametrize("count", [1, 100, 101])
    def test_is_of_at_least_one_case_of_a_hundred(self, count):
        places = drawn(uniform(count, 0))
        assert CHECKED_SHARE * count <= len(places) <= CHECKED_SHARE * count + 1
        assert places <= set(range(count))

    @pytest.mark.parametrize("off_m", [2e-6, 5.0])
    def test_stops_in_a_sentence_where_sumo_says_otherwise(self, monkeypatch, off_m):
        command = KinematicSimulation.command

        def drift(simulation: KinematicSimulation, a_mps2: np.ndarray, merged: None) -> None:
            command(simulation, a_mps2, merged)
            simulation.x_m[VUT] += off_m / 80.0

        monkeypatch.setattr(KinematicSimulation, "command", drift)
        with pytest.raises(UserError, match=r"ends differently in SUMO .*: set `engine` to sumo"):
            simulate(plan_for("design1").with_engine("kinematic"), uniform(20, 0))


class TestThePlan:
    @pytest.mark.parametrize("vut", ["sumo:Krauss", "traci"])
    def test_needs_sumo_for_a_vut_of_others(self, vut):
        plan = plan_for(vut)
        assert plan.with_engine(None).engine is Engine.SUMO
        with pytest.raises(UserError, match=f"the VUT {vut} is not built in"):
            plan.with_engine("kinematic")

    def test_needs_sumo_for_a_pov_of_the_user(self):
        povs = replace(POVS, own=own_pov("design1", ControllerOptions()))
        plan = plan_for("design1", povs=povs)
        assert plan.at_level(OWN).with_engine(None).engine is Engine.SUMO
        assert plan.at_level(1).with_engine(None).engine is Engine.KINEMATIC
        with pytest.raises(UserError, match="the POV design1 is not built in"):
            plan.with_engine("kinematic")


class TestATruth:
    PLAN = plan_for("design2").with_engine(None)

    def test_is_kept_by_engine(self, tmp_path):
        counted: list[int] = []
        ground_truth(self.PLAN, 0, 50, cache=tmp_path, on_case=counted.append)
        ground_truth(plan_for("design2"), 0, 50, cache=tmp_path, on_case=counted.append)
        assert len(counted) == 100
        for plan, in_sumo in ((self.PLAN, 1), (plan_for("design2"), 50)):
            kept = known_truth(plan, 0, 50, cache=tmp_path)
            assert kept is not None
            assert kept.in_sumo == in_sumo


@pytest.mark.parametrize("name", ["pov1", "pov2", "vut1", "vut2"])
def test_greedy_actions_of_many_rows_are_those_of_one_row(name):
    rng, n = np.random.default_rng(1), 4000
    network = load_network(name)
    state = rng.uniform([-340, 0, -182, 0], [200, 60, 0, 45], (n, 4)).T
    svo_rad = rng.uniform(0.0, 1.5, n) if network.sees_svo else None
    inputs = features(state, svo_rad, scenario=US23)
    inputs[7] = np.inf
    actions = network.greedy(inputs).tolist()
    assert [row for row, action in enumerate(actions) if action == -1] == [7]
    assert [network.greedy(inputs[[row]]).item() for row in range(39)] == actions[:39]
