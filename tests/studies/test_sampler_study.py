"""CoverageGrid truth and comparison of samplers, in worker processes with a SUMO each."""

# mypy: no-strict-optional

from __future__ import annotations

import json
import shlex
import shutil
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from plans import key_of, plan_for
from vut_contract import factory

from merge_sumo.errors import UserError
from merge_sumo.studies.sampler_study import (
    SamplerStudy,
    Search,
    compare,
    limit_fmc,
    oracle,
    search,
)
from merge_sumo.studies.truth import Truth, ground_truth, known_truth
from merge_sumo.values.case import from_unit, to_unit
from merge_sumo.values.fmc import fmc
from merge_sumo.values.scenario import US23
from merge_sumo.values.score import Measures, Outcome
from merge_sumo.values.trajectory import End


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def truth(cache):
    return ground_truth(plan_for("design1"), 0, 300, cache=cache)


def test_a_truth_is_kept_and_a_torn_file_is_made_again(truth, cache, monkeypatch):
    (path,) = cache.glob("truth-*.npz")
    counted: list[int] = []
    again = ground_truth(plan_for("design1"), 0, 300, cache=cache, on_cases=counted.append)
    assert np.array_equal(again.score, truth.score)
    assert counted == []
    path.write_bytes(path.read_bytes()[:100])
    remade = ground_truth(plan_for("design1"), 0, 300, cache=cache, on_cases=counted.append)
    assert np.array_equal(remade.score, truth.score)
    assert sum(counted) == 300


@pytest.mark.parametrize(
    "change",
    [
        {"vut": "design2"},
        {"level": 1},
        {"cases": 301},
        {"seed": 1},
        {"vut_command": "./controller"},
        {"deadline_s": 1.0},
    ],
)
def test_the_key_of_the_cache_names_what_the_truth_depends_on(change):
    assert key_of().path() == key_of().path()
    assert key_of().path() != key_of(**change).path()


def truth_of(vut: str, cache, **options) -> int:
    """Return in how many cases a VUT had to drive for its truth of four cases."""
    counted: list[int] = []
    ground_truth(plan_for(factory(vut, **options)), 0, 4, cache=cache, on_cases=counted.append)
    return sum(counted)


READER = """
import pathlib
import gain_of_mine
HERE = pathlib.Path(__file__).parent
class Vut:
    def act(self, seen):
        (HERE / "ran").touch()
        if seen.t_s == 5.0:
            import late_gain
        return float((HERE / "gain.txt").read_text()) if seen.t_s > 2.0 else gain_of_mine.gain
"""


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("my_vut.py", marks=pytest.mark.long),
        pytest.param("gain_of_mine.py", marks=pytest.mark.long),
        "late_gain.py",
        "gain.txt",
    ],
)
def test_a_truth_is_of_every_file_that_the_vut_loaded_also_while_it_drove(tmp_path, name):
    for file, content in {
        "my_vut.py": READER,
        "gain_of_mine.py": "gain = 1.0",
        "late_gain.py": "",
        "gain.txt": "1.0",
    }.items():
        (tmp_path / file).write_text(content)
    vut = f"{tmp_path / 'my_vut.py'}:Vut"
    assert truth_of(vut, tmp_path / "cache") == 4
    (tmp_path / "ran").unlink()
    assert truth_of(vut, tmp_path / "cache") == 0
    assert not (tmp_path / "ran").exists()
    content = (tmp_path / name).read_text()
    (tmp_path / name).write_text("1.5" if name == "gain.txt" else content + "\n# changed")
    assert truth_of(vut, tmp_path / "cache") == 4
    assert truth_of(vut, tmp_path / "cache") == 0
    (tmp_path / name).write_text(content)
    assert truth_of(vut, tmp_path / "cache") == 4, "the truth of before was replaced"


def test_a_truth_of_a_file_that_is_gone_is_not_used(tmp_path):
    (tmp_path / "my_vut.py").write_text("def Vut(seen):\n    return 1.0\n")
    vut = f"{tmp_path / 'my_vut.py'}:Vut"
    assert truth_of(vut, tmp_path / "cache") == 4
    (tmp_path / "my_vut.py").unlink()
    with pytest.raises(UserError, match="cannot read the VUT"):
        truth_of(vut, tmp_path / "cache")


