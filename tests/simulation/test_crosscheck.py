"""The crosscheck of tools/: vehicles of HighwayEnv by hand, and verdicts next to those of SUMO."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest
from conftest import require
from crosscheck import HighwayEnvWorld, crosscheck
from support.campaigning import run_campaign

from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.road.loader import road_for
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.scenario import LEVELS, US23, VUT


@pytest.fixture(autouse=True)
def peer() -> None:
    require(find_spec("highway_env") is not None, "highway-env is not installed: the extra peers")


def campaign_of(folder, name="us23"):
    scenario, cases = named_scenario(name), 24
    settings = CampaignSettings(
        vut="design2",
        levels=LEVELS,
        cases=cases,
        batch=cases,
        sampler="uniform",
        seed=4,
        scenario=scenario,
        fail_when=scenario.criterion,
    )
    return run_campaign(settings, folder)


def test_vehicles_move_by_the_speed_before_a_step_and_stop_at_0():
    simulation = HighwayEnvWorld(2, road_for(US23), US23)
    simulation.place(0, [(-100.0, 20.0), (-50.0, 0.1)])
    simulation.command(np.array([[1.0, 0.0], [-4.0, 0.0]]))
    assert simulation.x_m[:, 0].tolist() == pytest.approx([-98.0, -49.99], abs=1e-13)
    assert simulation.v_mps[:, 0].tolist() == pytest.approx([20.1, 0.0], abs=1e-15)
    assert simulation.x_m[VUT, 1] < -100.0, "a parked vehicle stays where it is"


@pytest.mark.parametrize("name", ["us23-lane-traffic", "roundabout"])
def test_verdicts_are_the_same_on_recorded_and_fresh_cases(name, tmp_path):
    found = crosscheck(campaign_of(tmp_path / "run", name), cases=36, seed=0)
    assert found.cases == 36
    assert found.differences == ()
    assert max(found.largest_m, found.largest_mps) < 1e-9
    assert found.agrees
