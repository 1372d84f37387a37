"""Campaigns whose cases run several times, each with another draw of what is random."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from support.campaigning import campaign_settings, run_campaign

from merge_sumo import api
from merge_sumo.metrics.summary import by_case, failing_cases
from merge_sumo.scenario.imperfection import Sensing
from merge_sumo.scenario.scenario import US23

SEEDED = """
import random
class Vut:
    def reset(self, seen, seed):
        self.bold = random.Random(seed).random() < 0.5
    def act(self, seen):
        if self.bold:
            return 0.5
        return -1.5 if seen.x_pov_m < seen.x_vut_m + 40.0 and seen.x_vut_m > -120.0 else 0.3
"""


def test_counts_cases_and_not_runs(tmp_path):
    """The controller draws by the seed, so some cases both fail and pass."""
    (tmp_path / "seeded.py").write_text(SEEDED)
    known: dict[str, Any] = {"cases": 60, "sampler": "gpr", "batch": 10, "repeat": 3}
    vut = f"{tmp_path / 'seeded.py'}:Vut"
    run_campaign(campaign_settings(vut=vut, tolerated=0.3, **known), tmp_path / "run")
    opened = api.CampaignRun(tmp_path / "run", gates=["failures"])
    failing = failing_cases(opened.recorded.outcomes, 0.3)
    assert opened.summary.undecided > 0
    assert opened.summary.failures + opened.summary.undecided == len(failing)
    assert opened.summary.cases == len(by_case(opened.recorded.outcomes)) == 20
    facts = {fact.name: fact.value for fact in opened.facts}
    assert facts["runs"] == 60
    assert facts["tolerated share of failing runs of a case"] == 30.0
    assert len(opened.failures) == len(failing)
    (gate,) = opened.gates
    assert gate.met
    assert gate.found.endswith(f" and {opened.summary.undecided} undecided")


@pytest.mark.parametrize(("sense", "tolerated"), [(Sensing(), 0.0), (Sensing(noise_x_m=1.0), 0.2)])
def test_nothing_is_tolerated_where_all_runs_of_a_case_are_the_same(sense, tolerated):
    scenario = replace(US23, sense=sense)
    settings = campaign_settings(vut="design2", scenario=scenario, repeat=2, tolerated=0.2, cases=9)
    assert settings.tolerated == tolerated
