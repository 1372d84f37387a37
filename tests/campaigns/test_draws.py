"""Repeats among the picks of a sampler: which cases run again, and how often."""

# mypy: no-strict-optional

from __future__ import annotations

import zlib
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from campaigning import run_campaign

from merge_sumo import api
from merge_sumo.campaigns.draws import EachCaseRepeated, RepeatedWhereItMatters
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.samplers.base import Sampler
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.scenario.case import Case, Pool
from merge_sumo.scenario.imperfection import Sensing
from merge_sumo.scenario.scenario import US23
from merge_sumo.scenario.trajectory import End
from merge_sumo.system.printable import counted
from merge_sumo.testing.contracts import SamplerContract, play, play_case
from merge_sumo.verdict.chance import by_case, failing_cases, is_decided
from merge_sumo.verdict.score import Measures, Outcome

POOL = Pool(levels=(0,), scenario=US23)


class Recognising(RepeatedWhereItMatters):
    """A sampler that looks for chance in what is none."""

    about, colour = "repeats where it matters", "#123456"

    def __init__(self, pool: Pool, seed: int) -> None:
        super().__init__(make_sampler("gpr", pool, seed), 0.2)


class Deciding(RepeatedWhereItMatters):
    """A sampler that knows of chance."""

    about, colour = "repeats what fails", "#123456"

    def __init__(self, pool: Pool, seed: int) -> None:
        super().__init__(make_sampler("coverage", pool, seed), 0.2, known=True)


class Thrice(EachCaseRepeated):
    """A sampler whose cases run three times."""

    about, colour = "repeats all", "#123456"

    def __init__(self, pool: Pool, seed: int) -> None:
        super().__init__(make_sampler("coverage", pool, seed), 3)


class TestRecognising(SamplerContract):
    sampler = Recognising


class TestDeciding(SamplerContract):
    sampler = Deciding

    def test_proposes_cases_at_every_level(self):
        """A batch of as many cases as levels has repeats, too."""
        sampler, _, _ = self.played()
        assert {case.level for case in sampler.ask(12)} == {0, 1, 2}


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


def test_a_deterministic_vut_costs_few_repeats():
    """5 among the first 40 cases, then one more at 80, 160, 320 and 640."""
    sampler = RepeatedWhereItMatters(make_sampler("uniform", POOL, 1), 0.0)
    outcomes = play(sampler, 40, 20)
    assert sum(outcome.case.draw > 0 for outcome in outcomes) == 9
    repeated = [one for one in by_case(outcomes) if one.runs > 1]
    assert {one.runs for one in repeated} == {2}
    assert sum(one.failures == 2 for one in repeated) >= 6, (
        "failures come first, once some are known"
    )


def chance(index: int, batch: int, case: Case, share: float = 0.5) -> Outcome:
    """Return an outcome that fails in a share of the draws in the left half of the square."""
    (x,) = [(case.x_pov0_m + 340.0) / 160.0]
    drawn = zlib.crc32(repr((case.told_seed, 7)).encode()) / 2**32
    failed = x < 0.5 and drawn < share
    score = (-600.0 if failed else -100.0) - drawn
    measures = Measures(end=End.MERGED, score=score, t_end_s=8.3, dx_m=1.0 if failed else 20.0)
    return Outcome(index, batch, case, measures)


def play_chance(sampler: Sampler, batches: int, n: int, share: float) -> list[Outcome]:
    outcomes: list[Outcome] = []
    for batch in range(batches):
        first = len(outcomes)
        ran = [chance(first + i, batch, case, share) for i, case in enumerate(sampler.ask(n))]
        sampler.tell(ran)
        outcomes += ran
    return outcomes


@pytest.mark.parametrize(("share", "tolerated"), [(0.1, 0.4), (0.9, 0.4), (0.05, 0.25)])
def test_chance_is_seen_and_failing_cases_are_decided_as_they_are(share, tolerated):
    sampler = RepeatedWhereItMatters(make_sampler("uniform", POOL, 1), tolerated)
    outcomes = play_chance(sampler, 20, 20, share)
    repeats = [outcome for outcome in outcomes if outcome.case.draw]
    assert repeats[0].index == 20, "in the second batch, as one case in eight"
    assert len(repeats) <= len(outcomes) // 2
    early = [one for one in by_case(outcomes) if one.outcomes[0].batch < 12 and one.failures]
    decided = [one for one in early if is_decided(one.failures, one.runs, tolerated)]
    assert len(decided) > 0.7 * len(early)
    right = [one for one in decided if (one.share > tolerated) is (share > tolerated)]
    assert len(right) > 0.9 * len(decided)
    assert all(outcome.case.draw < 20 for outcome in outcomes)


def test_with_nothing_tolerated_a_failing_case_runs_three_times():
    sampler = RepeatedWhereItMatters(make_sampler("uniform", POOL, 1), 0.0)
    outcomes = play_chance(sampler, 20, 20, 0.5)
    failing = failing_cases(outcomes)
    assert {one.runs for one in failing if one.outcomes[0].batch < 15} == {3}
    passing = [one for one in by_case(outcomes) if not one.failures]
    assert sum(one.runs > 1 for one in passing) <= 5


def test_decisions_that_add_coverage_come_first():
    """A case beside one that is decided adds little; one far from it adds a ball."""
    points = np.array([[0.2, 0.5], [0.21, 0.5], [0.4, 0.5]])
    decided, beside, far = POOL.cases(points, 0)
    runs = [*(replace(decided, draw=draw) for draw in range(4)), beside, far]
    fails = Measures(end=End.MERGED, score=-600.0, t_end_s=8.0)
    sampler = RepeatedWhereItMatters(make_sampler("uniform", POOL, 1), 0.2, known=True)
    sampler.tell([Outcome(index, 0, case, fails) for index, case in enumerate(runs)])
    first, second, *_ = sampler.ask(4)
    # By Jeffreys' prior a second failure decides: P(share > .2) = .959 with Beta(1.5, .5).
    assert (first, second) == (replace(far, draw=1), replace(beside, draw=1))


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
        known |= {"vut": f"{vut}:Vut", "repeat": "auto", "scenario": US23}
        return CampaignSettings(**{**known, **given})

    def test_counts_cases_and_not_runs_in_what_it_says(self, tmp_path):
        run_campaign(self.settings(tmp_path), tmp_path / "run")
        opened = api.results.CampaignRun(tmp_path / "run", gates=["failures"])
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


def test_the_package_s_own_vuts_repeat_nothing_without_noise():
    known: dict[str, Any] = {"vut": "design2", "levels": (0,), "repeat": "auto", "tolerated": 0.2}
    settings = CampaignSettings(**known, scenario=US23)
    assert settings.tolerated == 0.0, "each run of a case is the same"
    sampler = settings.new_sampler()
    assert settings.with_repeats(sampler) is sampler
    noisy = replace(US23, sense=Sensing(noise_x_m=1.0))
    settings = CampaignSettings(**known, scenario=noisy)
    assert settings.tolerated == 0.2
    assert isinstance(settings.with_repeats(sampler), RepeatedWhereItMatters)
