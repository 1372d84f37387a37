# mypy: no-strict-optional
"""Audit cases: uniform whatever was found, marked, and a bound that holds at any time."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from campaigning import campaign_settings, resume_campaign, run_campaign
from scipy.stats import kstest

from merge_sumo.analysis.audit import (
    ALL,
    CONFIDENCE,
    LATE,
    NONE_MISSED,
    AuditCase,
    audit_cases,
    missed_share,
    missed_shares,
    share_at_most,
)
from merge_sumo.campaigns.audit import Audit, AuditedSampler
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.campaigns.stopping import StoppingRule
from merge_sumo.campaigns.store import Run
from merge_sumo.errors import UserError
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.values.audit_mark import AuditMark
from merge_sumo.values.case import Case, Pool, to_unit
from merge_sumo.values.fmc import RADIUS
from merge_sumo.values.scenario import US23
from merge_sumo.values.score import Measures, Outcome
from merge_sumo.values.trajectory import End

POOL = Pool(levels=(0, 1, 2), scenario=US23)
SEEDS = 200
HOLD = 186
"""Intervals of 95 % that must hold among 200."""


def outcome(index: int, case: Case, failed: bool | None, batch: int | None = None) -> Outcome:
    """Return the outcome of a case; None for one without a verdict."""
    end = End.VUT_ERROR if failed is None else End.MERGED
    score = None if failed is None else -600.0 if failed else -1.0
    measures = Measures(end=end, score=score, t_end_s=8.3, error="x" if failed is None else None)
    return Outcome(index, index if batch is None else batch, case, measures)


def found(*missed: bool, levels=(0,), first=0) -> list[AuditCase]:
    """Return audit cases whose levels take turns."""
    return [AuditCase(first + n, levels[n % len(levels)], one) for n, one in enumerate(missed)]


class TestWhichCases:
    @pytest.mark.parametrize(("number", "cases"), [(1, 1), (1, 7), (7, 40), (40, 40), (80, 800)])
    def test_are_as_many_as_stated_and_spread_evenly(self, number, cases):
        audit = Audit(number, cases, POOL, 0)
        indices = [index for index in range(cases) if index in audit]
        assert len(indices) == number
        assert np.ptp(np.diff([-1, *indices])) <= 1
        levels = [audit.case(index).level for index in indices]
        assert levels == [n % 3 for n in range(number)]

    def test_are_uniform_and_follow_from_the_seed_alone(self):
        audit, other = (Audit(3000, 3000, POOL, seed) for seed in (0, 1))
        cases = [audit.case(index) for index in range(3000)]
        assert cases[:20] == [Audit(3000, 3000, POOL, 0).case(index) for index in range(20)]
        assert cases[5] != other.case(5)
        for level in POOL.levels:
            points = to_unit((c for c in cases if c.level == level), level)
            assert len(points) == 1000
            assert all(kstest(column, "uniform").pvalue > 0.001 for column in points.T)

    @pytest.mark.parametrize("name", ["uniform", "gpr", "coverage"])
    def test_are_in_their_places_and_the_others_are_the_picks_of_the_sampler(self, name):
        audit = Audit(10, 30, POOL, 4)
        sampler = AuditedSampler(make_sampler(name, POOL, 4), audit)
        alone = make_sampler(name, POOL, 4)
        first = sampler.ask(15)
        assert first == sampler.ask(15)
        assert [case for place, case in enumerate(first) if place not in audit] == alone.ask(10)
        assert [first[place] for place in (2, 5, 8)] == [audit.case(place) for place in (2, 5, 8)]
        assert sampler.prediction(2) is None
        ran = [outcome(place, case, place % 2 == 0, 0) for place, case in enumerate(first)]
        sampler.tell(ran)
        alone.tell(ran)
        then = sampler.ask(15)
        assert [c for place, c in enumerate(then, 15) if place not in audit] == alone.ask(10)
        assert sampler.learns == alone.learns


class TestTheMark:
    def test_is_the_distance_to_the_nearest_failure_of_earlier_batches(self):
        audit = Audit(4, 4, Pool(levels=(0,), scenario=US23), 0)
        at = POOL.cases(np.array([[0.5, 0.5], [0.5, 0.54], [0.5, 0.6], [0.9, 0.5]]), 0)
        ran = [outcome(0, at[0], True), *(outcome(n, at[n], True, 1) for n in (1, 2, 3))]
        first = audit.mark(ran[:1], [])
        marked = [*first, *audit.mark(ran[1:], first)]
        nearest = [one.audit.nearest_failure for one in marked]
        assert nearest[0] is None
        assert nearest[1:] == pytest.approx([0.04, 0.1, 0.4])
        missed = [case.missed for case in audit_cases(marked)]
        assert missed == [True, False, True, True]
        assert RADIUS == 0.05

    def test_makes_no_miss_of_a_safe_case_and_one_of_a_case_without_a_verdict(self):
        at = POOL.cases(np.array([[0.5, 0.5]]), 0)[0]
        mark = AuditMark(nearest_failure=0.3)
        cases = [Outcome(0, 0, at, outcome(0, at, f).measures, audit=mark) for f in (False, None)]
        assert [case.missed for case in audit_cases(cases)] == [False, True]

    def test_is_in_the_line_of_the_outcome_and_in_no_other(self):
        at = POOL.cases(np.array([[0.5, 0.5]]), 0)[0]
        plain = outcome(0, at, False)
        marked = Outcome(0, 0, at, plain.measures, audit=AuditMark())
        assert "audit" not in plain.to_record()
        assert marked.to_record()["audit"] == {"nearest_failure": None}
        assert Outcome.from_json(json.dumps(marked.to_record()), US23) == marked


class TestTheBound:
    def test_without_a_miss_by_hand(self):
        """The capital without misses: .7 h^n, and .3 times the mean of h^n over theta."""
        n, goal = 40, 20.0

        def capital(u: float) -> float:
            thetas = (np.arange(20_000) + 0.5) / 20_000
            safe = ((1.0 - thetas * u) / (1.0 - u)) ** n
            return NONE_MISSED * (1.0 - u) ** -n + (1.0 - NONE_MISSED) * float(safe.mean())

        bound = share_at_most(((1.0, 0, n),), 0.05)
        assert capital(bound) == pytest.approx(goal, rel=1e-6)
        assert bound < 1.2 * (1.0 - 0.05 ** (1.0 / n)), "at one time alone it would be this"

    def test_with_misses_by_hand(self):
        def capital(u: float) -> float:
            thetas = (np.arange(20_000) + 0.5) / 20_000
            each = thetas**2 * ((1.0 - thetas * u) / (1.0 - u)) ** 50
            return (1.0 - NONE_MISSED) * float(each.mean())

        assert capital(share_at_most(((1.0, 2, 50),), 0.05)) == pytest.approx(20.0, rel=1e-6)

    def test_of_a_pool_counts_a_round_with_a_miss_by_its_misses_alone(self):
        cases = found(*[False] * 6, True, False, False, False, levels=(0, 1, 2))
        whole = missed_share(cases, (0, 1, 2))
        counts = (ALL, 1, 6), (1.0 - ALL, 0, 0)  # the last round is not whole
        assert whole.at_most == pytest.approx(share_at_most(counts, 1.0 - CONFIDENCE))
        assert (whole.cases, whole.missed) == (10, 1)
        by_level = missed_shares(cases, (0, 1, 2))
        assert [by_level[level].missed for level in (0, 1, 2)] == [1, 0, 0]
        assert by_level[0].at_most > by_level[1].at_most

    def test_falls_with_cases_and_rises_with_misses(self):
        bounds = [missed_share(found(*[False] * n), (0,)).at_most for n in (1, 10, 100)]
        assert bounds == sorted(bounds, reverse=True)
        assert missed_share(found(*[False] * 99, True), (0,)).at_most > bounds[2]
        assert missed_share([], (0,)) is None
        assert math.isclose(missed_share(found(True), (0,)).at_most, 1.0)

    def test_recovers_from_misses_at_the_beginning_of_the_search(self):
        early = found(True, True, True, *[False] * 20)
        late = found(*[False] * 100, first=LATE)
        at_most = missed_share(early + late, (0,)).at_most
        assert at_most < 0.07
        assert missed_share(found(*[True] * 3, *[False] * 120), (0,)).at_most > at_most

    @pytest.mark.parametrize("u", [0.03, 0.2])
    def test_is_ever_below_the_share_as_seldom_as_it_says_by_all_results(self, u):
        """Follow the chances of all numbers of misses: a bound that was once too small ends."""
        open_, wrong = {0: 1.0}, 0.0
        for n in range(1, 81):
            then: dict[int, float] = {}
            for k, chance in open_.items():
                for missed, p in ((0, 1.0 - u), (1, u)):
                    then[k + missed] = then.get(k + missed, 0.0) + chance * p
            held = {}
            for k, chance in then.items():
                if share_at_most(((1.0, k, n - k),), 0.05) < u:
                    wrong += chance
                else:
                    held[k] = chance
            open_ = held
        assert wrong <= 0.05
        assert u < 0.1 or wrong > 0.005, "and it is not idle"


class TestASearchThatReacts:
    """A failing set with a known share, and a search that looks around what its audit has found."""

    def play(self, seed: int, shares: tuple[float, ...], audit_number: int) -> bool:
        """Return whether the bound of the pool held after every audit case."""
        levels = tuple(range(len(shares)))
        rng = np.random.default_rng([seed, 5])
        # Failures are columns of the unit square that are far from each other; a found failure
        # covers its column only, so the share that is left is known.
        left = {level: list(rng.permutation(10)) for level in levels}
        cases: list[AuditCase] = []
        for number in range(audit_number):
            level = levels[number % len(levels)]
            column = int(rng.integers(10))
            missed = column in left[level] and rng.random() < shares[level]
            cases.append(AuditCase(number, level, missed))
            if missed:
                # The search finds out all about it, and in a panic about other levels, too.
                left[level].remove(column)
                for other in levels:
                    if left[other] and rng.random() < 0.5:
                        left[other].pop()
            share = float(np.mean([shares[n] * len(left[n]) / 10 for n in levels]))
            bound = missed_share(cases, levels)
            if bound.at_most < share:
                return False
        return True

    @pytest.mark.parametrize(
        "shares", [(0.1,), (0.4, 0.01), (0.05, 0.05, 0.05)], ids=["one", "unequal", "three"]
    )
    def test_holds_at_every_time_in_186_of_200_seeds(self, shares):
        assert sum(self.play(seed, shares, 60) for seed in range(SEEDS)) >= HOLD


def campaign(folder, **settings: Any) -> Run:
    asked: dict[str, Any] = {"vut": "design1", "levels": (0, 1), "cases": 48, "sampler": "gpr"}
    return run_campaign(CampaignSettings(**{"scenario": US23, **asked, **settings}), folder)


class TestACampaign:
    def test_has_its_audit_cases_among_its_cases(self, tmp_path):
        run = campaign(tmp_path / "run", audit=12)
        marked = [outcome.index for outcome in run.outcomes if outcome.audit is not None]
        assert marked == list(range(3, 48, 4))
        levels = [outcome.case.level for outcome in run.outcomes if outcome.audit is not None]
        assert levels == [0, 1] * 6
        again = Run(tmp_path / "run").outcomes
        assert again == run.outcomes
        # A campaign of twice the cases would have its audit cases elsewhere.
        for change in ({"cases": 96}, {"audit": 24}):
            for force in (False, True):
                with pytest.raises(UserError, match="48 cases, 12 of them audit cases"):
                    resume_campaign(tmp_path / "run", change, force=force)

    def test_has_the_same_audit_cases_whatever_the_batches(self, tmp_path):
        campaign(tmp_path / "a", audit=12, sampler="uniform")
        campaign(tmp_path / "b", audit=12, sampler="uniform", batch=5)
        cases = [[o.case for o in Run(tmp_path / name).outcomes] for name in "ab"]
        places = range(3, 48, 4)
        assert [cases[0][n] for n in places] == [cases[1][n] for n in places]

    def test_has_the_same_audit_cases_with_cases_in_flight(self, tmp_path):
        campaign(tmp_path / "a", audit=12)
        campaign(tmp_path / "b", audit=12, in_flight=6)
        runs = [Run(tmp_path / name).outcomes for name in "ab"]
        audited = [[o.case for o in run if o.audit is not None] for run in runs]
        assert audited[0] == audited[1]
        assert len(audited[0]) == 12
        before = (tmp_path / "b" / "outcomes.jsonl").read_bytes()
        lines = before.splitlines(keepends=True)
        (tmp_path / "b" / "outcomes.jsonl").write_bytes(b"".join(lines[:20]))
        resume_campaign(tmp_path / "b")
        assert (tmp_path / "b" / "outcomes.jsonl").read_bytes() == before

    def test_says_what_it_may_have_missed(self, run, tmp_path, command_line):
        out = tmp_path / "run"
        options = ("--vut", "design1", "--level", "0", "--cases", "30", "--audit", "15")
        code, said, err = command_line(
            "campaign", *options, "--sampler", "uniform", "--out", out, "--workers", "1", "--json"
        )
        assert code in (0, 1), err
        record = json.loads(said)
        assert record["missed"]["cases"] == 15
        assert record["missed"] == record["levels"]["0"]["missed"]
        assert 0.15 < record["missed"]["at_most"] <= 1.0
        page = (out / "report.html").read_text()
        assert "in 15 audit cases" in page
        assert "<dt>audit</dt>" in page

    @pytest.mark.parametrize(
        ("settings", "said"),
        [
            ({"audit": 0}, "--audit is 0: it must be 1 or more"),
            ({"audit": 49}, "--audit is 49 and --cases is 48"),
            (
                {"audit": 40, "sampler": "coverage", "stop_after_converged": 0.05},
                "at best, so many audit cases bound",
            ),
        ],
    )
    def test_refuses_audits_that_make_no_sense(self, settings, said):
        with pytest.raises(UserError, match=said):
            CampaignSettings(
                **{"vut": "design1", "levels": (0,), "cases": 48, "scenario": US23, **settings}
            )

    def test_stops_only_when_little_may_have_been_missed(self):
        settings = campaign_settings(
            vut="design1", cases=400, audit=200, stop_after_converged=0.05, sampler="coverage"
        )
        stop, audit = settings.stopping_rule(), settings.audit_plan
        assert isinstance(stop, StoppingRule)
        stop._expected = dict.fromkeys(range(100), 0.0)
        at = POOL.cases(np.array([[0.5, 0.5]]), 0)[0]

        def ran(cases: int, missed: tuple[int, ...] = ()) -> list[Outcome]:
            outcomes: list[Outcome] = []
            for index in range(cases):
                failed = index == 0 or index in missed
                case = audit.case(index) if index in audit and index else at
                outcomes += audit.mark([outcome(index, case, failed, index // 20)], outcomes)
            return outcomes

        assert not stop(ran(100)), "50 audit cases leave 7 % open"
        assert stop(ran(200))
        assert not stop(ran(200, missed=(101,)))
        assert not stop([o for o in ran(200) if o.index != 151]), "one without a verdict"
