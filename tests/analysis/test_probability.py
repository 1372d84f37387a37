"""Failure probabilities: exact intervals by hand, their coverage, distributions and traffics."""

from __future__ import annotations

import json
import math
import re
from itertools import product

import numpy as np
import pytest
from scipy.stats import kstest, norm, truncnorm
from support.campaigning import campaign_settings, run_campaign

from merge_sumo import config
from merge_sumo.analysis.exposure import (
    Normal,
    Traffic,
    read_distribution,
)
from merge_sumo.analysis.probability import (
    EXPECTED_LEAST,
    PROBABILITY,
    Cells,
    Counted,
    cells_of,
    draw,
    estimate,
)
from merge_sumo.analysis.probability import failure_probability as failure_probability_of
from merge_sumo.analysis.run_study import RunStudy
from merge_sumo.campaigns.settings import settings_from_folder
from merge_sumo.errors import UserError
from merge_sumo.metrics.summary import clopper_pearson
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.scenario import US23

LEVELS = (0, 1, 2)
SHAPE = cells_of(US23, 1)


def band(points, middle=0.7, half_width=0.05):
    """Fail in a diagonal band of area 2.5 half_width, as the designs do."""
    return np.abs(0.6 * points[:, 0] + 0.8 * points[:, 1] - middle) < half_width


def strata(expects, levels=(1,)) -> list[Cells]:
    """Return the cells of levels of two coordinates, by a mask of expected failures."""
    found = []
    for level, flag in product(levels, (False, True)):
        numbers = np.flatnonzero(expects == flag)
        if len(numbers):
            found.append(Cells(level, flag, len(numbers) / len(expects) / len(levels), numbers))
    return found


def expecting(middle, half_width):
    points = (np.indices(SHAPE).reshape(2, -1).T + 0.5) / SHAPE
    return band(points, middle, half_width)


def measured(cells, fails, cases, seed, confidence=0.95):
    drawn = draw(cells, US23, cases, np.random.default_rng(seed))
    counted = []
    for one, points in zip(cells, drawn, strict=True):
        counted.append(Counted(one, len(points), int(fails(points).sum()), 0))
    return estimate(counted, confidence)


class TestTheInterval:
    def test_of_two_strata_shares_the_risk_out(self):
        """Of 90 % no case of 300 fails, of 10 % all 100 do: at 5 %, each stratum has 2.5 %."""
        numbers = np.arange(10)
        counted = [
            Counted(Cells(1, False, 0.9, numbers), 300, 0, 0),
            Counted(Cells(1, True, 0.1, numbers), 100, 100, 0),
        ]
        found = estimate(counted, 0.95)
        assert found.probability == pytest.approx(0.1)
        assert found.low == pytest.approx(0.1 * 0.0125 ** (1 / 100))
        assert found.high == pytest.approx(0.9 * (1.0 - 0.0125 ** (1 / 300)) + 0.1)
        assert found.strata[0].high == pytest.approx(1.0 - 0.0125 ** (1 / 300))

    def test_takes_a_case_without_a_verdict_as_safe_below_and_as_a_failure_above(self):
        (cells,) = strata(np.zeros(math.prod(SHAPE), dtype=bool))
        found = estimate([Counted(cells, 400, 100, 100)], 0.95)
        assert found.probability == 0.25
        assert found.low == clopper_pearson(100, 400, 0.95)[0]
        assert found.high == clopper_pearson(200, 400, 0.95)[1]

    @pytest.mark.parametrize(
        ("expects", "held", "width"),
        [
            (expecting(0.7, 0.06), 190, 0.6),
            (expecting(0.2, 0.05), 190, 1.4),
        ],
        ids=["known", "wrong place"],
    )
    def test_holds_whatever_the_surrogate_expects(self, expects, held, width):
        """A band of area .125, 600 cases, 200 seeds; the width against that of plain cases."""
        rows = []
        for seed in range(200):
            one = measured(strata(expects), band, 600, seed)
            rows.append((one.probability, one.low, one.high))
        probability, low, high = np.array(rows).T
        assert ((low <= 0.125) & (high >= 0.125)).sum() >= held
        assert probability.mean() == pytest.approx(0.125, abs=0.004)
        plain_low, plain_high = clopper_pearson(75, 600, 0.95)
        assert (high - low).mean() < width * (plain_high - plain_low)


class TestTheDraws:
    def test_are_uniform_in_each_stratum_and_as_many_as_asked_for(self):
        expects = expecting(0.7, 0.05)
        safe, failing = draw(strata(expects), US23, 4000, np.random.default_rng(1))
        assert len(safe) + len(failing) == 4000
        assert len(failing) == 4000 * EXPECTED_LEAST
        for points, flag in ((safe, False), (failing, True)):
            cell = (points * SHAPE).astype(int)
            assert (expects[np.ravel_multi_index(tuple(cell.T), SHAPE)] == flag).all()
            assert kstest((points * SHAPE % 1.0).ravel(), "uniform").pvalue > 0.01
        share = np.mean(safe[:, 0] < 0.5) * 0.875 + np.mean(failing[:, 0] < 0.5) * 0.125
        assert share == pytest.approx(0.5, abs=0.03)


