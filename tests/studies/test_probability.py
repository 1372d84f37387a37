"""Failure probability: closed-form failure sets, known densities, intervals that hold."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from campaigning import campaign_settings, run_campaign
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom, kstest, norm, truncnorm

from merge_sumo.analysis.exposure import read_distribution
from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.settings import settings_of
from merge_sumo.errors import UserError
from merge_sumo.studies import probability
from merge_sumo.studies.run_study import RunStudy
from merge_sumo.studies.stratified import (
    CELLS,
    DEFENSIVE,
    Strata,
    cells,
    estimate,
    of_cells,
    risks,
    upper_end,
)
from merge_sumo.values.case import V_POV0, dimensions
from merge_sumo.values.chance import clopper_pearson
from merge_sumo.values.scenario import US23

LEVELS = (0, 1, 2)
UNIFORM = read_distribution(None, LEVELS, scenario=US23)


def band(points, half_width):
    """Fail in a diagonal band, as the designs do."""
    return np.abs(0.6 * points[:, 0] + 0.8 * points[:, 1] - 0.7) < half_width


def band_area(half_width):
    """Return the area of the band in the unit square, for half widths up to 0.1."""
    # It leaves the square through the sides u = 0 and u = 1 and is 2 w / 0.8 high everywhere.
    return 2.0 * half_width / 0.8


def strata_by(chance, cases, weights=None, confidence=0.95) -> Strata:
    return Strata(weights or {1: 1.0}, chance, US23, cases, confidence)


def knowing(half_width, cases, blur=0.005, confidence=0.95):
    """Return strata of a surrogate that knows the band, but not sharply."""
    middle = cells(2)
    beyond = np.abs(0.6 * middle[:, 0] + 0.8 * middle[:, 1] - 0.7) - half_width
    return strata_by({1: 1.0 / (1.0 + np.exp(beyond / blur))}, cases, confidence=confidence)


def estimate_band(strata, half_width, seed, confidence=0.95):
    draws = strata.draw(np.random.default_rng(seed))
    failed = band(draws.chances[:, :2], half_width)
    return estimate(strata, draws, failed, np.ones(len(failed), dtype=bool), confidence)


def estimate_counts(share, cases, failures, confidence=0.95):
    """Return both ends for failures in the cases of strata."""
    share, cases, failures = map(np.array, (share, cases, failures))
    low, high = risks(len(share), confidence)
    return 1.0 - upper_end(share, cases, cases - failures, low), upper_end(
        share, cases, failures, high
    )


class TestTheStrata:
    def test_have_shares_that_add_up_to_1_and_all_cases(self):
        rng = np.random.default_rng(0)
        chance = {level: rng.random(len(cells(3 if level == 2 else 2))) ** 4 for level in LEVELS}
        strata = strata_by(chance, 600, {0: 0.2, 1: 0.5, 2: 0.3})
        assert strata.share.sum() == pytest.approx(1.0, abs=1e-12)
        assert strata.cases.sum() == 600
        assert (strata.cases >= np.floor(DEFENSIVE * 600 * strata.share)).all()
        assert (np.diff(strata.expected) > 0.0).all()

    def test_draw_what_their_weights_say(self):
        """E[w 1(A)] = p(A), for a set A far from any cell's edge."""
        chance = {1: cells(2)[:, 0] ** 8, 2: cells(3)[:, 2] ** 8}
        strata = strata_by(chance, 40_000, {1: 0.25, 2: 0.75})
        assert len(strata.share) == 3
        draws = strata.draw(np.random.default_rng(1))
        inside = (draws.level == 2) & (draws.chances[:, 2] > 0.9)
        x = draws.weight * inside
        assert x.mean() == pytest.approx(0.075, abs=0.006)
        assert draws.weight.mean() == pytest.approx(1.0, abs=1e-12)

    def test_draw_each_case_from_its_stratum(self):
        strata = knowing(0.05, 2000, blur=0.02)
        draws = strata.draw(np.random.default_rng(2))
        near = np.abs(0.6 * draws.chances[:, 0] + 0.8 * draws.chances[:, 1] - 0.7)
        assert near[draws.stratum == 2].max() < near[draws.stratum == 0].min()
        assert np.array_equal(np.bincount(draws.stratum), strata.cases)

    def test_are_one_where_nothing_is_expected(self):
        strata = strata_by({1: np.zeros(CELLS[2] ** 2)}, 100)
        draws = strata.draw(np.random.default_rng(0))
        assert np.array_equal(draws.weight, np.ones(100))
        assert strata.share.tolist() == [1.0]

    def test_are_found_with_few_predictions(self):
        asked = []

        def expected(points):
            asked.append(len(points))
            return band(points, 0.05).astype(float)

        fine = of_cells(2, expected)
        assert np.mean(fine != band(cells(2), 0.05)) < 0.001
        assert sum(asked) < 0.4 * len(cells(2))


