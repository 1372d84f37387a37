"""The stopping rule: what it asks for, and that it is a pure function of the outcomes."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from campaigning import campaign_settings, run_campaign

from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.campaigns.stopping import PATIENCE, StoppingRule, covered_balls, gained
from merge_sumo.errors import UserError
from merge_sumo.samplers.registry import SAMPLERS
from merge_sumo.samplers.uniform import UniformSampler
from merge_sumo.values.case import MergeCase, Pool
from merge_sumo.values.scenario import US23
from merge_sumo.values.score import Measures, Outcome
from merge_sumo.values.trajectory import End


class Oracle(UniformSampler):
    """Expects what a test says, by the number of batches that it was told."""

    says: tuple[float, ...] = ()
    asked = 0

    def expected_gain(self, n: int) -> float:
        Oracle.asked += 1
        batches = {outcome.batch for outcome in self.observed()}
        return self.says[len(batches) - 1]


def outcomes(*failures_by_batch: int, safe: int = 1) -> list[Outcome]:
    """Return batches with some failures, each 10 m (more than a ball) from the others."""
    ran: list[Outcome] = []
    found = 0
    for batch, failures in enumerate(failures_by_batch):
        for place in range(failures + safe):
            failed = place < failures
            x = -340.0 + 16.0 * found if failed else -181.0
            found += failed
            case = MergeCase(level=0, x_pov0_m=x, v_pov0_mps=30.0, scenario=US23)
            end, score = End.MERGED, -600.0 if failed else -1.0
            measures = Measures(end=end, score=score, t_end_s=8.3)
            ran.append(Outcome(len(ran), batch, case, measures))
    return ran


def rule(monkeypatch, *says: float, share: float = 0.1) -> StoppingRule:
    monkeypatch.setattr(Oracle, "says", says)
    return StoppingRule(share, 20, lambda: Oracle(Pool(levels=(0,), scenario=US23), 0))


class TestTheRule:
    def test_stops_when_little_was_expected_three_times_in_a_row(self, monkeypatch):
        stop = rule(monkeypatch, 9.0, 0.05, 0.05, 0.05)
        assert not stop(outcomes(4))
        assert not stop(outcomes(4, 0))
        assert not stop(outcomes(4, 0, 0))
        assert stop(outcomes(4, 0, 0, 0))

    @pytest.mark.parametrize("says", [(9, 0.05, 0.2, 0.05), (9, 0.05, 0.05, 0.1), (9, 1, 0, 0)])
    def test_goes_on_when_one_of_the_three_promised_more(self, monkeypatch, says):
        assert not rule(monkeypatch, *says)(outcomes(4, 0, 0, 0))

    def test_goes_on_while_the_batches_find_more_than_was_expected(self, monkeypatch):
        stop = rule(monkeypatch, 9.0, 0.05, 0.05, 0.05)
        # Four balls, then two new ones in three batches: 50 %, where 3 x 10 % is the limit.
        assert not stop(outcomes(4, 1, 1, 0))
        assert stop(outcomes(4, 1, 0, 0)), "25 % in three batches is below it"

    def test_goes_on_while_no_failure_is_known(self, monkeypatch):
        stop = rule(monkeypatch, *[0.0] * 8)
        assert not stop(outcomes(0, 0, 0, 0, 0, 0, 0, 0))

    def test_needs_more_batches_than_its_patience(self, monkeypatch):
        stop = rule(monkeypatch, *[0.0] * 8)
        assert not stop([])
        assert not stop(outcomes(*[4] + [0] * (PATIENCE - 1)))
        assert stop(outcomes(*[4] + [0] * PATIENCE))

    def test_says_the_same_when_it_is_asked_for_the_first_time_late(self, monkeypatch):
        """As a resumed campaign asks."""
        says = (9.0, 0.2, 0.05, 0.05, 0.05, 0.3)
        steady = rule(monkeypatch, *says)
        ran = outcomes(4, 1, 0, 0, 0, 0)
        for last in range(6):
            so_far = [o for o in ran if o.batch <= last]
            assert steady(so_far) == rule(monkeypatch, *says)(so_far) == (last == 4)

    def test_works_out_once_what_was_expected_after_a_batch(self, monkeypatch):
        stop = rule(monkeypatch, *[0.0] * 6)
        monkeypatch.setattr(Oracle, "asked", 0)
        for last in range(6):
            stop(outcomes(*[4, 0, 0, 0, 0, 0][: last + 1]))
        assert Oracle.asked == 5, "after batches 1 to 5; never of the first alone"

    def test_counts_coverage_in_balls(self):
        assert covered_balls([]) == 0.0
        assert covered_balls(outcomes(3)) == pytest.approx(3.0)
        assert gained(outcomes(2, 1), 0) == pytest.approx(0.5)
        assert gained(outcomes(0, 1), 0) == math.inf


@pytest.mark.parametrize(
    ("sampler", "share", "said"),
    [
        *(("coverage", share, "--stop-after-converged is") for share in (0.0, 1.0, -0.1, math.nan)),
        *((name, 0.01, "choose --sampler coverage") for name in SAMPLERS if name != "coverage"),
    ],
)
def test_a_share_that_is_none_and_a_sampler_that_cannot_tell_are_refused(sampler, share, said):
    asked: dict[str, Any] = {"sampler": sampler, "stop_after_converged": share}
    with pytest.raises(UserError, match=said):
        campaign_settings(vut="design1", **asked)


@pytest.mark.slow
def test_a_campaign_stops_early_and_its_outcomes_are_a_beginning_of_the_whole(tmp_path):
    plan: dict[str, Any] = {
        "vut": "design1",
        "levels": (0,),
        "sampler": "coverage",
        "cases": 120,
        "batch": 20,
    }
    whole = run_campaign(CampaignSettings(**{"scenario": US23, **plan}), tmp_path / "whole")
    early = run_campaign(
        CampaignSettings(**{"scenario": US23, **plan}, stop_after_converged=0.9), tmp_path / "early"
    )
    assert 80 <= len(early.outcomes) < len(whole.outcomes) == 120
    assert len(early.outcomes) % 20 == 0
    text = (tmp_path / "whole" / "outcomes.jsonl").read_bytes()
    assert text.startswith((tmp_path / "early" / "outcomes.jsonl").read_bytes())
    recorded = json.loads((tmp_path / "early" / "campaign.json").read_text())
    assert recorded["stop_after_converged"] == 0.9
