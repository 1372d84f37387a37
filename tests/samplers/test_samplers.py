"""The contract of every sampler, without SUMO: a band of failures with a score in closed form."""

from __future__ import annotations

import statistics
from dataclasses import replace

import numpy as np
import pytest

from merge_sumo.errors import UserError
from merge_sumo.metrics.measures import Measures
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.samplers.registry import SAMPLERS, make_sampler
from merge_sumo.scenario.case import Pool, to_unit
from merge_sumo.scenario.scenario import US23
from merge_sumo.scenario.trajectory import End
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


class TestTheRegistry:
    def test_names_the_samplers_that_there_are(self):
        with pytest.raises(UserError) as error:
            make_sampler("grp", Pool(levels=(0,), scenario=US23), 0)
        for word in ("'grp'", *SAMPLERS):
            assert word in str(error.value)


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


def test_gpr_gives_more_cases_to_the_level_with_the_failures():
    sampler = make_sampler("gpr", Pool(levels=(0, 1), scenario=US23), 4)
    cases = sampler.ask(20)
    # Level 0 never fails, all of level 1 does.
    verdicts = [Measures(end=End.MERGED, score=s, t_end_s=8.3) for s in (-5.0, -700.0)]
    outcomes = [Outcome(index, 0, case, verdicts[case.level]) for index, case in enumerate(cases)]
    sampler.tell(outcomes)
    levels = [case.level for case in sampler.ask(20)]
    # exp(3) : 1 over 20 cases is 19.05 : 0.95.
    assert (levels.count(0), levels.count(1)) == (1, 19)