class TestTheInterval:
    @pytest.mark.parametrize(("half_width", "n"), [(0.002, 400), (0.02, 400), (0.1, 150)])
    def test_holds_the_truth_at_least_as_often_as_it_says(self, half_width, n):
        strata = knowing(half_width, n, confidence=0.8)
        truth = band_area(half_width)
        found = [estimate_band(strata, half_width, seed, 0.8) for seed in range(20)]
        held = sum(e.low <= truth <= e.high for e in found)
        assert held >= 0.8 * 20
        assert np.mean([e.probability for e in found]) == pytest.approx(truth, rel=0.25)

    def test_holds_with_a_surrogate_that_looks_in_the_wrong_place(self):
        wrong = strata_by({1: np.exp(-50.0 * cells(2).sum(axis=1))}, 300, confidence=0.8)
        truth, held = band_area(0.02), 0
        for seed in range(20):
            e = estimate_band(wrong, 0.02, seed, 0.8)
            held += e.low <= truth <= e.high
        assert held >= 16

    def test_is_half_as_wide_as_that_of_plain_cases_on_a_rare_set(self):
        truth, n = band_area(0.0036), 600
        ours = [estimate_band(knowing(0.0036, n, blur=0.002), 0.0036, seed) for seed in range(3)]
        plain = clopper_pearson(round(n * truth), n, 0.025)
        assert max(e.high - e.low for e in ours) < 0.6 * (plain[1] - plain[0])

    def test_of_one_stratum_is_that_of_clopper_and_pearson(self):
        assert estimate_counts([1.0], [600], [5]) == pytest.approx(
            clopper_pearson(5, 600, 0.025), abs=1e-12
        )

    def test_by_hand_where_only_the_safe_stratum_is_open(self):
        """No failure in 100 cases of .9 of the pool, and only failures in 10^6 of the rest.

        Of a risk of .0375, .0025 is for values that single strata exclude: .9 (1 - .03375^(1/100))
        remains for the upper end.
        """
        low, high = estimate_counts([0.9, 0.1], [100, 10**6], [0, 10**6])
        assert high == pytest.approx(0.1 + 0.9 * (1.0 - 0.03375 ** (1 / 100)), rel=0.005)
        assert low == pytest.approx(0.1, abs=1e-5)

    @pytest.mark.parametrize(
        ("share", "cases", "p"),
        [
            ((0.9, 0.1), (12, 8), (0.1, 0.6)),
            ((0.9, 0.1), (12, 8), (0.0, 0.5)),
            ((0.5, 0.5), (10, 10), (0.02, 0.1)),
            ((0.8, 0.15, 0.05), (6, 3, 2), (0.05, 0.5, 0.95)),
        ],
    )
    def test_is_wrong_as_often_as_it_says_by_all_results(self, share, cases, p):
        """Sum the chances of all results whose interval does not hold the probability."""
        truth, wrong = float(np.dot(share, p)), np.zeros(2)
        for failures in np.ndindex(*(n + 1 for n in cases)):
            chance = float(np.prod(binom.pmf(failures, cases, p)))
            if chance > 1e-6:
                low, high = estimate_counts(share, cases, failures, 0.8)
                wrong += chance * np.array([low > truth, high < truth])
        assert (wrong <= np.array(risks(len(share), 0.8)) + 1e-4).all()

    @pytest.mark.parametrize(("fails", "p"), [(False, 0.0), (True, 1.0)])
    def test_of_certain_cases_ends_at_the_certain_probability(self, fails, p):
        strata = strata_by({1: np.zeros(CELLS[2] ** 2)}, 1000)
        draws = strata.draw(np.random.default_rng(0))
        e = estimate(strata, draws, np.full(1000, fails), np.ones(1000, dtype=bool), 0.95)
        assert e.probability == p
        assert (e.high if fails else e.low) == pytest.approx(p, abs=1e-12)
        # The rule of three, for half of the risk.
        assert e.high - e.low == pytest.approx(1.0 - 0.025 ** (1 / 1000), rel=1e-9)

    def test_takes_a_case_without_a_verdict_as_safe_below_and_as_a_failure_above(self):
        strata = strata_by({1: np.zeros(CELLS[2] ** 2)}, 400)
        draws = strata.draw(np.random.default_rng(0))
        part = np.random.default_rng(1).permutation(400)
        failed, judged = part < 100, part < 300
        e = estimate(strata, draws, failed, judged, 0.95)
        assert e.low < 0.25
        assert e.high > 0.5
        assert e.probability == pytest.approx(0.25)
        assert e.without_verdict == e.strata[0].without_verdict == 100
        known = estimate(strata, draws, failed, np.ones(400, dtype=bool), 0.95)
        assert known.low == e.low
        assert known.high < e.high

    @given(st.lists(st.integers(0, 20), min_size=3, max_size=3))
    @settings(deadline=None, max_examples=5)
    def test_holds_the_estimate_and_grows_with_each_failure(self, failures):
        share, cases = [0.7, 0.2, 0.1], [20, 20, 20]
        low, high = estimate_counts(share, cases, failures)
        assert 0.0 <= low <= np.dot(share, failures) / 20 + 1e-9 <= high + 2e-9 <= 1.0 + 3e-9
        more = np.minimum(np.add(failures, [1, 0, 0]), 20)
        assert estimate_counts(share, cases, more)[1] >= high - 0.01

    def test_begins_at_zero_where_no_case_fails_and_ends_at_one_where_all_do(self):
        share, cases = [0.7, 0.2, 0.1], [20, 20, 20]
        assert estimate_counts(share, cases, [0, 0, 0])[0] == 0.0
        assert estimate_counts(share, cases, cases)[1] == 1.0

    def test_of_plain_cases_is_the_exact_binomial_one(self):
        # Clopper and Pearson by hand: no failure in n gives 1 - (alpha/2)^(1/n).
        assert clopper_pearson(0, 100, 0.025) == pytest.approx((0.0, 1.0 - 0.025 ** (1 / 100)))
        assert clopper_pearson(100, 100, 0.025) == pytest.approx((0.025 ** (1 / 100), 1.0))
        assert clopper_pearson(10, 100, 0.025) == pytest.approx((0.0490, 0.1762), abs=1e-4)


