"""The stopping rule: a search ends when its last cases have added little."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from support.campaigning import campaign_settings, run_campaign
from support.histories import ended

from merge_sumo import api
from merge_sumo.campaigns import recorded as campaign_folder
from merge_sumo.campaigns.recorded import WINDOW, has_converged
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import US23


def outcomes(*failing: int, cases: int) -> list[Outcome]:
    """Return cases of which those at some places fail, each in a ball of its own."""
    ran: list[Outcome] = []
    for place in range(cases):
        x_m = -338.0 + 17.0 * failing.index(place) if place in failing else -181.0
        case = Case(level=0, x_pov0_m=x_m, v_pov0_mps=30.0, scenario=US23)
        ran.append(ended(case, -600.0 if place in failing else -1.0, place, place))
    return ran


def test_a_search_converges_when_its_last_cases_added_nothing():
    ran = outcomes(3, 40, cases=41 + WINDOW)
    assert has_converged(ran)
    assert not has_converged(ran[:-1]), "the last failure is among the last cases"
    late = Case(level=1, x_pov0_m=-250.0, v_pov0_mps=30.0, scenario=US23)
    at_another_level = Outcome(len(ran), len(ran), late, ran[3].measures)
    assert not has_converged([*ran, at_another_level])


@pytest.mark.parametrize("ran", [[], outcomes(cases=400), outcomes(3, 40, 100, cases=150)])
def test_a_search_continues_without_a_failure_and_where_one_was_added(ran):
    assert not has_converged(ran)


def test_a_campaign_stops_early_and_its_outcomes_are_a_beginning_of_the_whole(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(campaign_folder, "WINDOW", 20)
    settings = campaign_settings(vut="design1", sampler="annealing", cases=120)
    whole = run_campaign(settings, tmp_path / "whole")
    early = run_campaign(replace(settings, stop_when_converged=True), tmp_path / "early")
    assert 20 < len(early.outcomes) < len(whole.outcomes) == 120
    text = (tmp_path / "whole" / "outcomes.jsonl").read_bytes()
    assert text.startswith((tmp_path / "early" / "outcomes.jsonl").read_bytes())


def test_without_a_number_of_cases_a_campaign_ends_when_it_has_converged_and_may_go_on(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(campaign_folder, "WINDOW", 20)
    plan: dict[str, Any] = {"level": 0, "sampler": "annealing", "progress": False}
    run = api.campaign("design1", **plan, out=tmp_path / "run")
    assert run.converged
    assert 20 < len(run.recorded.outcomes) < 800
    assert f": {len(run.recorded.outcomes)} cases, " in run.lines()[0]
    assert "less than 1 % to the FMC (limit: 800 cases)" in "".join(run.lines())
    more = api.resume(run, cases=len(run.recorded.outcomes) + 40, progress=False)
    assert not more.converged
    assert more.recorded.outcomes[:-40] == run.recorded.outcomes
