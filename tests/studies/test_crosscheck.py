"""Crosschecks: HighwayEnv's vehicles by hand, motion, verdicts, differences and their reasons."""

from __future__ import annotations

import json
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from calling import assert_refused
from campaigning import campaign_settings, run_campaign
from conftest import require

import merge_sumo as ms
from merge_sumo.api.results import CrosscheckResult
from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.campaigns.store import Run
from merge_sumo.engine.highway_env_simulator import HighwayEnvWorld
from merge_sumo.engine.kinematic_world import EquationWorld
from merge_sumo.engine.simulator import road_for
from merge_sumo.errors import UserError
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.studies.crosscheck import (
    AGREED,
    CROSSCHECK,
    MOVES_OTHERWISE,
    crosscheck,
    crosscheck_of,
    motion_of,
)
from merge_sumo.studies.run_study import RunStudy
from merge_sumo.system.workers import open_workers
from merge_sumo.values.scenario import POV, US23, VUT, Scenario

PRESENT = find_spec("highway_env") is not None


@pytest.fixture
def peer() -> None:
    require(PRESENT, "highway-env is not installed: the extra peers")


def campaign_of(
    folder: Path, scenario: Scenario = US23, vut: str = "design2", cases: int = 24, **more
) -> tuple[Run, CampaignSettings]:
    settings = CampaignSettings(
        vut=vut,
        levels=scenario.levels[:3],
        cases=cases,
        batch=cases,
        sampler="uniform",
        seed=4,
        scenario=scenario,
        fail_when=scenario.criterion,
        **more,
    )
    return run_campaign(settings, folder), settings


@pytest.mark.usefixtures("peer")
class TestItsVehicles:
    def test_move_by_the_speed_before_a_step_and_stop_at_0(self):
        world = HighwayEnvWorld(2, road_for(US23), US23)
        world.place(0, [(-100.0, 20.0), (-50.0, 0.1)])
        world.command(np.array([[1.0, 0.0], [-4.0, 0.0]]))
        assert world.x_m[:, 0].tolist() == pytest.approx([-98.0, -49.99], abs=1e-13)
        assert world.v_mps[:, 0].tolist() == pytest.approx([20.1, 0.0], abs=1e-15)
        world.command(np.array([[0.0, 0.0], [-4.0, 0.0]]))
        assert world.x_m[:, 0].tolist() == pytest.approx([-95.99, -49.99], abs=1e-13)
        assert world.x_m[VUT, 1] < -100.0, "a parked vehicle stays where it is"

    def test_go_faster_than_highway_env_allows_by_default(self):
        world = HighwayEnvWorld(1, road_for(US23), US23)
        world.place(0, [(-100.0, 60.0), (-50.0, 50.0)])
        world.command(np.array([[2.0], [2.0]]))
        assert world.v_mps[:, 0].tolist() == pytest.approx([60.2, 50.2])

    def test_do_not_collide_in_other_lanes_or_in_one(self):
        scenario = named_scenario("us23-traffic")
        worlds = [
            kind(1, road_for(scenario), scenario) for kind in (HighwayEnvWorld, EquationWorld)
        ]
        for world in worlds:
            world.place(0, [(-50.0, 30.0), (-50.0, 20.0), (-48.0, 5.0), (-52.0, 35.0)])
            for _ in range(20):
                world.command(np.full((4, 1), -0.5))
        assert np.abs(worlds[0].x_m - worlds[1].x_m).max() < 1e-12


@pytest.mark.usefixtures("peer")
class TestMotion:
    def test_of_records_is_that_of_highway_env(self, run):
        settings = campaign_settings(vut="design1")
        known = run.trajectories(range(len(run.outcomes)))
        with open_workers(1) as here:
            found = motion_of(resolve(settings), known, here)
        assert found.cases == 60
        assert found.steps == sum(len(one.motion) - 1 for one in known.values())
        assert found.largest_m < 1e-10
        assert found.largest_mps < 1e-10

    def test_shows_the_case_that_is_a_millimetre_off(self, run):
        settings = campaign_settings(vut="design1")
        known = run.trajectories(range(3))
        known[1].motion[40:, POV, 0] += 1e-3
        with open_workers(1) as here:
            found = motion_of(resolve(settings), known, here)
        known[1].motion[40:, POV, 0] -= 1e-3
        assert found.worst_case == 1
        assert found.largest_m == pytest.approx(1e-3, rel=1e-6)
        assert found.largest_mps < AGREED


