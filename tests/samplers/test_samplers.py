"""The contract of every sampler, without SUMO: a band of failures with a score in closed form."""

from __future__ import annotations

import math
import statistics
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import some

from merge_sumo.errors import UserError
from merge_sumo.samplers import DEFAULT_SAMPLER
from merge_sumo.samplers.base import Sampler
from merge_sumo.samplers.history import LevelHistory
from merge_sumo.samplers.registry import SAMPLERS, make_sampler
from merge_sumo.values.case import Case, Pool, to_unit
from merge_sumo.values.scenario import US23
from merge_sumo.values.score import Measures, Outcome
from merge_sumo.values.trajectory import End

NOTHING: dict[str, Any] = dict.fromkeys(Measures.__dataclass_fields__)
HALF_WIDTH = 0.03
"""Of the band of failures in the unit square; about 7 % of the square."""


def measures(
    end: End, score: float | None, error: str | None = None, dx_m: float | None = None
) -> Measures:
    """Return measures that say no more than a verdict and perhaps a gap."""
    return Measures(
        **{
            **NOTHING,
            "end": end,
            "score": score,
            "dx_m": dx_m,
            "t_end_s": 8.3,
            "vut_max_brake_mps2": 0.0,
            "pov_max_brake_mps2": 0.0,
            "clipped_steps": 0,
            "error": error,
            "nearest": "pov",
        }
    )


def play_case(index: int, batch: int, case: Case) -> Outcome:
    """Return an outcome with a score like the real one: graded, with a jump at the failures."""
    x, v = to_unit([case], case.level)[0, :2].tolist()
    offset = 0.6 * x + 0.8 * v - 0.7
    distance = abs(offset)
    if distance < HALF_WIDTH:
        end, score = End.MERGED, -550.0 - 450.0 * (1.0 - distance / HALF_WIDTH)
    else:
        end, score = End.MERGED, -450.0 * math.exp((HALF_WIDTH - distance) / 0.15)
    return Outcome(index, batch, case, measures(end, score, dx_m=6.0 * offset / HALF_WIDTH))


def without_verdict(index: int, batch: int, case: Case, end: End) -> Outcome:
    return Outcome(index, batch, case, measures(end, None, "no answer"))


def play(sampler: Sampler, batches: int, n: int) -> list[Outcome]:
    """Ask, run and tell some batches; return all outcomes."""
    outcomes: list[Outcome] = []
    for batch in range(batches):
        cases = sampler.ask(n)
        ran = [play_case(len(outcomes) + i, batch, case) for i, case in enumerate(cases)]
        sampler.tell(ran)
        outcomes += ran
    return outcomes


@pytest.fixture(scope="module", params=sorted(SAMPLERS))
def name(request) -> str:
    return request.param


TRAFFIC = replace(US23, headway_ahead_s=(1.0, 4.0), headway_behind_s=(1.0, 3.0))
POOLS = {
    "2-d": Pool(levels=(0,), v_vut0_mps=17.5),
    "3-d": Pool(levels=(2,), v_vut0_mps=17.5),
    "2-d and 3-d": Pool(levels=(0, 1, 2), v_vut0_mps=17.5),
    "4-d": Pool(levels=(0,), v_vut0_mps=17.5, scenario=TRAFFIC),
    "4-d and 5-d": Pool(levels=(1, 2), v_vut0_mps=17.5, scenario=TRAFFIC),
    "6-d": Pool(levels=(2,), scenario=replace(TRAFFIC, v_vut0_mps=(14.0, 22.0))),
}


LONG = ("3-d", "4-d and 5-d", "6-d")


@pytest.fixture(
    scope="module",
    params=[pytest.param(name, marks=pytest.mark.long) if name in LONG else name for name in POOLS],
)
def pool(request) -> Pool:
    return POOLS[request.param]


@pytest.fixture(scope="module")
def played(name, pool) -> tuple[Sampler, list[Outcome]]:
    """Return a sampler after three batches, and what it was told; tests must not tell it more."""
    sampler = make_sampler(name, pool, seed=5)
    return sampler, play(sampler, 3, 9)


@pytest.fixture(scope="module")
def expected(played) -> list[Case]:
    """Return what a sampler that was told the outcomes of `played` proposes next."""
    return played[0].ask(9)