def test_a_truth_of_a_controller_behind_traci_is_of_its_command_and_the_files_named_there(tmp_path):
    controller = tmp_path / "controller.py"
    shutil.copy(Path(__file__).parents[1] / "support" / "raw_traci.py", controller)
    command = f"{shlex.quote(sys.executable)} {shlex.quote(str(controller))} {{port}}"
    assert truth_of("traci", tmp_path / "cache", command=command) == 4
    assert truth_of("traci", tmp_path / "cache", command=command) == 0
    assert truth_of("traci", tmp_path / "cache", command=command + " ") == 4
    controller.write_text(controller.read_text() + "# changed")
    assert truth_of("traci", tmp_path / "cache", command=command) == 4


def test_a_comparison_says_what_samplers_found_of_the_truth(truth):
    (found,) = search(plan_for("design1"), (0,), ["uniform"], seeds=2, cases=50, batch=20).values()
    result = compare(found, {0: truth})
    assert result.cases_by_batch == [20, 40, 50]
    assert len(result.fmc_by_batch_median) == 3
    assert result.fmc_by_batch_median == sorted(result.fmc_by_batch_median)
    assert truth.is_small
    assert result.fmc_over_truth_median is None
    assert result.cases_to_90_percent_median is None
    assert result.covered_share_by_batch_median == sorted(result.covered_share_by_batch_median)
    low, high = result.covered_share_quartiles
    assert 0.0 < low <= result.covered_share_median <= high <= 1.0
    low, high = result.fmc_quartiles
    assert low <= result.fmc_median <= high
    assert result.levels[0].cases_median == 50


def test_a_search_of_all_levels_sums_their_coverage():
    (found,) = search(plan_for("design1"), (0, 1), ["uniform"], seeds=1, cases=40, batch=40)[
        "uniform"
    ]
    assert {outcome.case.level for outcome in found.outcomes} == {0, 1}
    assert found.fmc[-1] == sum(fmc(found.failures(level)) for level in (0, 1))


def searched(points_by_batch: list[list[tuple[float, float]]], sampler_s: float = 0.0) -> Search:
    """Return a search at level 0 with failures at points, and one safe case in each batch."""
    outcomes: list[Outcome] = []
    curve = []
    for batch, points in enumerate(points_by_batch):
        for failed, point in [(False, (0.0, 0.0)), *((True, point) for point in points)]:
            (case,) = from_unit(np.array([point]), 0, scenario=US23)
            end, score = End.MERGED, -600.0 if failed else -1.0
            measures = Measures(end=end, score=score, t_end_s=8.3)
            outcomes.append(Outcome(len(outcomes), batch, case, measures))
        curve.append(fmc(to_unit([o.case for o in outcomes if o.failed], 0, scenario=US23)))
    return Search(outcomes, curve, sampler_s)


def dense_truth(points: list[list[float]]) -> Truth:
    """Return a truth with two failures at each of some points, so that it is large enough."""
    failures = np.array([*points, *points])
    return Truth(failures, np.full(len(failures), -600.0))