class TestADistribution:
    def stated(self, tmp_path, text):
        path = tmp_path / "d.json"
        path.write_text(text if isinstance(text, str) else json.dumps(text))
        return read_distribution(path, LEVELS, scenario=US23)

    def sample(self, distribution, level=2, n=4000):
        chances = np.random.default_rng(0).random((n, len(dimensions(level))))
        low = np.array([d.low for d in dimensions(level)])
        high = np.array([d.high for d in dimensions(level)])
        return low + distribution.points(level, chances) * (high - low)

    def test_that_is_not_stated_is_uniform_over_levels_and_pool(self):
        assert UNIFORM.levels == {0: 1 / 3, 1: 1 / 3, 2: 1 / 3}
        chances = np.array([[0.25, 0.5, 0.75]])
        assert UNIFORM.points(2, chances) == pytest.approx(chances)

    def test_has_the_levels_and_marginals_of_its_file(self, tmp_path):
        found = self.stated(
            tmp_path,
            {
                "levels": {"1": 3, "2": 1, "0": 0},
                "x_pov0_m": {"kind": "uniform", "low": -300, "high": -200},
                "v_pov0_mps": {"kind": "normal", "mean": 31, "sd": 3},
                "svo_rad": {"kind": "histogram", "edges": [0, 0.5, 1.0, 1.5], "weights": [3, 0, 1]},
            },
        )
        assert found.levels == {1: 0.75, 2: 0.25}
        x, v, psi = self.sample(found).T
        assert kstest((x + 300.0) / 100.0, "uniform").pvalue > 0.01
        low, high = (25.0 - 31.0) / 3.0, (35.0 - 31.0) / 3.0
        assert kstest(v, truncnorm(low, high, loc=31.0, scale=3.0).cdf).pvalue > 0.01
        assert np.mean(psi < 0.5) == pytest.approx(0.75, abs=0.03)
        assert not ((psi > 0.5) & (psi < 1.0)).any()
        assert psi.max() <= 1.5

    def test_is_recorded_as_it_was_stated(self, tmp_path):
        first = self.stated(tmp_path, {"v_pov0_mps": {"kind": "normal", "mean": 30, "sd": 2}})
        record = json.loads(json.dumps(first.record()))
        again = self.stated(tmp_path, record)
        assert again.record() == first.record()
        assert record["v_pov0_mps"]["low"] == V_POV0.low

    def test_gives_an_estimate_of_its_own_probability(self, tmp_path):
        """P(v > 32 m/s) for a normal speed, cut off at the pool's bounds."""
        found = self.stated(
            tmp_path, {"levels": {"1": 1}, "v_pov0_mps": {"kind": "normal", "mean": 30, "sd": 1}}
        )
        middle = found.points(1, cells(2))
        strata = strata_by({1: (middle[:, 1] > 0.68).astype(float)}, 3000, found.levels, 0.99)
        draws = strata.draw(np.random.default_rng(0))
        failed = found.points(1, draws.chances[:, :2])[:, 1] > 0.7
        e = estimate(strata, draws, failed, np.ones(3000, dtype=bool), 0.99)
        assert e.low < norm.sf(2.0) < e.high
        assert e.high - e.low < 0.02

    @pytest.mark.parametrize(
        ("text", "says"),
        [
            ("{", "is no JSON"),
            ("[]", "must be a table"),
            ({"x_pov0": {}}, "'x_pov0'"),
            ({"levels": {"3": 1}}, "levels of the campaign"),
            ({"levels": {}}, "levels of the campaign"),
            ({"levels": {"0": -1, "1": 2}}, "0 or more"),
            ({"levels": {"0": 0}}, "not all 0"),
            ({"levels": {"0": True}}, "numbers of 0 or more"),
            ({"x_pov0_m": 3}, "x_pov0_m: it is 3: it must be a table"),
            ({"x_pov0_m": {"kind": "beta"}}, "'beta'"),
            ({"x_pov0_m": {"kind": "uniform", "min": 0}}, "'min'"),
            ({"x_pov0_m": {"kind": "uniform", "low": -400}}, "-340 to -180"),
            ({"x_pov0_m": {"kind": "uniform", "low": -200, "high": -300}}, "low < high"),
            ({"v_pov0_mps": {"kind": "normal", "mean": 30}}, "no sd"),
            ({"v_pov0_mps": {"kind": "normal", "mean": 30, "sd": 0}}, "above 0"),
            ({"v_pov0_mps": {"kind": "normal", "mean": "30", "sd": 1}}, "'30'"),
            ('{"v_pov0_mps": {"kind": "normal", "mean": NaN, "sd": 1}}', "no JSON"),
            ({"svo_rad": {"kind": "histogram", "edges": [0, 1], "weights": [1, 1]}}, "3 edges"),
            ({"svo_rad": {"kind": "histogram", "edges": [1, 0], "weights": [1]}}, "rise"),
            ({"svo_rad": {"kind": "histogram", "edges": [0, 1], "weights": [0]}}, "not all 0"),
        ],
        ids=str,
    )
    def test_that_is_none_is_refused_in_one_sentence(self, tmp_path, text, says):
        with pytest.raises(UserError, match=r"d\.json") as error:
            self.stated(tmp_path, text)
        assert says in str(error.value)
        assert "\n" not in str(error.value)

    def test_that_is_not_there_is_refused(self, tmp_path):
        with pytest.raises(UserError, match="cannot read"):
            read_distribution(tmp_path / "nowhere.json", LEVELS, scenario=US23)


