"""`coverage`: the worth of a case, and a comparison with uniform sampling."""

# mypy: no-strict-optional

from __future__ import annotations

import statistics
from dataclasses import replace

import numpy as np
import pytest
from conftest import some
from support.histories import ended, history_of

from merge_sumo.metrics.fmc import fmc, radius_for
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.samplers.batch import (
    EVEN_IF_COVERED,
    NEAREST,
    PATIENCE,
    PICKED,
    LevelSearch,
    greedy,
    near_miss_limit,
)
from merge_sumo.samplers.contract import play, play_case
from merge_sumo.samplers.coverage_grid import CoverageGrid
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.samplers.surrogate import Surrogate, learned_values
from merge_sumo.scenario.case import Pool, to_unit
from merge_sumo.scenario.scenario import US23


def coverage_of(outcomes: list[Outcome], level: int) -> float:
    return fmc(to_unit([o.case for o in outcomes if o.failed], level, scenario=US23))


class TestCoverageGrid:
    @pytest.mark.parametrize("dims", some(range(2, 7), 2, 3, 4))
    def test_counts_what_fmc_measures(self, dims):
        reach = 2.0 * radius_for(dims)
        points = np.random.default_rng(dims).uniform(0.5 - reach, 0.5 + reach, (30, dims))
        grid = CoverageGrid(dims)
        grid.cover(grid.balls(points), 1.0)
        one = np.array([[0.5] * dims])
        covered_balls = (1.0 - grid._open).sum() / grid.balls(one).size
        assert covered_balls == pytest.approx(fmc(points) / fmc(one), rel=0.05)

    @pytest.mark.parametrize("dims", [2, 5])
    def test_a_pick_that_fails_with_a_chance_of_60_percent_leaves_40_percent_uncovered(self, dims):
        grid = CoverageGrid(dims)
        here = grid.balls(np.full((1, dims), 0.4))
        grid.cover(here[0], 0.6)
        assert grid.new(here) == pytest.approx([0.4], rel=1e-6)

    @pytest.mark.parametrize("dims", [2, 3, 5])
    def test_a_greedy_batch_maximises_the_expected_gain_pick_by_pick(self, dims):
        rng = np.random.default_rng(dims)
        points, chance = 0.3 * rng.random((100, dims)), rng.random(100)
        picks, gains = greedy(CoverageGrid(dims), points, chance, 20)
        grid, free = CoverageGrid(dims), np.ones(100)
        balls = grid.balls(points)
        for pick, gain in zip(picks, gains, strict=True):
            new = grid.new(balls)
            assert pick == np.argmax(free * chance * (new + EVEN_IF_COVERED))
            assert gain == chance[pick] * new[pick]
            grid.cover(balls[pick], max(PICKED, chance[pick]))
            free[pick] = 0.0


def test_covers_more_than_twice_of_what_uniform_covers():
    pool, median = Pool(levels=(2,), scenario=US23), {}
    for name in ("uniform", "coverage"):
        covered = []
        for seed in (1, 2, 3):
            outcomes = play(make_sampler(name, pool, seed), 5, 20)
            covered.append(coverage_of(outcomes, 2))
        median[name] = statistics.median(covered)
    assert median["uniform"] > 0.0, "the band must not be invisible"
    assert median["coverage"] > 2.0 * median["uniform"]


def test_takes_a_vut_that_never_arrives_for_one_that_lets_the_pov_go_first():
    points = np.random.default_rng(0).random((30, 2))
    gap = 10.0 * (points[:, 0] - 0.5)
    missing = np.where(points[:, 0] > 0.9, np.nan, gap)
    history = history_of(points, np.full(30, 0.99), failed=np.abs(gap) < 1.0, gap=missing)
    values = learned_values(history)
    assert values[np.isnan(missing)] == pytest.approx(np.arcsinh(100.0 / 3.0) / np.arcsinh(1.0))
    sure = Surrogate(history).predict(np.array([[0.5, 0.5], [0.97, 0.5]]))
    assert sure[0] > 0.5 > sure[1]


def test_gives_more_cases_to_the_level_with_more_to_cover_but_starves_none():
    sampler = make_sampler("coverage", Pool(levels=(0, 1, 2), scenario=US23), 4)
    for batch in range(5):
        ran = []
        for index, case in enumerate(sampler.ask(30), 30 * batch):
            passed = ended(case, -1.0, index, batch, dx_m=80.0)
            ran.append(play_case(index, batch, case) if case.level == 1 else passed)
        sampler.tell(ran)
    last = [outcome.case.level for outcome in ran]
    assert last.count(1) == 20, "5 of the half that is shared out evenly, and the other half"
    assert last.count(0) == last.count(2) == 5


def test_looks_where_cases_come_near_but_counts_on_failures_alone():
    rng = np.random.default_rng(2)
    points = rng.random((2 * PATIENCE, 2))
    gap = 1.3 + 10.0 * points[:, 0]
    margin = 1.0 - 0.9 * np.exp(0.4 * (1.0 - gap))
    history = history_of(points, margin, gap=gap)
    assert near_miss_limit(history) is not None
    enough = replace(history, failures=(np.arange(len(points)) < NEAREST).astype(np.int64))
    assert near_miss_limit(enough) is None
    search = LevelSearch(history, np.empty((0, 2)), 0.0, rng)
    proposal = search.surrogate_batch(20)
    assert np.median(proposal.points[:, 0]) < 0.1
    assert proposal.gain.sum() < 2.0