class TestAComparisonByHand:
    truth = dense_truth([[0.2, 0.2], [0.8, 0.8]])
    half = searched([[], [(0.2, 0.24)]], 1.0)  # 1 case, then 3
    most = searched([[(0.2, 0.2)], [(0.8, 0.8)]], 3.0)  # 2 cases, then 4

    def test_has_medians_over_the_seeds(self):
        found = compare([self.most, self.half], {0: self.truth})
        assert found.regions_found_median == 1.5
        assert found.seeds_with_all_regions == 1
        assert found.failures_median == 1.5
        assert found.fmc_over_truth_median == pytest.approx(0.75)
        assert found.sampler_s_median == 2.0

    def test_has_quartiles_over_the_seeds(self):
        found = compare([self.most, self.half], {0: self.truth})
        assert found.regions_found_quartiles == (1.25, 1.75)
        assert found.failures_quartiles == (1.25, 1.75)
        assert found.fmc_over_truth_quartiles == pytest.approx((0.625, 0.875))
        low, high = found.fmc_by_batch_quartiles
        assert high[0] == pytest.approx(0.75 * fmc(np.zeros((1, 2))))
        assert low[0] == pytest.approx(0.25 * fmc(np.zeros((1, 2))))

    def test_counts_cases_to_a_share_of_the_truth(self):
        found = compare([self.most] * 2, {0: self.truth})
        assert found.cases_to_50_percent_median == 2.0
        assert found.cases_to_50_percent_quartiles == (2.0, 2.0)
        assert found.cases_to_90_percent_median == 4.0

    def test_has_no_cases_to_a_share_that_too_few_seeds_reach(self):
        found = compare([self.most, self.half, self.half], {0: self.truth})
        assert found.cases_to_90_percent_median is None
        assert found.cases_to_90_percent_quartiles == (None, None)
        assert json.dumps(asdict(found), allow_nan=False)
        found = compare([self.most, self.most, self.half], {0: self.truth})
        assert found.cases_to_90_percent_median == 4.0, "just enough seeds reach it"
        assert found.cases_to_90_percent_quartiles == (4.0, None)

    def test_without_failures_in_the_truth_has_no_share_of_it(self):
        nothing = Truth(np.array([[0.5, 0.5]]), np.array([-1.0]))
        found = compare([self.half], {0: nothing})
        assert found.fmc_over_truth_median is None
        assert json.dumps(asdict(found), allow_nan=False)


class TestTheCoveredShare:
    half, most = TestAComparisonByHand.half, TestAComparisonByHand.most
    small = Truth(np.array([[0.2, 0.2], [0.8, 0.8], [0.5, 0.5]]), np.array([-600.0, -700.0, -1.0]))

    def test_is_that_of_the_failures_of_the_truth_near_one_found(self):
        found = compare([self.half], {0: self.small})
        assert found.covered_share_by_batch_median == [0.0, 0.5]
        assert found.covered_share_median == 0.5
        assert found.cases_to_50_percent_covered_median == 3.0
        assert found.cases_to_90_percent_covered_median is None
        assert compare([self.most], {0: self.small}).cases_to_90_percent_covered_median == 4.0

    def test_is_of_the_dense_truth_where_there_is_one(self):
        dense = {0: dense_truth([[0.2, 0.2], [0.8, 0.8], [0.5, 0.5], [0.9, 0.1]])}
        assert compare([self.half], {0: self.small}, None, dense).covered_share_median == 0.25

    def test_of_levels_is_the_mean_over_those_with_failures(self):
        none = Truth(np.array([[0.5, 0.5]]), np.array([-1.0]))
        other = dense_truth([[0.2, 0.2]])
        assert compare([self.half], {0: self.small, 1: none}).covered_share_median == 0.5
        assert compare([self.half], {0: self.small, 1: other}).covered_share_median == 0.25
        assert compare([self.half], {0: none}).covered_share_median is None

    def test_is_shown_in_place_of_shares_of_a_truth_that_is_too_small(self):
        found = SamplerStudy.of({"uniform": [self.half]}, {0: self.small}, {}, 3, None)
        text = "\n".join(found.lines())
        assert (
            "at level 0 it is too small to be divided by: as many cases again could add up to"
            in text
        )
        assert "too small for regions: 100% of the failures have no other one within 0.05" in text
        assert "covered share: of 2 failing uniform cases" in text
        assert "FMC / truth" not in text
        assert "90 % covered" in text
        record = found.to_record()
        assert record["truth_too_small"]
        assert record["uniform"]["fmc_over_truth_median"] is None
        assert record["uniform"]["seeds_with_all_regions"] is None

    def test_is_shown_beside_those_of_a_large_one(self):
        truth = TestAComparisonByHand.truth
        text = "\n".join(SamplerStudy.of({"uniform": [self.half]}, {0: truth}, {}, 3, None).lines())
        assert "too small" not in text
        assert "FMC / truth" in text
        assert "covered share: of 4 failing" in text