class TestEverySampler:
    @pytest.mark.parametrize("n", [1, 3, 20])
    def test_proposes_as_many_cases_as_asked_for(self, name, pool, played, n):
        assert len(make_sampler(name, pool, 1).ask(n)) == n
        assert len(played[0].ask(n)) == n

    def test_proposes_cases_of_the_pool_in_plain_numbers(self, name, pool, played):
        for case in make_sampler(name, pool, 1).ask(30) + played[0].ask(20):
            assert case.level in pool.levels
            assert type(case.level) is int
            assert case.scenario is pool.scenario
            assert pool.v_vut0_mps in (None, case.v_vut0_mps)
            assert (case.svo_rad is None) == (case.level != 2)
            for dimension in pool.scenario.dimensions(case.level):
                value = getattr(case, dimension.field)
                assert type(value) is float
                assert dimension.low <= value <= dimension.high

    def test_proposes_no_case_twice(self, played, expected):
        cases = [outcome.case for outcome in played[1]] + expected
        assert len(set(cases)) == len(cases)

    def test_answers_the_same_question_with_the_same_cases(self, played, expected):
        sampler, _ = played
        sampler.ask(2)
        assert sampler.ask(9) == expected

    def test_does_not_mind_in_what_order_it_is_told(self, name, pool, played, expected):
        _, outcomes = played
        order = np.random.default_rng(0).permutation(len(outcomes))
        other = make_sampler(name, pool, 5)
        other.tell([outcomes[i] for i in order])
        assert other.told() == outcomes, "rounding follows the order of the history"
        assert other.ask(9) == expected

    def test_does_not_mind_being_told_twice(self, name, pool, played, expected):
        _, outcomes = played
        other = make_sampler(name, pool, 5)
        for outcome in outcomes:
            other.tell([outcome, outcome])
        other.tell(outcomes)
        assert other.ask(9) == expected

    @pytest.mark.parametrize("end", [End.VUT_ERROR, End.SIM_ERROR])
    def test_learns_nothing_from_an_outcome_without_a_verdict(self, name, pool, played, end):
        sampler, outcomes = played
        other = make_sampler(name, pool, 5)
        other.tell(outcomes)
        other.tell([without_verdict(900 + i, 3, o.case, end) for i, o in enumerate(outcomes[:5])])
        for level in pool.levels:
            for column in LevelHistory.__dataclass_fields__:
                known, now = (getattr(s.history(level), column) for s in (sampler, other))
                assert np.array_equal(known, now, equal_nan=True)

    @pytest.mark.parametrize(
        "end", [End.VUT_ERROR, pytest.param(End.SIM_ERROR, marks=pytest.mark.long)]
    )
    @pytest.mark.parametrize("with_history", [False, True])
    def test_proposes_other_cases_after_a_batch_without_a_verdict(
        self, name, pool, played, end, with_history
    ):
        sampler = make_sampler(name, pool, 5)
        if with_history:
            sampler.tell(played[1])
        seen: set[Case] = set()
        for batch in range(3, 6):
            cases = sampler.ask(9)
            assert not seen & set(cases)
            seen |= set(cases)
            sampler.tell(
                [without_verdict(9 * batch + i, batch, case, end) for i, case in enumerate(cases)]
            )

    def test_reaches_every_level_even_if_no_case_gets_a_verdict(self, name, pool):
        sampler = make_sampler(name, pool, 5)
        for index in range(len(pool.levels)):
            (case,) = sampler.ask(1)
            sampler.tell([without_verdict(index, index, case, End.VUT_ERROR)])
        assert {sampler.proposed(level) for level in pool.levels} == {1}

    def test_goes_on_from_a_journal_as_if_it_had_never_stopped(self, name, pool, played):
        _, outcomes = played
        for batches in range(3):
            resumed = make_sampler(name, pool, 5)
            resumed.tell([outcome for outcome in outcomes if outcome.batch < batches])
            expected = [outcome.case for outcome in outcomes if outcome.batch == batches]
            assert resumed.ask(9) == expected

    def test_goes_on_from_a_journal_read_from_its_records(self, name, pool, played, expected):
        _, outcomes = played
        resumed = make_sampler(name, pool, 5)
        records = [outcome.to_record() for outcome in outcomes]
        resumed.tell([Outcome.from_record(record, pool.scenario) for record in records])
        assert resumed.ask(9) == expected

    def test_proposes_other_cases_for_another_seed(self, name, pool, played, expected):
        _, outcomes = played
        other = make_sampler(name, pool, 6)
        assert not set(other.ask(9)) & set(make_sampler(name, pool, 5).ask(9))
        other.tell(outcomes)
        assert other.ask(9) != expected

    def test_proposes_cases_at_every_level(self, pool, played):
        sampler, outcomes = played
        for batch in range(3):
            assert {o.case.level for o in outcomes if o.batch == batch} == set(pool.levels)
        assert {case.level for case in sampler.ask(len(pool.levels))} == set(pool.levels)

    def test_reaches_every_level_even_case_by_case(self, name, pool):
        sampler = make_sampler(name, pool, 5)
        outcomes = play(sampler, len(pool.levels), 1)
        assert {outcome.case.level for outcome in outcomes} == set(pool.levels)

    def test_neither_uses_nor_moves_the_global_random_state(self, played, expected):
        sampler, _ = played
        np.random.seed(1)  # noqa: NPY002 (the global state is what this test is about)
        before = np.random.get_state(legacy=False)  # noqa: NPY002
        assert sampler.ask(9) == expected
        assert repr(np.random.get_state(legacy=False)) == repr(before)  # noqa: NPY002

    def test_leaves_the_list_that_it_is_told_alone(self, name, pool, played):
        _, outcomes = played
        backwards = outcomes[::-1]
        sampler = make_sampler(name, pool, 5)
        sampler.tell(backwards)
        sampler.ask(3)
        assert backwards == outcomes[::-1]


