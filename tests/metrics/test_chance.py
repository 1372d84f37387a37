"""Draws of a case, and cases that fail in a share of their runs."""

# mypy: no-strict-optional

from __future__ import annotations

import json
import pickle
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from support.histories import ended

from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.summary import (
    by_case,
    clopper_pearson,
    failing_cases,
    is_decided,
    one_per_case,
    undecided,
)
from merge_sumo.scenario.case import Case, to_unit
from merge_sumo.scenario.scenario import US23

CASE = Case(level=2, x_pov0_m=-273.0, v_pov0_mps=33.0, svo_rad=0.5, scenario=US23)
FAILS, PASSES = -600.0, -20.0


def outcomes(runs: Sequence[tuple[Case, int, float | None]]) -> list[Outcome]:
    """Return outcomes of (case, draw, score), without a verdict for None."""
    found = []
    for index, (case, draw, score) in enumerate(runs):
        found.append(ended(replace(case, draw=draw), score, index))
    return found


def test_the_first_draw_is_the_case_as_it_was_and_others_have_other_seeds():
    second = replace(CASE, draw=2)
    # CRC-32 of "(2, 0.5, [(-273.0, 33.0), (-182.0, 18.0)])", then of the bytes 2 0 0 0.
    assert CASE.seed == 0xF7DAFF7F
    assert second.seed == 0x5E87D99A
    assert len({replace(CASE, draw=draw).seed for draw in range(1000)}) == 1000
    assert second.start == CASE
    assert second != CASE
    assert np.array_equal(to_unit([second], 2), to_unit([CASE], 2))
    assert pickle.loads(pickle.dumps(second)) == second  # noqa: S301


def test_the_seed_of_a_controller_reveals_neither_level_nor_orientation():
    other = replace(CASE, svo_rad=1.0)
    below = replace(CASE, level=1, svo_rad=None)
    assert CASE.controller_seed == other.controller_seed == below.controller_seed
    assert CASE.controller_seed != replace(CASE, draw=1).controller_seed
    assert CASE.controller_seed != replace(CASE, x_pov0_m=-274.0).controller_seed


def test_a_record_names_the_draw_only_where_it_is_not_the_first():
    first, second = outcomes([(CASE, 0, FAILS), (CASE, 7, FAILS)])
    assert "draw" not in first.to_record()
    assert second.to_record()["draw"] == 7
    assert Outcome.from_json(json.dumps(second.to_record()), US23) == second


def test_runs_are_counted_by_case_in_the_order_of_the_first_run():
    other = replace(CASE, x_pov0_m=-200.0)
    first = [(CASE, 0, FAILS), (other, 0, PASSES), (CASE, 1, PASSES), (CASE, 2, None)]
    found = outcomes([*first, (other, 1, PASSES), (CASE, 3, FAILS - 1.0)])
    one, two = by_case(found)
    assert (one.case, one.runs, one.failures, one.share) == (CASE, 3, 2, 2 / 3)
    assert [outcome.index for outcome in one.outcomes] == [0, 2, 5]
    assert (two.case, two.runs, two.failures) == (other, 2, 0)
    assert failing_cases(found) == failing_cases(found, 0.66) == [one]
    assert failing_cases(found, 2 / 3) == []


def test_without_repeats_each_outcome_with_a_verdict_is_a_case():
    """Also where a sampler proposes a case twice."""
    found = outcomes([(CASE, 0, FAILS), (CASE, 0, FAILS), (CASE, 0, None), (CASE, 0, PASSES)])
    assert [one.outcomes for one in by_case(found)] == [(found[0],), (found[1],), (found[3],)]


def test_the_interval_is_that_of_clopper_and_pearson():
    assert clopper_pearson(3, 10, 0.95) == pytest.approx((0.0667, 0.6525), abs=1e-4)
    # By hand: no failure in n gives 1 - (alpha/2)^(1/n).
    assert clopper_pearson(0, 100, 0.95) == pytest.approx((0.0, 1.0 - 0.025 ** (1 / 100)))
    assert clopper_pearson(0, 0, 0.95) == (0.0, 1.0)


def test_the_deciding_run_fails_as_the_case_does():
    other = replace(CASE, x_pov0_m=-200.0)
    runs = [(CASE, draw, (PASSES, FAILS, FAILS - 9.0, PASSES - 9.0)[draw]) for draw in range(4)]
    found = outcomes([*runs, (other, 0, None), (other, 1, PASSES)])
    assert [outcome.index for outcome in one_per_case(found)] == [2, 4, 5]
    assert [outcome.index for outcome in one_per_case(found, 0.5)] == [3, 4, 5]
    assert [outcome.index for outcome in one_per_case(found, 0.25)] == [1, 4, 5]
    first = [outcome for outcome in found if not outcome.case.draw]
    assert one_per_case(first) == first


def test_a_failing_case_is_decided_by_the_posterior_of_its_runs():
    # P(share > .2) is .959 with Beta(1.5, .5), and .705 with Beta(.5, .5), of one that failed once.
    assert not is_decided(1, 1, 0.2)
    assert is_decided(2, 2, 0.2)
    assert (is_decided(4, 19, 0.2), is_decided(4, 20, 0.2)) == (False, True), "20 runs are the most"


def test_a_failing_case_is_undecided_until_its_runs_tell_unless_no_two_runs_ever_differ():
    once, twice, passes = (replace(CASE, x_pov0_m=-200.0 - n) for n in range(3))
    runs = [(once, 0, FAILS), (passes, 0, PASSES), (twice, 0, FAILS), (twice, 1, FAILS - 1.0)]
    assert undecided(outcomes(runs), 0.2) == {0}, "two of two decide"
    assert undecided(outcomes(runs[:3]), 0.2) == {0, 2}
    assert undecided(outcomes(runs), 0.0) == set()
    same = [*runs[:3], (twice, 1, FAILS)]
    assert undecided(outcomes(same), 0.2) == set(), "chance was looked for, and not seen"