@pytest.mark.usefixtures("peer")
class TestVerdicts:
    @pytest.mark.parametrize(
        "name", ["us23", "us23-traffic", "us23-lane", "us23-lane-traffic", "roundabout"]
    )
    def test_are_the_same_on_recorded_and_fresh_cases(self, name, tmp_path):
        run, settings = campaign_of(tmp_path / "run", named_scenario(name))
        found = crosscheck(RunStudy(run, settings, resolve(settings)), cases=36)
        verdicts = found.verdicts
        assert verdicts is not None
        assert (verdicts.recorded, verdicts.fresh, verdicts.same) == (24, 12, 36)
        assert verdicts.differences == ()
        assert not verdicts.lowest_only
        assert verdicts.other_motion == 0
        assert verdicts.largest_m < 1e-9
        assert found.agrees
        assert crosscheck_of(run.folder) == found

    @pytest.mark.long
    @pytest.mark.parametrize("vut", ["design1", "design2"])
    def test_of_ten_thousand_cases_are_the_same_or_named(self, vut, tmp_path):
        run, settings = campaign_of(tmp_path / "run", vut=vut, cases=800)
        with open_workers(None) as workers:
            found = crosscheck(RunStudy(run, settings, resolve(settings), workers), cases=10_000)
        verdicts = found.verdicts
        assert verdicts is not None
        assert verdicts.cases == 10_000
        assert verdicts.failures > 200
        assert found.agrees
        assert verdicts.same >= 9_990
        assert verdicts.other_motion <= 10

    def test_of_the_lowest_scores_come_first_where_few_are_wanted(self, run):
        settings = campaign_settings(vut="design1")
        found = crosscheck(RunStudy(run, settings, resolve(settings)), cases=5)
        result = CrosscheckResult(found, run.folder / CROSSCHECK)
        assert "5 recorded cases, those with the lowest scores, and 0 fresh" in str(result)
        (run.folder / CROSSCHECK).unlink()
        assert found.verdicts is not None
        assert (found.verdicts.cases, found.verdicts.failures) == (5, 5)

    def test_are_left_out_for_a_driver_of_sumo(self, tmp_path):
        run, settings = campaign_of(tmp_path / "run", vut="sumo:Krauss", cases=3)
        found = crosscheck(RunStudy(run, settings, resolve(settings)))
        assert found.verdicts is None
        assert "a model of SUMO" in found.why_no_verdicts
        assert found.motion.cases == 3
        assert found.motion.largest_m < AGREED
        assert found.agrees


@pytest.mark.usefixtures("peer")
class TestDifferences:
    def test_say_that_a_driver_answers_otherwise(self, tmp_path):
        class Fickle:  # known to this process alone, so it drives here
            stops = False

            def act(self, _: ms.Seen) -> float:
                return -4.0 if Fickle.stops else 1.0

        out = tmp_path / "run"
        run = ms.campaign(Fickle, level=0, sampler="uniform", cases=5, seed=2, out=out)
        Fickle.stops = True
        with pytest.warns(UserWarning, match="known to this process alone") as warned:
            found = ms.crosscheck(run).found
        assert warned[0].filename == __file__, "the line of who calls the verb"
        assert found.verdicts is not None
        one = found.verdicts.differences[0]
        assert one.reason.startswith("the VUT answers otherwise")
        assert one.time_s == 0.1
        assert one.in_peer == "passed, TIMEOUT"
        assert found.agrees, "the vehicles moved as they were told"

    def test_of_motion_are_differences_of_the_simulators(self, tmp_path, monkeypatch):
        run, settings = campaign_of(tmp_path / "run", cases=12)
        step = HighwayEnvWorld.command

        def weaker(world, a_mps2, merged=None):
            step(world, 0.9 * a_mps2, merged)

        monkeypatch.setattr(HighwayEnvWorld, "command", weaker)
        found = crosscheck(RunStudy(run, settings, resolve(settings)), cases=60)
        assert found.motion.largest_m > 0.1
        assert found.verdicts is not None
        assert found.verdicts.differences
        assert {one.reason for one in found.verdicts.differences} == {MOVES_OTHERWISE}
        assert not found.agrees


class TestTheCommand:
    @pytest.mark.usefixtures("peer")
    def test_prints_what_its_file_holds(self, run, call, tmp_path):
        shutil.copytree(run.folder, tmp_path / "run")
        code, out, _ = call("crosscheck", tmp_path / "run", "--cases", 70, "--json")
        printed = json.loads(out)
        kept = json.loads((tmp_path / "run" / CROSSCHECK).read_text())
        assert code == 0
        assert {name: printed[name] for name in kept} == kept
        assert (kept["verdicts"]["recorded"], kept["verdicts"]["fresh"]) == (60, 10)
        code, out, _ = call("crosscheck", tmp_path / "run", "--cases", 10)
        assert code == 0
        assert "10 of 10 the same" in out

    def test_refuses_without_highway_env(self, run, call, monkeypatch):
        monkeypatch.setitem(sys.modules, "highway_env.vehicle.kinematics", None)
        assert_refused(call("crosscheck", run.folder), "pip install 'merge-sumo[peers]'")

    @pytest.mark.usefixtures("peer")
    @pytest.mark.parametrize(("option", "value"), [("--cases", 0), ("--seed", -1)])
    def test_refuses_numbers_that_make_no_sense(self, run, call, option, value):
        assert_refused(call("crosscheck", run.folder, option, value), f"{option} is {value}")


class TestTheFile:
    def test_that_is_not_there_says_nothing(self, tmp_path):
        assert crosscheck_of(tmp_path) is None

    @pytest.mark.parametrize("content", ["", "[]", '{"peer": 3}', '{"motion": {"cases": -1}}'])
    def test_that_is_something_else_is_refused(self, tmp_path, content):
        (tmp_path / CROSSCHECK).write_text(content)
        with pytest.raises(UserError, match="not as it was written"):
            crosscheck_of(tmp_path)
