"""The contract of samplers: what a campaign relies on, as tests that a class is put through.

`merge_sumo.testing.SamplerContract` is the class for pytest.
"""

from __future__ import annotations

import json
import math
from functools import lru_cache
from typing import Final

import numpy as np

from merge_sumo.metrics.measures import Measures
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.samplers.base import Sampler
from merge_sumo.scenario.case import Case, Pool, to_unit
from merge_sumo.scenario.scenario import US23
from merge_sumo.scenario.trajectory import End

HALF_WIDTH: Final = 0.03
"""Of the band of failures in the unit square; about 7 % of the square."""


def play_case(index: int, batch: int, case: Case) -> Outcome:
    """Return an outcome with a score like the real one: graded, with a jump at the failures."""
    x, v = to_unit([case], case.level)[0, :2].tolist()
    offset = 0.6 * x + 0.8 * v - 0.7
    distance = abs(offset)
    if distance < HALF_WIDTH:
        score = -550.0 - 450.0 * (1.0 - distance / HALF_WIDTH)
    else:
        score = -450.0 * math.exp((HALF_WIDTH - distance) / 0.15)
    measures = Measures(end=End.MERGED, score=score, t_end_s=8.3, dx_m=6.0 * offset / HALF_WIDTH)
    return Outcome(index, batch, case, measures)


def without_verdict(index: int, batch: int, case: Case, end: End) -> Outcome:
    """Return the outcome of a case that ended in an error."""
    return Outcome(index, batch, case, Measures(end=end, t_end_s=8.3, error="no answer"))


def play(sampler: Sampler, batches: int, n: int) -> list[Outcome]:
    """Ask, run and tell some batches; return all outcomes."""
    outcomes: list[Outcome] = []
    for batch in range(batches):
        cases = sampler.ask(n)
        ran = [play_case(len(outcomes) + i, batch, case) for i, case in enumerate(cases)]
        sampler.tell(ran)
        outcomes += ran
    return outcomes


@lru_cache(maxsize=4)
def played(kind: type[Sampler], pool: Pool) -> tuple[Sampler, list[Outcome], list[Case]]:
    """Return a sampler after three batches, what it was told, and what it proposes next."""
    sampler = kind(pool, 5)
    outcomes = play(sampler, 3, 9)
    return sampler, outcomes, sampler.ask(9)


