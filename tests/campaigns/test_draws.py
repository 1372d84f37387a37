"""Repetitions of the cases of a sampler: which cases run again, and how often."""

# mypy: no-strict-optional

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import pytest
from support.campaigning import run_campaign

from merge_sumo import api
from merge_sumo.campaigns.draws import RepeatingSampler
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.summary import by_case, failing_cases
from merge_sumo.printable import counted
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.scenario.case import Case, Pool
from merge_sumo.scenario.imperfection import Sensing
from merge_sumo.scenario.scenario import US23
from merge_sumo.testing.contracts import SamplerContract, play_case

POOL = Pool(levels=(0,), scenario=US23)


class Thrice(RepeatingSampler):
    """A sampler whose cases run three times."""

    about, colour = "repeats all", "#123456"

    def __init__(self, pool: Pool, seed: int) -> None:
        super().__init__(make_sampler("coverage", pool, seed), 3)


class TestThrice(SamplerContract):
    sampler = Thrice

    def test_proposes_cases_at_every_level(self):
        """Three cases are one, with three draws."""
        assert {case.level for case in self.fresh().ask(9)} == {0, 1, 2}

    def test_proposes_cases_at_every_level_while_cases_run(self):
        sampler, pending = self.fresh(), list[Case]()
        for _ in range(9):
            pending += sampler.ask(1)
            sampler.pend(pending)
        assert [case.draw for case in pending] == [0, 1, 2] * 3
        assert {case.level for case in pending} == {0, 1, 2}


@pytest.mark.parametrize("sizes", [(9, 9, 9), (4, 1, 10, 12)])
def test_every_case_runs_as_often_as_stated_however_batches_are_cut(sizes):
    sampler, outcomes = Thrice(POOL, 1), list[Outcome]()
    for batch, size in enumerate(sizes):
        cases = sampler.ask(size)
        assert len(cases) == size
        ran = [play_case(len(outcomes) + place, batch, case) for place, case in enumerate(cases)]
        sampler.tell(ran)
        outcomes += ran
    draws = Counter(outcome.case.start for outcome in outcomes)
    assert set(draws.values()) == {3}
    assert len({outcome.case for outcome in outcomes}) == 27
    assert sampler.batch_size() % 3 == 0


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


class TestACampaign:
    """A controller that draws by the seed is repeatable: the same bytes, however it ran."""

    def settings(self, tmp_path, **given) -> CampaignSettings:
        vut = tmp_path / "seeded.py"
        vut.write_text(SEEDED)
        known = {"levels": (0,), "cases": 60, "sampler": "gpr", "batch": 10, "tolerated": 0.3}
        known |= {"vut": f"{vut}:Vut", "repeat": 3, "scenario": US23}
        return CampaignSettings(**{**known, **given})

    def test_counts_cases_and_not_runs_in_what_it_says(self, tmp_path):
        run_campaign(self.settings(tmp_path), tmp_path / "run")
        opened = api.CampaignRun(tmp_path / "run", gates=["failures"])
        failing = failing_cases(opened.run.outcomes, 0.3)
        assert opened.summary.failures == opened.verdict.failures
        assert opened.summary.undecided == opened.verdict.undecided > 0
        assert opened.summary.failures + opened.summary.undecided == len(failing)
        assert opened.verdict.cases == len(by_case(opened.run.outcomes))
        facts = {fact.name: fact.value for fact in opened.facts}
        assert facts["runs"] == 60
        assert facts["share of its runs in which a case may fail"] == 30.0
        assert len(opened.failures) == len(failing)
        gate = opened.gates[0]
        counts = f"{counted(opened.summary.failures, 'failure')} and {opened.summary.undecided}"
        assert (gate.met, gate.found) == (True, f"{counts} undecided")


def test_nothing_is_tolerated_where_all_runs_of_a_case_are_the_same():
    known: dict[str, Any] = {"vut": "design2", "levels": (0,), "repeat": 2, "tolerated": 0.2}
    assert CampaignSettings(**known, scenario=US23).tolerated == 0.0
    noisy = replace(US23, sense=Sensing(noise_x_m=1.0))
    assert CampaignSettings(**known, scenario=noisy).tolerated == 0.2
