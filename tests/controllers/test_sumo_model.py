"""SUMO's own drivers as VUT: their motion, their options, and that they react to the POV."""

# mypy: no-strict-optional

from __future__ import annotations

import re

import numpy as np
import pytest
from support.vut_contract import cases_of, factory, run_cases, run_on

from merge_sumo.controllers.sumo_model import MODELS
from merge_sumo.errors import UserError
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import DT_S, US23, VUT
from merge_sumo.scenario.trajectory import End
from merge_sumo.sumo.sumo_simulation import SumoSimulation

FREE = Case(level=0, x_pov0_m=0.0, v_pov0_mps=45.0, scenario=US23)
"""The POV is gone before the VUT arrives."""


@pytest.fixture(scope="module", params=sorted(MODELS))
def model(request) -> str:
    return f"sumo:{request.param}"


def test_every_model_drives_the_same_in_1_and_in_8_corridors_and_by_eq_4(model):
    cases = cases_of(25)
    alone, many = (run_cases(factory(model), cases, corridors=k) for k in (1, 8))
    for one, other in zip(alone, many, strict=True):
        assert one.end is End.MERGED
        assert np.array_equal(one.motion, other.motion)
        x, v, a = one.motion[:, VUT].T
        assert x[1:] == pytest.approx(x[:-1] + v[:-1] * DT_S, abs=1e-9)
        assert v[1:] == pytest.approx(v[:-1] + a[:-1] * DT_S, abs=1e-9)


def test_a_free_driver_follows_what_sumo_drives_by_itself(model):
    """SUMO moves by the new speed and eq. (4) by the old: less than a metre apart at M."""
    (ours,) = run_cases(factory(model), [FREE], corridors=1)
    with SumoSimulation(1, vut_type=factory(model).vut_type, scenario=US23) as simulation:
        simulation.place(0, [(0.0, 45.0), (-182.0, 18.0)])
        x_m, speeds = [], []
        for _ in range(len(ours.motion) - 1):
            simulation._step_simulation()
            simulation.read()
            x_m.append(simulation.x_m[VUT, 0])
            speeds.append(simulation.v_mps[VUT, 0])
    assert ours.v_vut_mps[1:] == pytest.approx(speeds, abs=0.05)
    gained = (speeds[-1] - 18.0) * DT_S
    assert np.abs(ours.x_vut_m[1:] - x_m).max() <= gained + 0.05


def test_lane_change_parameters_decide_where_it_merges():
    scenario, places_m = named_scenario("us23-lane"), []
    for named in ("?lcAssertive=5", "?lcStrategic=0"):
        ran = run_on(factory(f"sumo:Krauss{named}"), scenario, 0, 20)
        places_m.append(np.mean([trajectory.x_vut_m[-1] for trajectory in ran]))
    assert places_m[0] + 50.0 < places_m[1]


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        ("sumo:idm", "choose one of sumo:Krauss"),
        ("sumo:IDM?lcAssertive=-2", "lcAssertive is -2: it must be -1 or more"),
        ("sumo:IDM?lcPushy=1", "it has no parameter 'lcPushy': choose from"),
        ("sumo:IDM?lcOvertakeDeltaSpeedFactor=3", "Attribute lcOvertakeDeltaSpeedFactor. Must be"),
    ],
)
def test_another_model_or_value_is_refused_in_a_sentence(spec, said):
    with pytest.raises(UserError, match=re.escape(said)):
        run_cases(factory(spec), [FREE])


@pytest.mark.parametrize("name", ["IDM", "Krauss", "ACC", "EIDM"])
def test_sumos_lane_change_model_merges_from_an_acceleration_lane(name):
    scenario, vut = named_scenario("us23-lane"), factory(f"sumo:{name}")
    places_m = []
    for level in (0, 1, 2):
        for trajectory in run_on(vut, scenario, level, 40):
            assert trajectory.end is End.MERGED
            places_m.append(trajectory.x_vut_m[-1])
    assert min(places_m) >= -70.0
    assert max(places_m) < 130.0, "no merge is forced"
    assert np.ptp(places_m) > 100.0, "it is the model that chooses the place"


@pytest.mark.parametrize("name", ["IDM", "ACC"])
def test_sumos_lane_change_model_forgets_the_cars_of_other_episodes(name):
    scenario, vut = named_scenario("us23-lane-traffic"), factory(f"sumo:{name}")
    ran, alone = run_on(vut, scenario, 0, 30), run_on(vut, scenario, 0, 30, corridors=1)
    for one, other in zip(ran, alone, strict=True):
        assert np.array_equal(one.motion, other.motion)
        assert np.array_equal(one.after, other.after)
