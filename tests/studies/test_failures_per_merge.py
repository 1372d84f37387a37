"""Failures per merge: closed forms, random traffic, mixtures, traffics as files, the command."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from campaigning import campaign_settings, run_campaign
from check_failures_per_merge import merges
from scipy.stats import norm

import merge_sumo as ms
from merge_sumo.analysis.traffic import (
    FOLDER,
    HistogramSpeeds,
    NormalSpeeds,
    Traffic,
    named_traffic,
    shipped_traffics,
)
from merge_sumo.api.results import _mixed
from merge_sumo.errors import UserError
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.studies.failures_per_merge import (
    OverMixtures,
    Part,
    part_of,
    parts_of,
)
from merge_sumo.studies.probability import cases_of
from merge_sumo.studies.stratified import Strata, cells
from merge_sumo.values.scenario import US23, Scenario

ROOT = Path(__file__).resolve().parents[2]
SPEED = US23.dimensions(0)[1]
ALONE = NormalSpeeds(mean=27.0, sd=2.85)


def traffic(speeds=ALONE, density: float | None = 8.7) -> Traffic:
    return Traffic(source="by hand", speeds=speeds, density_veh_per_km=density, name="mine")


def fails(x, v):
    """Fail between two places, and below a speed that rises with x: all is known of it."""
    return (x > -300.0) & (x < -220.0) & (v < 27.0 + (x + 300.0) / 40.0)


def by_hand(density_veh_per_km: float) -> float:
    """Return k * integral dx P(25 < v < 27 + (x + 300) / 40), by the trapezoidal rule."""
    x = np.linspace(-300.0, -220.0, 4001)
    below = norm.cdf((27.0 + (x + 300.0) / 40.0 - 27.0) / 2.85)
    inside = below - norm.cdf((25.0 - 27.0) / 2.85)
    return density_veh_per_km / 1000.0 * float(np.trapezoid(inside, x))


@cache
def stated_with_strata(density, n, confidence):
    """Return the part of a level, with strata of a surrogate that knows nearly all of it."""
    (stated,) = parts_of(traffic(density=density), US23, [0])
    points = stated.distribution.points(0, cells(2))
    inside = fails(-340.0 + 160.0 * points[:, 0], 25.0 + 10.0 * points[:, 1])
    chance = {0: np.where(inside, 0.995, 0.005)}
    return stated, Strata({0: 1.0}, chance, US23, n, confidence)


def known(n=2000, seed=0, density=8.7, confidence=0.95) -> Part:
    """Return a part by cases of such failures."""
    stated, strata = stated_with_strata(density, n, confidence)
    draws = strata.draw(np.random.default_rng(seed))
    settings = campaign_settings(vut="design1")
    drawn = cases_of(settings, stated.distribution, draws)
    failed = np.array([fails(case.x_pov0_m, case.v_pov0_mps) for case in drawn])
    return part_of(stated, strata, draws, failed, np.ones(n, dtype=bool), confidence)


class TestCampbellsFormula:
    @pytest.mark.parametrize("density", [4.9, 8.7, 20.0])
    @pytest.mark.parametrize("process", ["poisson", "renewal"])
    def test_gives_what_random_traffic_of_any_process_does(self, density, process):
        """30,000 merges, each with every car of a stationary traffic of 900 m, one by one."""
        merge, x, v = merges(process, density, ALONE, (-900.0, 0.0), 30_000, seed=1)
        counted = fails(x, v) & (v > 25.0) & (v < 35.0)
        per_merge = np.bincount(merge[counted], minlength=30_000)
        error = per_merge.std() / np.sqrt(30_000)
        assert per_merge.mean() == pytest.approx(by_hand(density), abs=3.0 * error)
        part = known(density=density)
        assert part.low < by_hand(density) < part.high
        assert part.high - part.low < 0.2 * by_hand(density)

    def test_holds_with_the_stated_confidence(self):
        found = [known(seed=seed, n=300, confidence=0.8) for seed in range(20)]
        assert sum(part.low <= by_hand(8.7) <= part.high for part in found) >= 0.8 * 20

    def test_of_a_vut_that_always_fails_gives_all_cars_of_the_pool(self):
        """8.7 cars per km on 160 m, of whose speeds those between 25 and 35 m/s are counted."""
        (stated,) = parts_of(traffic(), US23, [1])
        share = norm.cdf(8.0 / 2.85) - norm.cdf(-2.0 / 2.85)
        assert stated.cars == pytest.approx(0.0087 * 160.0 * share, rel=1e-9)
        strata = Strata({1: 1.0}, {1: np.zeros(len(cells(2)))}, US23, 100, 0.95)
        draws = strata.draw(np.random.default_rng(0))
        always = np.ones(100, dtype=bool)
        part = part_of(stated, strata, draws, always, always, 0.95)
        assert part.failures_per_merge == part.high == pytest.approx(stated.cars)
        # The lower end has a quarter of the risk, also of a single stratum.
        assert part.low == pytest.approx(stated.cars * 0.0125 ** (1 / 100))


class TestTheParts:
    def test_are_levels_thirds_of_psi_and_ends_of_the_standard_deviation(self):
        found = parts_of(named_traffic("exid-5"), US23, [0, 2])
        degrees = [
            None if one.svo_rad is None else tuple(np.degrees(one.svo_rad).round(9))
            for one in found
        ]
        thirds = [(0.0, 30.0), (30.0, 60.0), (60.0, 90.0)]
        assert degrees == [None, *thirds] * 2
        assert [one.speeds.sd_mps for one in found] == [2.6] * 4 + [3.1] * 4
        chances = np.random.default_rng(0).random((200, 3))
        psi = found[2].distribution.points(2, chances)[:, 2] * 90.0
        assert 30.0 <= psi.min() < 35.0
        assert 55.0 < psi.max() <= 60.0

    def test_bound_every_mixture(self):
        parts = [known(density=8.7, n=200, seed=seed) for seed in range(3)]
        parts = [
            replace(part, failures_per_merge=middle, low=middle - 0.01, high=middle + 0.02)
            for part, middle in zip(parts, (0.3, 0.1, 0.2), strict=True)
        ]
        found = OverMixtures.of(parts)
        assert (found.least, found.most) == (0.1, 0.3)
        assert (found.low, found.high) == pytest.approx((0.09, 0.32))
        for shares in np.random.default_rng(0).dirichlet(np.ones(3), 100):
            assert found.least <= shares @ [0.3, 0.1, 0.2] <= found.most

    @pytest.mark.parametrize(
        ("levels", "says"),
        [
            ([1], "at level 1"),
            ([2], "whatever the shares of psi"),
            ([0, 1, 2], "whatever the shares of levels 0, 1 and 2 and of psi"),
        ],
    )
    def test_name_of_what_mixtures_they_are(self, levels, says):
        part = known(n=200)
        parts = [
            replace(part, level=one.level, svo_rad=one.svo_rad)
            for one in parts_of(traffic(), US23, levels)
        ]
        assert _mixed(parts) == says

    @pytest.mark.parametrize(
        ("scenario", "says"),
        [
            (named_scenario("us23-traffic"), "us23-traffic has cars ahead of the POV"),
            (SimpleNamespace(name="queue", kind="braking"), "queue is a scenario of kind braking"),
            (named_scenario("roundabout"), "less than 1% of the speeds of mine"),
        ],
        ids=["headways", "another kind", "other speeds"],
    )
    def test_need_a_merge_with_single_cars_at_such_speeds(self, scenario: Scenario, says):
        with pytest.raises(UserError, match=says) as error:
            parts_of(traffic(), scenario, [0])
        assert "\n" not in str(error.value)


def bins(edges: str, weights: str) -> dict[str, str]:
    """Return what makes a file one with a histogram."""
    return {
        '"normal"': '"histogram"',
        "mean = 25.1": f"edges = {edges}",
        "sd = [2.6, 3.1]": f"weights = {weights}",
    }


PUBLISHED = {"exid-2": (5.7, 23.3), "exid-3": (4.9, 21.5), "exid-5": (8.7, 25.1)}


class TestATraffic:
    def test_that_is_shipped_has_the_published_figures_and_their_source(self):
        assert shipped_traffics() == [*PUBLISHED, "michigan-65mph"]
        for name, (density, mean) in PUBLISHED.items():
            found = named_traffic(name)
            assert found.density_veh_per_km == density
            assert found.speeds == NormalSpeeds(mean=mean, sd=(2.6, 3.1))
            assert "arXiv 2303.11531" in found.source
        michigan = named_traffic("michigan-65mph")
        assert michigan.density_veh_per_km is None
        assert isinstance(michigan.speeds, NormalSpeeds)
        assert norm.cdf((34.9 - 30.8) / np.array(michigan.speeds.sd)) == pytest.approx(
            0.85, abs=0.01
        )
        page = (ROOT / "docs" / "explanations" / "probability.md").read_text(encoding="utf-8")
        assert all(f"`{name}`" in page for name in shipped_traffics())

    def test_has_the_share_of_its_speeds_in_the_pool(self):
        low, high = named_traffic("exid-2").speeds_within(SPEED)
        assert low.share == pytest.approx(norm.sf(1.7 / 2.6) - norm.sf(11.7 / 2.6))
        assert high.share == pytest.approx(norm.sf(1.7 / 3.1) - norm.sf(11.7 / 3.1))

    def test_of_a_histogram_is_cut_at_the_pool(self):
        """Of 20-30, 30-40 and 40-50 m/s half of the first two bins is in 25 to 35 m/s."""
        speeds = HistogramSpeeds(edges=(20.0, 30.0, 40.0, 50.0), weights=(4.0, 2.0, 2.0))
        (found,) = traffic(speeds).speeds_within(SPEED)
        assert found.share == pytest.approx(3.0 / 8.0)
        v = found.marginal.quantile(np.array([0.0, 1 / 3, 2 / 3, 1.0]))
        assert v == pytest.approx([25.0, 27.5, 30.0, 35.0])

    @pytest.mark.parametrize(
        ("name", "says"),
        [
            ("exid-7", "no traffic 'exid-7': did you mean exid-"),
            ("nowhere.toml", "cannot read the traffic nowhere.toml"),
        ],
    )
    def test_that_is_unknown_is_refused_with_the_known_ones(self, name, says):
        with pytest.raises(UserError, match=says):
            named_traffic(name)

    @pytest.mark.parametrize(
        ("change", "says"),
        [
            ({"density_veh_per_km = 8.7": "density_veh_per_km = 0"}, "density_veh_per_km is 0"),
            ({"density_veh_per_km = 8.7": "density_veh_per_km = -3"}, "above 0, up to 1000"),
            ({"density_veh_per_km = 8.7": "density_veh_per_km = inf"}, "density_veh_per_km is inf"),
            ({"density_veh_per_km": "density"}, "has no 'density'"),
            ({"mean = 25.1": "mean = 0"}, "mean is 0"),
            ({"mean = 25.1": "mean = nan"}, "mean is nan"),
            ({"sd = [2.6, 3.1]": "sd = [3.1, 2.6]"}, r"sd is \[3.1, 2.6\]"),
            ({"sd = [2.6, 3.1]": "sd = 0"}, "sd is 0"),
            ({"sd = [2.6, 3.1]": "sd = 1e-320"}, "sd is 1e-320"),
            ({"mean = 25.1": "mean = 1e308"}, r"mean is 1e\+308"),
            ({"sd = [2.6, 3.1]": "sd = nan"}, "sd is nan"),
            ({"sd = [2.6, 3.1]": "sd = [2.6, 2.8, 3.1]"}, "sd is"),
            ({'"normal"': '"beta"'}, "'beta'"),
            (bins("[20, 25, 30]", "[1]"), "1 weights of speeds need 2 edges"),
            (bins("[20, nan]", "[1]"), "must rise"),
            (bins("[20, inf]", "[1]"), "must rise"),
            (bins("[30, 20]", "[1]"), "must rise"),
            (bins("[20, 30]", "[0]"), "not all 0"),
            (bins("[20, 30]", "[-1]"), "weights"),
            ({"source": "# source"}, "no source"),
            ({"[speeds]": "[speeds"}, "is no TOML"),
        ],
        ids=lambda value: str(value)[:40],
    )
    def test_that_makes_no_sense_is_refused_in_one_sentence(self, tmp_path, change, says):
        text = (FOLDER / "exid-5.toml").read_text(encoding="utf-8")
        for old, new in change.items():
            text = text.replace(old, new)
        (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
        with pytest.raises(UserError, match=says) as error:
            named_traffic(str(tmp_path / "mine.toml"))
        assert "\n" not in str(error.value)

    @pytest.mark.parametrize("speeds", [NormalSpeeds(mean=26.0, sd=-1.0), ALONE])
    def test_of_python_is_checked_as_a_file(self, campaign, speeds):
        with pytest.raises(UserError, match=r"sd is -1\.0|source is ''"):
            ms.failures_per_merge(campaign.folder, Traffic(source="", speeds=speeds))

    @pytest.mark.parametrize("density", [0.0, -1.0, float("nan"), 1e9])
    def test_has_no_such_density(self, density):
        with pytest.raises(UserError, match="--density is"):
            named_traffic("michigan-65mph").with_density(density)


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    settings = campaign_settings(vut="design1", cases=80, batch=20, seed=1)
    return run_campaign(settings, tmp_path_factory.mktemp("campaign") / "run")


RUNNING = ("--cases", 200, "--engine", "kinematic", "--workers", 1, "--json")


class TestOfACampaign:
    def test_are_printed_written_and_returned_alike(self, campaign, tmp_path, command_line):
        folder = shutil.copytree(campaign.folder, tmp_path / "run")
        options = ("--traffic", "exid-5", *RUNNING)
        code, said, err = command_line("failures-per-merge", folder, *options)
        assert code == 0, err
        printed = json.loads(said)
        out = tmp_path / "again.json"
        found = ms.failures_per_merge(folder, "exid-5", out=out, cases=200, engine="kinematic")
        assert out.read_text() == (folder / "failures-per-merge.json").read_text()
        printed.pop("file")
        written = json.loads(out.read_text())
        returned = json.loads(json.dumps(found.found.to_record()))
        assert printed == returned == {name: written[name] for name in printed}
        self.adds_up(written, (folder / "failures-per-merge.jsonl").read_text())
        self.reads_as_one_expects(str(found))
        code, _, err = command_line("failures-per-merge", folder, *options)
        assert code == 2
        assert "failures-per-merge.json exists" in err

    def adds_up(self, written, text):
        levels = written["levels"].values()
        assert set(written["levels"]) == {"0"}
        assert written["low"] == min(one["low"] for one in levels)
        assert written["high"] == max(one["high"] for one in levels)
        lines = [json.loads(line) for line in text.splitlines()]
        assert [line["part"] for line in lines] == np.repeat(range(2), 100).tolist()
        first = [line["weight"] * (line["score"] < -500.0) for line in lines[:100]]
        part = written["parts"][0]
        assert np.mean(first) * part["cars"] == pytest.approx(part["failures_per_merge"])

    def reads_as_one_expects(self, said):
        assert said.startswith("failures per merge: ")
        assert "95 % interval, at level 0\n" in said
        assert "arXiv 2303.11531" in said
        assert "per kilometre" not in said
        assert (
            "counted per merge: 0.71 to 0.72 mainline cars, those that start in the pool, from "
            "-340 to -180 m at 25 to 35 m/s; not counted: cars that start elsewhere, and those "
            "at other speeds, 48% to 49% of this traffic" in said
        )

    def test_grow_with_the_density(self):
        michigan = named_traffic("michigan-65mph")
        cars = [parts_of(michigan.with_density(k), US23, [0])[0].cars for k in (5.0, 10.0)]
        share = norm.cdf(4.2 / 3.9) - norm.cdf(-5.8 / 3.9)
        assert cars == pytest.approx([0.005 * 160.0 * share, 0.01 * 160.0 * share])

    @pytest.mark.parametrize(
        ("options", "says"),
        [
            (("--traffic", "exid5"), "did you mean exid-5"),
            (("--traffic", "michigan-65mph"), "states no density: give one with --density"),
            (("--traffic", "exid-5", "--density", "0"), "--density is 0"),
            (("--traffic", "exid-5", "--cases", "1"), "--cases is 1: give 2 or more"),
            (("--traffic", "exid-5", "--out", "f.jsonl"), "end it in .json"),
        ],
        ids=str,
    )
    def test_refuse_what_makes_no_sense(self, campaign, command_line, options, says):
        code, _, err = command_line("failures-per-merge", campaign.folder, *options)
        assert code == 2
        assert says in err
        assert err.count("\n") == 1
