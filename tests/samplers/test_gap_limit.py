"""The gap within which a case fails is that of the scenario that is searched, in units of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.campaigning import campaign_settings

from merge_sumo.campaigns.campaign import controller_model_of
from merge_sumo.metrics.criterion import PAPER
from merge_sumo.metrics.regression import regression
from merge_sumo.samplers.controller_model import ControllerModelPair
from merge_sumo.samplers.history import bounded
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.samplers.surrogate import learn_chance
from merge_sumo.scenario.scenario import US23
from merge_sumo.simulation.evaluate import simulate

HARSH = "brake_after_mps2 > 3"
LIMITS = [(limit_m, fail_when) for limit_m in (3.0, 12.0) for fail_when in (PAPER, HARSH)]


def test_large_margins_are_drawn_in():
    margins = np.array([0.0, 0.5, -1.25, 1.25, 2.5, -2.5, 100.0, -np.inf, np.inf, np.nan])
    expected = [0.0, 0.5, -1.25, 1.25, 1.875, -1.875, 2.484375, -2.5, 2.5, np.nan]
    assert bounded(margins).tolist() == pytest.approx(expected, abs=0.0, nan_ok=True)


def searched(limit_m: float, fail_when: str, cases: int, vut: str = "level0"):
    """Return settings, plan, points, (n, d), outcomes and motions of a scenario with a limit."""
    scenario = replace(US23, dx_crash_m=limit_m, dx_critical_m=max(limit_m, US23.dx_critical_m))
    settings = campaign_settings(vut=vut, cases=cases, scenario=scenario, fail_when=fail_when)
    points = np.random.default_rng(7).random((cases, 2))
    plan = settings.load_plan().with_engine("kinematic")
    ran = simulate(plan, settings.pool.cases(points, 0))
    outcomes = [one.at(place, 0).outcome for place, one in enumerate(ran)]
    motions = {place: one.trajectory.motion for place, one in enumerate(ran)}
    return settings, plan, points, outcomes, motions


@pytest.mark.parametrize(("limit_m", "fail_when"), [*LIMITS, (6.0, PAPER)])
def test_failures_of_a_scenario_are_predicted_within_its_own_limit(limit_m, fail_when):
    settings, _, points, outcomes, _ = searched(limit_m, fail_when, 400)
    sampler = make_sampler("uniform", settings.pool, 0)
    sampler.tell(outcomes[:200])
    history = sampler.history(0)
    assert ((np.abs(history.gap) < 1.0) == history.failed).all()
    chance = learn_chance(history)
    assert chance is not None
    failed = np.array([outcome.failed for outcome in outcomes[200:]])
    expected = chance(points[200:]) > 0.5
    assert failed.sum() > 5
    assert np.mean(expected[failed]) > 0.8
    assert np.mean(expected[~failed]) < 0.05


@pytest.mark.parametrize(("limit_m", "fail_when"), LIMITS)
def test_a_model_and_a_pair_of_them_predict_failures_within_it(limit_m, fail_when):
    settings, plan, points, outcomes, motions = searched(limit_m, fail_when, 160)
    _, old_plan, _, old, old_motions = searched(limit_m, fail_when, 160, "design1")
    model = controller_model_of(plan, settings.pool, settings.seed)
    pair = ControllerModelPair(
        controller_model_of(plan, settings.pool, settings.seed),
        controller_model_of(old_plan, settings.pool, settings.seed),
    )
    model.tell(outcomes[:80], motions)
    pair.tell(outcomes[:80], motions)
    pair.tell_old(old[:80], old_motions)
    regressions = [regression(*versions) for versions in zip(outcomes, old, strict=True)]
    for predictor, ran in ((model, outcomes), (pair, regressions)):
        gaps = predictor.predict({0: points[80:]})[0]
        predicted = np.abs(np.median(gaps, axis=0)) < 1.0
        failed = np.array([outcome.failed for outcome in ran[80:]])
        assert failed.any()
        assert np.mean(predicted == failed) > 0.9
