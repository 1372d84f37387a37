"""Failure probability: closed-form failure sets, known densities, intervals that hold."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from campaigning import run_campaign
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import kstest, norm, truncnorm

from merge_sumo.analysis.exposure import read_distribution
from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.settings import CampaignSettings, settings_of
from merge_sumo.errors import UserError
from merge_sumo.studies import probability
from merge_sumo.studies.importance import (
    CELLS,
    DEFENSIVE,
    DefensiveMixture,
    cells,
    clopper_pearson,
    estimate,
    mean_at_least,
)
from merge_sumo.values.case import V_POV0, dimensions
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


def mixture(weights, chance) -> DefensiveMixture:
    return DefensiveMixture(weights, chance, US23)


def aimed_at(half_width, blur=0.02):
    """Return a proposal whose surrogate knows the band, but not sharply."""
    middle = cells(2)
    beyond = np.abs(0.6 * middle[:, 0] + 0.8 * middle[:, 1] - 0.7) - half_width
    return mixture({1: 1.0}, {1: 1.0 / (1.0 + np.exp(beyond / blur))})


def estimate_band(proposal, half_width, n, seed, confidence=0.95):
    draws = proposal.draw(n, np.random.default_rng(seed))
    failed = band(draws.chances[:, :2], half_width)
    return estimate(draws, failed, np.ones(n, dtype=bool), proposal.bound, confidence)


class TestTheMixture:
    @pytest.mark.parametrize("seed", range(3))
    def test_has_a_density_that_integrates_to_1(self, seed):
        rng = np.random.default_rng(seed)
        chance = {level: rng.random(len(cells(3 if level == 2 else 2))) ** 4 for level in LEVELS}
        shares = {0: 0.2, 1: 0.5, 2: 0.3}
        density = mixture(shares, chance)
        means = [
            share * (1.0 / density.weight(level, cells(3 if level == 2 else 2))).mean()
            for level, share in shares.items()
        ]
        assert sum(means) == pytest.approx(1.0, abs=1e-12)

    def test_never_weighs_a_case_by_more_than_the_defensive_share_allows(self):
        proposal = aimed_at(0.01)
        draws = proposal.draw(5000, np.random.default_rng(0))
        assert draws.weight.max() <= proposal.bound <= 1.0 / DEFENSIVE
        assert draws.weight.min() < 0.3, "and those in the band by much less"

    def test_draws_what_its_weights_say(self):
        """E_q[w 1(A)] = p(A), for a set A far from any cell's edge."""
        chance = {1: cells(2)[:, 0] ** 8, 2: cells(3)[:, 2] ** 8}
        proposal = mixture({1: 0.25, 2: 0.75}, chance)
        draws = proposal.draw(40_000, np.random.default_rng(1))
        inside = (draws.level == 2) & (draws.chances[:, 2] > 0.9)
        x = draws.weight * inside
        error = x.std() / math.sqrt(len(x))
        assert x.mean() == pytest.approx(0.075, abs=5.0 * error)
        assert error < 0.001, "aimed draws see this corner better than plain ones"
        assert draws.weight.mean() == pytest.approx(1.0, abs=0.02)

    def test_gives_each_draw_the_weight_of_its_place(self):
        proposal = mixture({0: 0.5, 2: 0.5}, {0: cells(2)[:, 1], 2: cells(3)[:, 1]})
        draws = proposal.draw(500, np.random.default_rng(2))
        for level in (0, 2):
            at = draws.level == level
            dims = len(dimensions(level))
            again = proposal.weight(level, draws.chances[at, :dims])
            assert np.array_equal(draws.weight[at], again)

    def test_is_the_stated_distribution_where_nothing_is_expected(self):
        proposal = mixture({1: 1.0}, {1: np.zeros(CELLS[2] ** 2)})
        draws = proposal.draw(100, np.random.default_rng(0))
        assert np.array_equal(draws.weight, np.ones(100))
        assert proposal.bound == 1.0