class TestTheRegistry:
    def test_has_the_default_sampler(self):
        assert DEFAULT_SAMPLER in SAMPLERS

    def test_names_the_samplers_that_there_are(self):
        with pytest.raises(UserError) as error:
            make_sampler("grp", Pool(levels=(0,)), 0)
        for word in ("'grp'", *SAMPLERS):
            assert word in str(error.value)


def failures_found(name: str, levels: tuple[int, ...], seed: int, batches: int) -> int:
    sampler = make_sampler(name, Pool(levels=levels), seed)
    return sum(outcome.failed for outcome in play(sampler, batches, 20))


def test_uniform_covers_the_pool_evenly():
    cases = make_sampler("uniform", Pool(levels=(2,)), 3).ask(2000)
    points = to_unit(cases, 2)
    assert points.shape == (2000, 3)
    assert np.abs(points.mean(axis=0) - 0.5).max() < 0.03
    assert points.min() < 0.005
    assert points.max() > 0.995


@pytest.mark.parametrize("levels", some([(0,), (2,)], (2,)), ids=str)
def test_gpr_finds_more_failures_than_uniform_with_the_same_budget(levels):
    uniform, gpr = (
        statistics.median(failures_found(name, levels, seed, batches=6) for seed in (1, 2, 3))
        for name in ("uniform", "gpr")
    )
    assert 0 < uniform < 24, "the band must be neither invisible nor easy"
    assert gpr > 2 * uniform


def test_gpr_spreads_its_batch_out():
    sampler = make_sampler("gpr", Pool(levels=(0,)), 4)
    play(sampler, 4, 20)
    points = to_unit(sampler.ask(20), 0)
    apart = np.linalg.norm(points[:, None] - points[None], axis=2) + np.eye(20)
    assert np.median(apart.min(axis=0)) > 0.02


def test_gpr_gives_more_cases_to_the_level_with_the_failures():
    sampler = make_sampler("gpr", Pool(levels=(0, 1)), 4)
    cases = sampler.ask(20)
    # Level 0 never fails, all of level 1 does.
    verdicts = {0: measures(End.MERGED, -5.0), 1: measures(End.MERGED, -700.0)}
    outcomes = [Outcome(index, 0, case, verdicts[case.level]) for index, case in enumerate(cases)]
    sampler.tell(outcomes)
    levels = [case.level for case in sampler.ask(20)]
    # exp(3) : 1 over 20 cases is 19.05 : 0.95.
    assert (levels.count(0), levels.count(1)) == (1, 19)
