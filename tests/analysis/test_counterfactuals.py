"""Who would have avoided a failure: checked against eq. (4) worked out here, without SUMO."""

# mypy: no-strict-optional

from __future__ import annotations

import shutil
from dataclasses import replace

import pytest
from support.campaigning import campaign_settings, run_campaign
from support.plans import plan_for
from support.scenes import scene_of

from merge_sumo.analysis.counterfactuals import AVOIDANCE, avoidances, write_avoidance
from merge_sumo.analysis.run_study import RunStudy
from merge_sumo.campaigns.recorded import RecordedCampaign, failures
from merge_sumo.campaigns.settings import controllers, settings_from_folder
from merge_sumo.controllers.spec import ControllerOptions
from merge_sumo.drivers.policies import policies_of
from merge_sumo.drivers.reference_drivers import REFERENCE_DRIVERS, CarefulPov
from merge_sumo.metrics.merge import brake_after_mps2
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.scenario import OWN, US23
from merge_sumo.simulation.evaluate import simulate
from merge_sumo.simulation.povs import Povs, own_pov


@pytest.fixture(scope="module")
def found(run, tmp_path_factory):
    copy = RecordedCampaign(shutil.copytree(run.folder, tmp_path_factory.mktemp("found") / "run"))
    settings = settings_from_folder(copy.folder, copy.record, controllers(copy.record))
    found = write_avoidance(RunStudy(copy, settings, settings.load_plan()))
    assert AVOIDANCE.read_lines(copy) == found
    return found


def passes(failure, driver, until, *, in_the_povs_place=False):
    """Return whether a driver passes a failure: eq. (4), with a POV that keeps its speed."""
    case = failure.case
    driver.begin(0, case)
    (x_pov, v_pov), (x, v) = case.starts()
    for step in range(300):
        seen = scene_of(x_pov, v_pov, x, v, step=step)
        a = a_pov = 0.0
        if in_the_povs_place:
            a, a_pov = failure.a_vut_mps2[step], driver.act(seen)[0]
        elif step < until:
            a = failure.a_vut_mps2[step]
        else:
            a = driver.act(seen)[0]
        x, x_pov = x + 0.1 * v, x_pov + 0.1 * v_pov
        v, v_pov = max(v + 0.1 * a, 0.0), max(v_pov + 0.1 * a_pov, 0.0)
        if x >= 0.0:
            gap, closing = abs(x_pov - x) - 5.0, max(v_pov - v if x_pov < x else v - v_pov, 0.0)
            # Whoever is behind has 0.75 s, and then 4 m/s2.
            return gap >= 1.0 and closing**2 <= 8.0 * max(gap - 0.75 * closing, 0.0)
    return False


def last_of(failure):
    """Return the last of all steps at which the FSM driver may take over; None without one."""
    steps = range(len(failure.motion) - 1)
    passing = [step for step in steps if passes(failure, REFERENCE_DRIVERS["fsm"](1), step)]
    return max(passing, default=None)


def test_every_failure_names_who_would_have_avoided_it(run, found):
    assert [one.index for one in found] == sorted(o.index for o in failures(run.outcomes))
    for one in found[:3]:
        failure = run.trajectory(one.index)
        names = [name for name, make in REFERENCE_DRIVERS.items() if passes(failure, make(1), 0)]
        assert list(one.avoided_by) == names
        last = last_of(failure)
        assert one.latest_takeover_s == (None if last is None else last / 10.0)
        avoids = passes(failure, CarefulPov(1), 0, in_the_povs_place=True)
        assert one.pov_careful == avoids
    assert any(one.latest_takeover_s is not None for one in found)


def test_on_a_lane_it_names_the_drivers_that_pass_as_the_vut(tmp_path):
    road = named_scenario("us23-lane")
    settings = campaign_settings(
        vut="level0",
        scenario=road,
        sampler="uniform",
        cases=80,
        seed=4,
        fail_when="unsafe",
    )
    run = run_campaign(settings, tmp_path / "run")
    plan = settings.load_plan().with_engine("kinematic")
    failing = [o for o in run.outcomes if o.failed]
    found = avoidances(plan, [(o.index, run.trajectory(o.index)) for o in failing])
    for name in REFERENCE_DRIVERS:
        by_name = plan_for(name, scenario=road, criterion=plan.criterion)
        results = simulate(by_name.with_engine("kinematic"), [o.case for o in failing])
        for one, result in zip(found, results, strict=True):
            can_brake = brake_after_mps2(result.trajectory) <= 4.0
            passed = can_brake and result.outcome.is_tested and not result.outcome.failed
            assert (name in one.avoided_by) == passed
    assert len({one.avoided_by for one in found}) > 1


def test_a_pov_of_the_user_drives_again_in_sumo(run, found, tmp_path):
    path = tmp_path / "keeps.py"
    path.write_text("def keeps(seen):\n    return 0.0\n", encoding="utf-8")
    povs = Povs(
        policies=policies_of(US23), own=own_pov(f"{path}:keeps", ControllerOptions(in_process=True))
    )
    failing = []
    for one in found[:4]:
        failure = run.trajectory(one.index)
        failing.append((one.index, replace(failure, case=replace(failure.case, level=OWN))))
    assert avoidances(plan_for("careful", povs=povs), failing) == found[:4]