def failure_probability(run, out, **other):
    settings = settings_of(run.folder, run.settings)
    study = RunStudy(run, settings, resolve(settings))
    return probability.failure_probability(study, out, **other)


class TestOfACampaign:
    def test_is_estimated_with_fresh_cases_and_kept(self, tmp_path):
        settings = campaign_settings(vut="design1", cases=160, batch=20, seed=1)
        run = run_campaign(settings, tmp_path / "run")
        out = tmp_path / "p.json"
        found = failure_probability(run, out, cases=600)
        # 2.5 % of the pool fail (250 of 10,000 uniform cases).
        assert found.low < 0.025 < found.high
        assert found.failures > 1.3 * 0.025 * 600, "the campaign says where to look"
        record = json.loads(out.read_text())
        assert record["probability"] == found.probability
        assert record["campaign"]["vut"] == "design1"
        lines = out.with_suffix(".jsonl").read_text().splitlines()
        drawn = [json.loads(line) for line in lines]
        weighted = sum(d["weight"] for d in drawn if d["score"] < -500.0)
        assert weighted / 600 == pytest.approx(found.probability)
        counts = [sum(d["stratum"] == h for d in drawn) for h in range(3)]
        assert counts == [stratum.cases for stratum in found.strata]
        plain = found.plain.high - found.plain.low
        assert found.high - found.low < 0.6 * plain, "half as wide, in the mean over seeds"

    def test_with_the_same_seed_is_the_same(self, run, tmp_path):
        texts = []
        for name in ("a.json", "b.json"):
            failure_probability(run, tmp_path / name, cases=60, seed=3)
            texts.append((tmp_path / name).read_bytes())
            texts.append((tmp_path / name).with_suffix(".jsonl").read_bytes())
        assert texts[:2] == texts[2:]

    def test_by_the_kinematic_engine_is_the_same(self, run, tmp_path, command_line):
        found = failure_probability(run, tmp_path / "a.json", cases=60, seed=3)
        options = ("--cases", 60, "--seed", 3, "--workers", 1, "--engine", "kinematic")
        out = tmp_path / "b.json"
        code, _, err = command_line("probability", run.folder, *options, "--out", out)
        assert code == 0, err
        record = json.loads(out.read_bytes())
        assert (record["probability"], record["engine"]) == (found.probability, "kinematic")

    def test_takes_how_the_vut_is_hosted(self, run, tmp_path, command_line):
        out = tmp_path / "p.json"
        options = ("--deadline", "2", "--vut-memory", "1", "--workers", "1", "--json")
        code, said, err = command_line(
            "probability", run.folder, "--cases", "10", "--out", out, *options
        )
        assert code == 0, err
        assert json.loads(said)["cases"] == 10
        recorded = json.loads(out.read_text())["campaign"]
        assert (recorded["deadline_s"], recorded["vut_memory_gib"]) == (2.0, 1.0)

    def test_overwrites_nothing(self, run, tmp_path):
        (tmp_path / "p.jsonl").write_text("mine")
        with pytest.raises(UserError, match=r"p\.jsonl exists"):
            failure_probability(run, tmp_path / "p.json", cases=10)
        assert (tmp_path / "p.jsonl").read_text() == "mine"

    @pytest.mark.parametrize(
        ("options", "says"),
        [
            ({"cases": 0}, "--cases is 0"),
            ({"confidence": 1.0}, "--confidence is 1.0"),
            ({"confidence": math.nan}, "--confidence is nan"),
            ({"seed": -1}, "--seed is -1"),
        ],
    )
    def test_refuses_numbers_that_make_no_sense(self, run, tmp_path, options, says):
        with pytest.raises(UserError, match=says):
            failure_probability(run, tmp_path / "p.json", **options)

    def test_refuses_a_campaign_of_another_net(self, run, tmp_path, monkeypatch):
        monkeypatch.setitem(run.settings, "net_sha256", "0" * 64)
        with pytest.raises(UserError, match="another net"):
            failure_probability(run, tmp_path / "p.json", cases=10)
        assert not (tmp_path / "p.json").exists()