class TestTheLimit:
    truth = TestAComparisonByHand.truth
    near = searched([[(0.2, 0.24)]])
    far = searched([[(0.8, 0.2)]])

    def test_is_the_coverage_of_all_that_truth_and_searches_found(self):
        found = np.array([[0.2, 0.2], [0.8, 0.8], [0.2, 0.24], [0.8, 0.2]])
        assert limit_fmc([self.near, self.far], {0: self.truth}, {}) == pytest.approx(fmc(found))
        assert limit_fmc([], {0: self.truth}, {}) == fmc(self.truth.failures)

    def test_is_that_of_a_dense_truth_where_it_is_more(self):
        points = np.random.default_rng(0).random((50, 2))
        dense = Truth(points, np.full(50, -600.0))
        assert limit_fmc([self.far], {0: self.truth}, {0: dense}) == fmc(points)
        poor = Truth(points[:1], np.full(1, -600.0))
        without = limit_fmc([self.far], {0: self.truth}, {})
        assert limit_fmc([self.far], {0: self.truth}, {0: poor}) == without

    def test_is_summed_over_the_levels_each_with_what_is_more_there(self):
        one = Truth(np.array([[0.5, 0.5]]), np.array([-600.0]))
        dense = Truth(np.array([[0.1, 0.1], [0.9, 0.9]]), np.full(2, -600.0))
        limit = limit_fmc([self.far], {0: one, 1: one}, {1: dense})
        assert limit == pytest.approx(4.0 * fmc(one.failures))

    def test_is_never_passed_although_the_truth_is(self):
        truth = dense_truth([[0.2, 0.2]])
        search = searched([[(0.2, 0.2), (0.8, 0.2)]])
        found = compare([search], {0: truth}, limit_fmc([search], {0: truth}, {}))
        assert found.fmc_over_truth_median == pytest.approx(2.0)
        assert found.fmc_over_limit_median == pytest.approx(1.0)
        assert found.fmc_over_limit_quartiles == pytest.approx((1.0, 1.0))

    def test_that_nobody_gave_and_one_of_nothing_have_no_share(self):
        assert compare([self.far], {0: self.truth}).fmc_over_limit_median is None
        assert compare([searched([[]])], {0: self.truth}, 0.0).fmc_over_limit_median is None


def test_a_truth_is_known_when_it_was_made_and_not_before(truth, cache, tmp_path):
    assert known_truth(plan_for("design1"), 0, 300, cache=tmp_path) is None
    assert known_truth(plan_for("design1"), 0, 301, cache=cache) is None
    known = known_truth(plan_for("design1"), 0, 300, cache=cache)
    assert known is not None
    assert np.array_equal(known.score, truth.score)


def test_the_cases_of_a_truth_are_the_first_of_a_denser_one(truth, tmp_path):
    few = ground_truth(plan_for("design1"), 0, 40, cache=tmp_path)
    assert np.array_equal(few.points, truth.points[:40])
    assert np.array_equal(few.score, truth.score[:40])


class TestTheOracle:
    def test_takes_the_most_useful_failure_first(self):
        # Two that overlap and one apart: one of the two, the one apart, then the rest.
        points = np.array([[0.2, 0.2], [0.22, 0.2], [0.8, 0.8]])
        truth = Truth(points, np.full(3, -600.0))
        curve = oracle({0: truth}, 10, 5)
        one = fmc(points[:1])
        assert curve[0] == 0.0
        assert curve[1] == pytest.approx(one)
        assert curve[2] == pytest.approx(2.0 * one)
        assert curve[3] == pytest.approx(fmc(points))
        assert curve[10] == curve[3]

    def test_is_never_below_another_order(self, truth):
        curve = oracle({0: truth}, 20, 20)
        points = truth.failures
        for n in (1, 5, 10):
            assert curve[n] >= fmc(points[:n]) - 1e-9
        values = list(curve.values())
        assert values == sorted(values)

    def test_of_two_levels_takes_volume_where_there_is_most(self):
        flat = Truth(np.array([[0.5, 0.5]]), np.array([-600.0]))
        solid = Truth(np.array([[0.5, 0.5, 0.5]]), np.array([-600.0]))
        curve = oracle({2: solid, 1: flat}, 2, 2)
        assert curve[1] == pytest.approx(fmc(flat.failures))
        assert curve[2] == pytest.approx(fmc(flat.failures) + fmc(solid.failures))

    def test_of_a_vut_that_never_fails_finds_nothing(self):
        truth = Truth(np.array([[0.5, 0.5]]), np.array([-1.0]))
        assert oracle({0: truth}, 40, 20) == dict.fromkeys([*range(21), 40], 0.0)
