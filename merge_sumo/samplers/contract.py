"""The contract of samplers: the properties that a campaign relies on, as tests.

`merge_sumo.testing.SamplerContract` is the class for pytest.
"""

from __future__ import annotations

import json
import math
import re
from functools import lru_cache

import numpy as np

from merge_sumo.metrics.measures import Measures
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.samplers.base import Sampler
from merge_sumo.scenario.case import Case, Pool, to_unit
from merge_sumo.scenario.scenario import US23
from merge_sumo.scenario.trajectory import End


def play_case(index: int, batch: int, case: Case) -> Outcome:
    """Return the outcome of a case in a band of failures, with a score as a simulation gives it.

    Args:
        index: index of the outcome.
        batch: its batch.
        case: the case.
    """
    x, v = to_unit([case], case.level)[0, :2].tolist()
    offset = 0.6 * x + 0.8 * v - 0.7
    # The band of failures has about 7 % of the unit square.
    half_width = 0.03
    score = -450.0 * math.exp((half_width - abs(offset)) / 0.15)
    if abs(offset) < half_width:
        score = -550.0 - 450.0 * (1.0 - abs(offset) / half_width)
    measures = Measures(end=End.MERGED, score=score, t_end_s=8.3, dx_m=6.0 * offset / half_width)
    return Outcome(index, batch, case, measures)


def play(sampler: Sampler, batches: int, n: int) -> list[Outcome]:
    """Ask, run and tell some batches.

    Args:
        sampler: the sampler.
        batches: number of batches.
        n: number of cases of each.

    Returns:
        All outcomes.
    """
    outcomes: list[Outcome] = []
    for batch in range(batches):
        ran = []
        for index, case in enumerate(sampler.ask(n), len(outcomes)):
            ran.append(play_case(index, batch, case))
        sampler.tell(ran)
        outcomes += ran
    return outcomes


@lru_cache(maxsize=4)
def played(kind: type[Sampler], pool: Pool) -> tuple[Sampler, list[Outcome], list[Case]]:
    """Return a sampler after three batches, their outcomes, and its next proposal.

    Args:
        kind: class of the sampler.
        pool: the cases to choose from.
    """
    sampler = kind(pool, 5)
    outcomes = play(sampler, 3, 9)
    return sampler, outcomes, sampler.ask(9)


class SamplerContract:
    """Tests of the properties of a sampler that a campaign needs. pytest runs them.

    Above all, `ask` must be a pure function of the seed and the outcomes.

    Attributes:
        sampler: the class under test.
        pool: the cases to choose from.

    Example:
        ```python
        class TestMySampler(SamplerContract):
            sampler = MySampler
        ```
    """

    sampler: type[Sampler]
    pool: Pool = Pool(levels=(0, 1, 2), scenario=US23)

    def fresh(self, seed: int = 5) -> Sampler:
        """Return a sampler without outcomes.

        Args:
            seed: its seed.
        """
        return self.sampler(self.pool, seed)

    def played(self) -> tuple[Sampler, list[Outcome], list[Case]]:
        """Return a sampler with outcomes, these outcomes, and its next proposal."""
        return played(self.sampler, self.pool)

    def test_says_in_a_line_what_it_does(self) -> None:
        """Help, documentation and figures show it."""
        assert re.fullmatch(".+", self.sampler.about)
        assert re.fullmatch("#[0-9A-Fa-f]{6}", self.sampler.colour)

    def test_proposes_as_many_cases_as_asked_for(self) -> None:
        for n in (1, 3, 20):
            assert len(self.fresh(1).ask(n)) == n
            assert len(self.played()[0].ask(n)) == n

    def test_proposes_cases_of_the_pool_in_plain_numbers(self) -> None:
        """A record needs numbers of Python, and a case must be in the pool of its level."""
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

    def test_does_not_depend_on_the_order_of_the_history_nor_on_a_repetition(self) -> None:
        """Workers finish cases in any order, and a resumed campaign can tell a case again."""
        _, outcomes, proposed = self.played()
        order = np.random.default_rng(0).permutation(len(outcomes))
        shuffled = [outcomes[i] for i in order]
        sampler, before = self.fresh(), list(shuffled)
        sampler.tell(shuffled)
        sampler.tell(shuffled[:5])
        assert sampler.observed() == outcomes, "rounding follows the order of the history"
        assert sampler.ask(9) == proposed
        assert shuffled == before

    def test_proposes_other_cases_after_batches_without_a_verdict(self) -> None:
        """The sampler must not keep proposing a case that ends the controller's process."""
        for history in ([], self.played()[1]):
            sampler, seen = self.fresh(), set[Case]()
            sampler.tell(history)
            for first, end in ((27, End.VUT_ERROR), (36, End.SIM_ERROR), (45, End.VUT_ERROR)):
                cases = sampler.ask(9)
                assert not seen & set(cases)
                seen |= set(cases)
                measures = Measures(end=end, t_end_s=8.3, error="no answer")
                for index, case in enumerate(cases, first):
                    sampler.tell([Outcome(index, first, case, measures)])

    def test_continues_from_a_journal_as_if_it_had_never_stopped(self) -> None:
        _, outcomes, proposed = self.played()
        resumed = self.fresh()
        resumed.tell([outcome for outcome in outcomes if outcome.batch < 2])
        assert resumed.ask(9) == [outcome.case for outcome in outcomes if outcome.batch == 2]
        resumed = self.fresh()
        for outcome in outcomes:
            line = json.dumps(outcome.to_record())
            resumed.tell([Outcome.from_json(line, self.pool.scenario)])
        assert resumed.ask(9) == proposed

    def test_proposes_other_cases_while_cases_run(self) -> None:
        """The sampler must not propose pending cases again, or learn from them."""
        _, outcomes, proposed = self.played()
        first = [outcome for outcome in outcomes if outcome.batch == 0]
        pending = [outcome.case for outcome in outcomes if outcome.batch > 0]
        sampler = self.fresh()
        sampler.set_pending(pending)
        sampler.tell(first)
        assert sampler.proposed() == len(outcomes)
        if sampler.overlaps:
            early = sampler.ask(9)
            assert not {outcome.case for outcome in outcomes} & set(early)
            assert not sampler.learns or early != proposed
        sampler.tell(outcomes)
        sampler.set_pending([])
        assert sampler.ask(9) == proposed

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
