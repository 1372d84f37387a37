"""The limit of the gap within which a case fails is that of the scenario that is searched."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.engine.evaluate import evaluate
from merge_sumo.samplers.belief import learn_chance
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.values.scenario import US23


@pytest.mark.parametrize("limit_m", [3.0, 6.0, 12.0])
def test_failures_of_a_scenario_are_predicted_within_its_own_limit(limit_m):
    scenario = replace(US23, dx_crash_m=limit_m, dx_critical_m=max(limit_m, US23.dx_critical_m))
    settings = CampaignSettings(vut="level0", levels=(0,), cases=400, scenario=scenario)
    points = np.random.default_rng(7).random((400, 2))
    plan = resolve(settings).with_engine("kinematic")
    ran = sorted(evaluate(plan, settings.pool.cases(points, 0)))
    outcomes = [result.outcome(place) for place, result in ran]
    assert {outcome.gap_limit_m for outcome in outcomes} == {limit_m}
    sampler = make_sampler("uniform", settings.pool, 0)
    sampler.tell(outcomes[:200])
    assert sampler.history(0).limit_m == limit_m
    chance = learn_chance(sampler.history(0))
    assert chance is not None
    failed = np.array([outcome.failed for outcome in outcomes[200:]])
    expected = chance(points[200:]) > 0.5
    assert failed.sum() > 5
    assert np.mean(expected[failed]) > 0.8
    assert np.mean(expected[~failed]) < 0.05
