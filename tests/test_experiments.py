"""Ground truth and comparison of samplers, in worker processes with a SUMO each."""

from __future__ import annotations

import numpy as np
import pytest

from merge_sumo import experiments
from merge_sumo.errors import UserError
from merge_sumo.experiments import Search, Truth, compare, ground_truth
from merge_sumo.fmc import fmc


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def truth(cache):
    return ground_truth("design1", 0, 600, workers=1, cache=cache)


def test_two_workers_find_the_same_truth_as_one(truth, tmp_path):
    both = ground_truth("design1", 0, 600, workers=2, cache=tmp_path)
    assert np.array_equal(both.points, truth.points)
    assert np.array_equal(both.score, truth.score)
    assert len(truth.failures) > 0


def test_a_truth_is_kept_and_a_torn_file_is_made_again(truth, cache, monkeypatch):
    (kept,) = cache.glob("truth-*.npz")
    counted = []
    again = ground_truth("design1", 0, 600, workers=1, cache=cache, on_cases=counted.append)
    assert np.array_equal(again.score, truth.score)
    assert counted == []
    kept.write_bytes(kept.read_bytes()[:100])
    remade = ground_truth("design1", 0, 600, workers=1, cache=cache, on_cases=counted.append)
    assert np.array_equal(remade.score, truth.score)
    assert sum(counted) == 600


@pytest.mark.parametrize("change", [{"vut": "design2"}, {"level": 1}, {"cases": 601}, {"seed": 1}])
def test_the_key_of_the_cache_names_what_the_truth_depends_on(change):
    values = {"vut": "design1", "level": 0, "cases": 600, "seed": 0}
    assert experiments._key(**values) == experiments._key(**values)
    assert experiments._key(**values) != experiments._key(**(values | change))


def test_a_comparison_says_what_samplers_found_of_the_truth(truth):
    found = compare("design1", 0, ["uniform"], seeds=2, cases=40, batch=20, truth=truth, workers=1)
    result = found["uniform"]
    assert len(result.fmc_by_batch_median) == 2
    assert result.fmc_by_batch_median == sorted(result.fmc_by_batch_median)
    assert result.fmc_over_truth_median == pytest.approx(result.fmc_median / fmc(truth.failures))
    low, high = result.fmc_quartiles
    assert low <= result.fmc_median <= high


def test_cases_to_a_share_of_the_truth_and_regions_by_hand():
    truth = Truth(np.array([[0.2, 0.2], [0.8, 0.8], [0.5, 0.5]]), np.array([-600.0, -700.0, -1.0]))
    whole = fmc(truth.failures)
    half = Search([0.0, whole / 2], 1, np.array([[0.2, 0.24]]), 1.0)
    most = Search([whole / 2, whole], 2, truth.failures, 3.0)
    found = experiments._compared([half, most], whole, truth.real_regions(), 20, 40)
    assert found.regions_found_median == 1.5
    assert found.seeds_with_all_regions == 1
    assert found.cases_to_50_percent_median == 30.0  # 40 and 20
    assert found.cases_to_90_percent_median is None  # never and 40
    assert found.sampler_s_median == 2.0


def test_no_workers_are_refused_in_a_sentence():
    with pytest.raises(UserError, match="--workers is 0"):
        experiments.workers_or_cores(0)