class SamplerContract:
    """What the campaign relies on in a sampler: a pure function of seed and history.

    Attributes:
        sampler: the class under test.
    """

    sampler: type[Sampler]
    pool: Pool = Pool(levels=(0, 1, 2), scenario=US23)

    def fresh(self, seed: int = 5) -> Sampler:
        """Return a sampler that was told nothing."""
        return self.sampler(self.pool, seed)

    def played(self) -> tuple[Sampler, list[Outcome], list[Case]]:
        """Return a sampler with a history, that history, and its next proposal."""
        return played(self.sampler, self.pool)

    def test_says_in_a_line_what_it_does(self) -> None:
        """Help, documentation and figures show it."""
        about, colour = self.sampler.about, self.sampler.colour
        assert about
        assert "\n" not in about
        assert len(colour) == 7
        assert int(colour.removeprefix("#"), 16) >= 0

    def test_proposes_as_many_cases_as_asked_for(self) -> None:
        for n in (1, 3, 20):
            assert len(self.fresh(1).ask(n)) == n
            assert len(self.played()[0].ask(n)) == n

    def test_proposes_cases_of_the_pool_in_plain_numbers(self) -> None:
        """A record holds Python's numbers, and a case lies in the box of its level."""
        for case in self.fresh(1).ask(30) + self.played()[0].ask(20):
            assert case.level in self.pool.levels
            assert type(case.level) is int
            assert case.scenario is self.pool.scenario
            assert (case.svo_rad is None) == (case.level != 2)
            for dimension in self.pool.scenario.dimensions(case.level):
                value = getattr(case, dimension.field)
                assert type(value) is float
                assert dimension.low <= value <= dimension.high

    def test_proposes_no_case_twice(self) -> None:
        _, outcomes, proposed = self.played()
        cases = [outcome.case for outcome in outcomes] + proposed
        assert len(set(cases)) == len(cases)

    def test_answers_the_same_question_with_the_same_cases(self) -> None:
        sampler, _, proposed = self.played()
        sampler.ask(2)
        assert sampler.ask(9) == proposed

    def test_does_not_depend_on_the_order_of_the_history(self) -> None:
        """Workers end their cases in any order; the caller's list stays as it is."""
        _, outcomes, proposed = self.played()
        order = np.random.default_rng(0).permutation(len(outcomes))
        shuffled = [outcomes[i] for i in order]
        sampler, before = self.fresh(), list(shuffled)
        sampler.tell(shuffled)
        assert sampler.observed() == outcomes, "rounding follows the order of the history"
        assert sampler.ask(9) == proposed
        assert shuffled == before

    def test_does_not_change_when_told_twice(self) -> None:
        """A resumed campaign may tell what is known."""
        _, outcomes, proposed = self.played()
        sampler = self.fresh()
        for outcome in outcomes:
            sampler.tell([outcome, outcome])
        sampler.tell(outcomes)
        assert sampler.ask(9) == proposed

    def test_learns_nothing_from_an_outcome_without_a_verdict(self) -> None:
        """An error says nothing of the case."""
        sampler, outcomes, _ = self.played()
        for end in (End.VUT_ERROR, End.SIM_ERROR):
            other = self.fresh()
            other.tell(outcomes)
            errors = (without_verdict(900 + i, 3, o.case, end) for i, o in enumerate(outcomes[:5]))
            other.tell(list(errors))
            for level in self.pool.levels:
                known, now = sampler.history(level), other.history(level)
                for column in type(known).__dataclass_fields__:
                    pair = getattr(known, column), getattr(now, column)
                    assert np.array_equal(*pair, equal_nan=True)

    def test_proposes_other_cases_after_batches_without_a_verdict(self) -> None:
        """A case that kills the VUT is not asked for again and again."""
        for history in ([], self.played()[1]):
            sampler, seen = self.fresh(), set[Case]()
            sampler.tell(history)
            for batch, end in enumerate((End.VUT_ERROR, End.SIM_ERROR, End.VUT_ERROR), start=3):
                cases = sampler.ask(9)
                assert not seen & set(cases)
                seen |= set(cases)
                sampler.tell(
                    [without_verdict(9 * batch + i, batch, c, end) for i, c in enumerate(cases)]
                )

    def test_goes_on_from_a_journal_as_if_it_had_never_stopped(self) -> None:
        _, outcomes, proposed = self.played()
        for batches in range(3):
            resumed = self.fresh()
            resumed.tell([outcome for outcome in outcomes if outcome.batch < batches])
            expected = [outcome.case for outcome in outcomes if outcome.batch == batches]
            assert resumed.ask(9) == expected
        resumed = self.fresh()
        lines = [json.dumps(outcome.to_record()) for outcome in outcomes]
        resumed.tell([Outcome.from_json(line, self.pool.scenario) for line in lines])
        assert resumed.ask(9) == proposed

    def test_proposes_other_cases_while_cases_run(self) -> None:
        """Pending cases are proposed, and neither proposed again nor learned from."""
        _, outcomes, proposed = self.played()
        sampler, pending = self.fresh(), [o.case for o in outcomes if o.batch > 0]
        sampler.pend(pending)
        sampler.tell([o for o in outcomes if o.batch == 0])
        assert sampler.proposed() == len(outcomes)
        if not sampler.overlaps:  # it is not asked then
            return
        early = sampler.ask(9)
        assert not {o.case for o in outcomes} & set(early)
        assert early == sampler.ask(9)
        assert not sampler.learns or early != proposed
        resumed = self.fresh()
        resumed.tell([o for o in outcomes if o.batch == 0])
        resumed.pend(reversed(pending[:3]))
        resumed.ask(2)
        resumed.pend(pending)
        assert early == resumed.ask(9)

    def test_forgets_pending_cases_that_are_pending_no_more(self) -> None:
        _, outcomes, proposed = self.played()
        sampler = self.fresh()
        sampler.pend([outcome.case for outcome in outcomes])
        sampler.tell(outcomes)
        sampler.pend([])
        assert sampler.ask(9) == proposed

    def test_proposes_cases_at_every_level_while_cases_run(self) -> None:
        sampler, pending = self.fresh(), list[Case]()
        if sampler.overlaps:
            for _ in self.pool.levels:
                pending += sampler.ask(1)
                sampler.pend(pending)
            assert {case.level for case in pending} == set(self.pool.levels)

    def test_proposes_other_cases_for_another_seed(self) -> None:
        _, outcomes, proposed = self.played()
        other = self.fresh(6)
        assert not set(other.ask(9)) & set(self.fresh().ask(9))
        other.tell(outcomes)
        assert other.ask(9) != proposed

    def test_proposes_cases_at_every_level(self) -> None:
        sampler, outcomes, _ = self.played()
        levels = set(self.pool.levels)
        for batch in range(3):
            assert {o.case.level for o in outcomes if o.batch == batch} == levels
        assert {case.level for case in sampler.ask(len(levels))} == levels
        one_by_one = play(self.fresh(), len(levels), 1)
        assert {outcome.case.level for outcome in one_by_one} == levels
        erring = self.fresh()
        for index in range(len(levels)):
            (case,) = erring.ask(1)
            erring.tell([without_verdict(index, index, case, End.VUT_ERROR)])
        assert {erring.proposed(level) for level in levels} == {1}

    def test_neither_uses_nor_moves_the_global_random_state(self) -> None:
        """Randomness comes from `Sampler.rng`."""
        sampler, _, proposed = self.played()
        np.random.seed(1)  # noqa: NPY002 (the global state is what this test is about)
        before = np.random.get_state(legacy=False)  # noqa: NPY002
        assert sampler.ask(9) == proposed
        assert repr(np.random.get_state(legacy=False)) == repr(before)  # noqa: NPY002
