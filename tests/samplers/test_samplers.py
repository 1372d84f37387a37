"""The contract of every sampler, without SUMO: a band of failures with a score in closed form."""

from __future__ import annotations

import statistics
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.histories import ended

from merge_sumo.samplers.registry import SAMPLERS, make_sampler
from merge_sumo.samplers.uniform import UniformSampler
from merge_sumo.scenario.case import Pool, to_unit
from merge_sumo.scenario.scenario import US23
from merge_sumo.testing.contracts import SamplerContract, play

TRAFFIC = replace(US23, headway_ahead_s=(1.0, 4.0), headway_behind_s=(1.0, 3.0))
POOLS = {
    "2-d and 3-d": Pool(levels=(0, 1, 2), scenario=US23),
    "4-d": Pool(levels=(0,), scenario=TRAFFIC),
}


@pytest.fixture(scope="module", params=sorted(SAMPLERS))
def name(request) -> str:
    return request.param


@pytest.fixture(scope="module", params=POOLS)
def pool(request) -> Pool:
    return POOLS[request.param]


class TestEverySampler(SamplerContract):
    @pytest.fixture(autouse=True)
    def _subject(self, name, pool):
        self.sampler, self.pool = SAMPLERS[name], pool


class ProposedSampler(UniformSampler):
    """A sampler of cases that were proposed before."""

    def __init__(self, *proposed: int) -> None:
        super().__init__(Pool(levels=tuple(range(len(proposed))), scenario=US23), 0)
        self.before = proposed

    def proposed(self, level=None):
        return self.before[level]


class TestShares:
    @pytest.mark.parametrize(
        ("proposed", "n", "expected"),
        [
            ((7, 6, 7), 4, {0: 1, 1: 2, 2: 1}),
            ((7, 6, 5), 5, {0: 1, 1: 2, 2: 2}),
            ((5, 2, 9), 1, {0: 0, 1: 1, 2: 0}),
            ((5, 2, 9), 2, {0: 1, 1: 1, 2: 0}),
        ],
    )
    def test_levels_with_the_fewest_cases_come_first(self, proposed, n, expected):
        assert ProposedSampler(*proposed).shares(n) == expected

    @given(st.lists(st.floats(1e-3, 1e3), min_size=3, max_size=3), st.integers(0, 300))
    def test_add_up_to_the_batch_and_leave_no_level_out(self, weights, n):
        shares = ProposedSampler(4, 4, 4).shares(n, dict(enumerate(weights)))
        assert sum(shares.values()) == n
        assert list(shares) == [0, 1, 2]
        assert sum(share > 0 for share in shares.values()) == min(n, 3)


def failures_found(name: str, levels: tuple[int, ...], seed: int, batches: int) -> int:
    sampler = make_sampler(name, Pool(levels=levels, scenario=US23), seed)
    return sum(outcome.failed for outcome in play(sampler, batches, 20))


def test_uniform_covers_the_pool_evenly():
    cases = make_sampler("uniform", Pool(levels=(2,), scenario=US23), 3).ask(2000)
    points = to_unit(cases, 2, scenario=US23)
    assert points.shape == (2000, 3)
    assert np.abs(points.mean(axis=0) - 0.5).max() < 0.03
    assert points.min() < 0.005
    assert points.max() > 0.995


def test_gpr_finds_more_failures_than_uniform_with_the_same_budget():
    uniform, gpr = (
        statistics.median(failures_found(name, (2,), seed, batches=6) for seed in (1, 2, 3))
        for name in ("uniform", "gpr")
    )
    assert 0 < uniform < 24, "the band must be neither invisible nor easy"
    assert gpr > 2 * uniform


def test_gpr_shares_by_the_failures_of_the_last_batch_of_each_level():
    sampler = make_sampler("gpr", Pool(levels=(0, 1), scenario=US23), 4)
    cases = {level: sampler.pool.cases(np.array([[0.5, 0.5]]), level)[0] for level in (0, 1)}
    # Level, batch and score: half of the last batch of level 1 fails, none of level 0.
    runs = [(0, 0, -5.0), (1, 0, -5.0), (1, 1, -700.0), (1, 1, -5.0), (0, 2, -5.0)]
    for index, (level, batch, score) in enumerate(runs):
        sampler.tell([ended(cases[level], score, index, batch)])
    levels = [case.level for case in sampler.ask(20)]
    # exp(3 / 2) : 1 over 20 cases is 16.35 : 3.65.
    assert (levels.count(0), levels.count(1)) == (4, 16)
