"""Versions compared where chance decides: what is no regression, and by what."""

# mypy: no-strict-optional

from __future__ import annotations

from dataclasses import replace

import pytest

from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.settings import controllers
from merge_sumo.errors import UserError
from merge_sumo.studies.run_study import RunStudy
from merge_sumo.studies.versions import Change, ComparedCase, compare_runs, rerun, settings_today
from merge_sumo.values.case import MergeCase
from merge_sumo.values.chance import RunsOfCase
from merge_sumo.values.scenario import US23
from merge_sumo.values.score import Measures, Outcome
from merge_sumo.values.trajectory import End

CASE = MergeCase(level=0, x_pov0_m=-273.0, v_pov0_mps=33.0, scenario=US23)
COIN = """
import random
class Coin:
    def reset(self, seen, seed):
        self.stops = random.Random(seed).random() < {share}
    def act(self, seen):
        return -3.0 if self.stops else 0.5
"""


def runs(failures: int, count: int) -> RunsOfCase:
    """Return runs of a case, the failing ones first."""
    scores = [-600.0 if draw < failures else -20.0 for draw in range(count)]
    made = [
        Outcome(
            draw,
            0,
            replace(CASE, draw=draw),
            Measures(end=End.MERGED, score=score, t_end_s=8.0, dx_m=score + draw),
        )
        for draw, score in enumerate(scores)
    ]
    return RunsOfCase(CASE, tuple(made))


def compared(before: tuple[int, int], after: tuple[int, int], tolerated: float) -> ComparedCase:
    a, b = runs(*before), runs(*after)
    return ComparedCase("A", 0, a.deciding(tolerated), b.deciding(tolerated), a, b)


@pytest.mark.parametrize(
    ("before", "after", "tolerated", "change"),
    [
        ((3, 10), (5, 10), 0.4, Change.WITHIN_CHANCE),
        ((5, 10), (3, 10), 0.4, Change.WITHIN_CHANCE),
        ((3, 10), (5, 10), 0.0, Change.BOTH_FAIL),
        ((0, 10), (6, 10), 0.4, Change.BROKE),
        ((6, 10), (0, 10), 0.4, Change.FIXED),
    ],
)
def test_shares_that_chance_may_give_are_no_change(before, after, tolerated, change):
    one = compared(before, after, tolerated)
    assert one.change is change


def test_the_sentence_says_by_what():
    # Fisher's exact test of 3 of 10 against 5 of 10.
    one = compared((3, 10), (5, 10), 0.4)
    assert one.became == ("3 of 10 runs fail -> 5 of 10 runs fail, by Fisher's exact test p = 0.65")
    record = one.to_record()
    assert (record["failed_runs_a"], record["runs_a"], record["failed_runs_b"]) == (3, 10, 5)


@pytest.fixture(scope="module")
def campaigns(tmp_path_factory):
    """Return campaigns of two coins, which stop in three and in four of ten runs."""
    from campaigning import run_campaign

    from merge_sumo.campaigns.settings import CampaignSettings

    folder = tmp_path_factory.mktemp("versions")
    made = []
    for name, share in (("a", 0.3), ("b", 0.4)):
        (folder / f"{name}.py").write_text(COIN.format(share=share))
        settings = CampaignSettings(
            vut=f"{folder / name}.py:Coin",
            levels=(0,),
            sampler="uniform",
            cases=60,
            repeat=10,
            tolerated=0.35,
            scenario=US23,
            fail_when='end == "TIMEOUT"',
        )
        made.append(run_campaign(settings, folder / f"run-{name}"))
    return made


def test_campaigns_with_repeats_compare_case_by_case(campaigns):
    a, b = campaigns
    assert [len(run.outcomes) for run in (a, b)] == [60, 60]
    assert [len(run.cases) for run in (a, b)] == [6, 6]
    found = compare_runs(a, b, given=(controllers(a.settings), controllers(b.settings)))
    assert "was run again" in found.evidence
    telling = sum(outcome.failed for run in (a, b) for outcome in run.cases)
    assert len(found.cases) == telling
    for one in found.cases:
        assert (one.runs_a.runs, one.runs_b.runs) == (10, 10)
        # The same seeds: what stops below .3 stops below .4, too.
        assert one.runs_a.failures <= one.runs_b.failures
    assert found.levels[0].changes["broke"] == 0, "no case is told apart by ten runs"


def test_a_rerun_of_repeats_is_judged_by_case(campaigns):
    run = campaigns[0]
    today = settings_today(run, controllers(run.settings))
    again = rerun(RunStudy(run, today, resolve(today)))
    assert again.changed == []
    assert [outcome.case for outcome in again.after] == [outcome.case for outcome in run.outcomes]


def test_campaigns_that_tolerate_other_shares_do_not_compare(campaigns):
    a, b = campaigns
    b.settings["tolerated"] = 0.2
    with pytest.raises(UserError, match="with the same --tolerate"):
        compare_runs(a, b)
    b.settings["tolerated"] = 0.35