class TestADistribution:
    def stated(self, tmp_path, text):
        path = tmp_path / "d.json"
        path.write_text(text if isinstance(text, str) else json.dumps(text))
        return read_distribution(path, LEVELS, scenario=US23)

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
        points = found.points(2, np.random.default_rng(0).random((4000, 3)))
        low, high = np.array([(d.low, d.high) for d in US23.dimensions(2)]).T
        x, v, psi = (low + points * (high - low)).T
        assert kstest((x + 300.0) / 100.0, "uniform").pvalue > 0.01
        assert kstest(v, truncnorm(-2.0, 4.0 / 3.0, loc=31.0, scale=3.0).cdf).pvalue > 0.01
        assert np.mean(psi < 0.5) == pytest.approx(0.75, abs=0.03)
        assert not ((psi > 0.5) & (psi < 1.0)).any()
        assert psi.max() <= 1.5

    @pytest.mark.parametrize(
        ("text", "says"),
        [
            ({"x_pov0": {}}, "'x_pov0'"),
            ({"levels": {"3": 1}}, "does not have all of these levels"),
            ({"levels": {"1": 1e308, "2": 1e308}}, "finite weights"),
            ({"x_pov0_m": {"kind": "beta"}}, "'beta'"),
            ({"x_pov0_m": {"kind": "uniform", "low": -400}}, "-340 to -180"),
            ({"svo_rad": {"kind": "histogram", "edges": [0, 1], "weights": [1, 1]}}, "3 edges"),
            ({"svo_rad": {"kind": "histogram", "edges": [1, 0], "weights": [1]}}, "rising"),
        ],
        ids=str,
    )
    def test_that_is_none_is_refused_in_one_sentence(self, tmp_path, text, says):
        with pytest.raises(UserError, match=r"d\.json") as error:
            self.stated(tmp_path, text)
        assert says in str(error.value)
        assert "\n" not in str(error.value)


def traffic(**changes) -> Traffic:
    """A traffic of 8.7 cars per km with 27 +- 2.85 m/s."""
    known = {"source": "made up", "speeds": Normal(mean=27.0, sd=2.85), "density_veh_per_km": 8.7}
    return Traffic(**{**known, **changes, "name": "mine"})


class TestATraffic:
    def test_has_cars_in_the_pool_by_density_and_speed(self):
        """8.7 cars per km from -340 to -180 m, those at 25 to 35 m/s."""
        share = norm.cdf(8.0 / 2.85) - norm.cdf(-2.0 / 2.85)
        assert traffic().cars_in_pool(US23) == pytest.approx(0.0087 * 160.0 * share)

    @pytest.mark.parametrize(
        ("scenario", "says"),
        [
            (named_scenario("us23-traffic"), "us23-traffic has its own cars ahead"),
            (named_scenario("roundabout"), "less than 1% of the speeds of mine"),
        ],
        ids=["headways", "other speeds"],
    )
    def test_needs_a_merge_with_single_cars_at_such_speeds(self, scenario, says):
        with pytest.raises(UserError, match=says):
            traffic().in_pool(scenario, [0])


def failure_probability(run, out, engine="kinematic", **other):
    settings = settings_from_folder(run.folder, run.record)
    study = RunStudy(run, settings, settings.load_plan().with_engine(engine))
    return failure_probability_of(study, config.Probability(run, **other), out)


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    settings = campaign_settings(vut="design1", cases=160, batch=20, seed=1)
    return run_campaign(settings, tmp_path_factory.mktemp("campaign") / "run")


class TestOfACampaign:
    def test_is_estimated_with_fresh_cases_and_kept(self, campaign, tmp_path):
        found = failure_probability(campaign, tmp_path / "probability.json", cases=4000)
        # .0229 of the pool fail: a truth of 1,000,000 uniform cases.
        assert found.overall.low < 0.0229 < found.overall.high
        safe, failing = found.overall.strata
        assert failing.failures > 1.3 * 0.0229 * 4000, "the campaign says where to look"
        assert len(found.missed) == min(safe.failures, 20)
        low, high = clopper_pearson(92, 4000, 0.95)
        assert found.overall.high - found.overall.low < 0.7 * (high - low)
        read = PROBABILITY.read(tmp_path)
        assert read is not None
        assert (read.overall, read.missed) == (found.overall, found.missed)
        assert found.campaign["vut"] == "design1"

    def test_in_a_traffic_is_a_number_of_cars_per_merge(self, campaign, tmp_path, command_line):
        out = tmp_path / "p.json"
        options = ("--traffic", "exid-5", "--cases", 400, "--workers", 1, "--out", out)
        code, said, err = command_line("probability", campaign.folder, *options)
        assert code == 0, err
        assert re.match(r"failures per merge: [0-9.e-]+ \[", said), "one level: one estimate"
        assert "start in the pool, 0.72 per merge" in said
        written = json.loads(out.read_text())
        assert written["overall"] is None
        one, level = written["per_merge"], written["levels"]["0"]
        assert one["most"] == pytest.approx(one["cars"] * level["probability"])
        assert one["high"] == pytest.approx(one["cars"] * level["high"])

    @pytest.mark.parametrize(
        ("options", "says"),
        [
            ({"confidence": 1.0}, "`confidence` is 1.0"),
            ({"traffic": "exid-5", "distribution": "d.json"}, "cannot be combined"),
        ],
    )
    def test_refuses_what_makes_no_sense(self, campaign, tmp_path, options, says):
        with pytest.raises(UserError, match=says):
            failure_probability(campaign, tmp_path / "p.json", **options)