class TestTheInterval:
    @pytest.mark.parametrize(("half_width", "n"), [(0.002, 400), (0.02, 400), (0.1, 150)])
    def test_holds_the_truth_at_least_as_often_as_it_says(self, half_width, n):
        proposal = aimed_at(half_width)
        truth = band_area(half_width)
        found = [estimate_band(proposal, half_width, n, seed, 0.8) for seed in range(150)]
        held = sum(e.low <= truth <= e.high for e in found)
        assert held >= 0.8 * 150
        assert np.mean([e.probability for e in found]) == pytest.approx(truth, rel=0.15)

    def test_holds_with_a_surrogate_that_looks_in_the_wrong_place(self):
        middle = cells(2)
        wrong = mixture({1: 1.0}, {1: np.exp(-50.0 * middle.sum(axis=1))})
        truth = band_area(0.02)
        held = 0
        for seed in range(100):
            e = estimate_band(wrong, 0.02, 300, seed, 0.8)
            held += e.low <= truth <= e.high
        assert held >= 80

    def test_is_narrower_than_that_of_plain_cases_on_a_rare_set(self):
        proposal, truth, n = aimed_at(0.004), band_area(0.004), 8000
        ours = [estimate_band(proposal, 0.004, n, seed) for seed in range(3)]
        plain = clopper_pearson(round(n * truth), n, 0.05)
        assert max(e.high - e.low for e in ours) < 0.8 * (plain[1] - plain[0])

    @pytest.mark.parametrize(("fails", "p"), [(False, 0.0), (True, 1.0)])
    def test_of_certain_cases_ends_at_the_certain_probability(self, fails, p):
        proposal = mixture({1: 1.0}, {1: np.ones(CELLS[2] ** 2)})
        draws = proposal.draw(1000, np.random.default_rng(0))
        failed = np.full(1000, fails)
        e = estimate(draws, failed, np.ones(1000, dtype=bool), proposal.bound, 0.95)
        assert e.probability == p
        assert (e.high if fails else e.low) == pytest.approx(p, abs=1e-12)
        # The rule of three, a bit wider: no gambler bets all.
        assert e.high - e.low == pytest.approx(math.log(40.0) / 1000, rel=0.2)

    def test_takes_a_case_without_a_verdict_as_safe_below_and_as_a_failure_above(self):
        proposal = mixture({1: 1.0}, {1: np.ones(CELLS[2] ** 2)})
        draws = proposal.draw(400, np.random.default_rng(0))
        part = np.random.default_rng(1).permutation(400)
        failed, judged = part < 100, part < 300
        e = estimate(draws, failed, judged, proposal.bound, 0.95)
        assert e.low < 0.25
        assert e.high > 0.5
        assert e.probability == pytest.approx(0.25)
        assert e.without_verdict == 100
        known = estimate(draws, failed, np.ones(400, dtype=bool), proposal.bound, 0.95)
        assert known.low == e.low
        assert known.high < e.high

    @given(st.floats(0.0, 1.0), st.integers(1, 200), st.floats(0.001, 0.5))
    @settings(deadline=None, max_examples=30)
    def test_of_a_constant_begins_below_it(self, value, n, alpha):
        assert 0.0 <= mean_at_least(np.full(n, value), alpha) <= value + 1e-12

    def test_of_a_constant_comes_near_it_with_many_cases(self):
        x = np.full(2000, 0.01)
        assert mean_at_least(x, 0.025) > 0.009

    def test_of_the_uniform_arm_is_the_exact_binomial_one(self):
        # Clopper and Pearson by hand: no failure in n gives 1 - (alpha/2)^(1/n).
        assert clopper_pearson(0, 100, 0.05) == pytest.approx((0.0, 1.0 - 0.025 ** (1 / 100)))
        assert clopper_pearson(100, 100, 0.05) == pytest.approx((0.025 ** (1 / 100), 1.0))
        assert clopper_pearson(10, 100, 0.05) == pytest.approx((0.0490, 0.1762), abs=1e-4)


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
        proposal = mixture(found.levels, {1: (middle[:, 1] > 0.68).astype(float)})
        draws = proposal.draw(3000, np.random.default_rng(0))
        failed = found.points(1, draws.chances[:, :2])[:, 1] > 0.7
        e = estimate(draws, failed, np.ones(3000, dtype=bool), proposal.bound, 0.99)
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
    return probability.failure_probability(run, settings, resolve(settings), out, **other)


class TestOfACampaign:
    def test_is_estimated_with_fresh_cases_and_kept(self, tmp_path):
        settings = CampaignSettings(
            vut="design1", levels=(0,), cases=160, batch=20, seed=1, scenario=US23
        )
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
        assert sum(d["plain"] for d in drawn) == found.uniform_arm.cases

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
