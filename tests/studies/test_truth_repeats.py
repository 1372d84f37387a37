"""A truth at a level: cases that fail in more than a tolerated share of their runs."""

from __future__ import annotations

import random
import warnings
from dataclasses import replace

import numpy as np
import pytest

import merge_sumo as ms
from merge_sumo.errors import UserError
from merge_sumo.scenario.case import from_unit
from merge_sumo.scenario.scenario import US23
from merge_sumo.studies.truth import Truth
from merge_sumo.verdict.chance import MOST_RUNS, is_decided
from merge_sumo.vuts.base import Seen


class Coin:
    """Fails by its seed alone: it drives off, or brakes to a stop, which `TIMEOUT` tells."""

    def reset(self, _: Seen, seed: int) -> None:
        """Draw once for the episode."""
        self.stops = stops(seed)

    def act(self, _: Seen) -> float:
        """Brake, or go."""
        return -3.0 if self.stops else 0.5


def stops(seed: int) -> bool:
    """Return whether the coin of a seed stops: in four of ten runs."""
    return random.Random(seed).random() < 0.4  # noqa: S311


def truth_of(**keywords: float) -> Truth:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it says that an object drives in this process
        fails = 'end == "TIMEOUT"'
        return ms.truth(Coin, 0, cases=12, fail_when=fails, workers=1, **keywords).truths[0]  # type: ignore[arg-type]


@pytest.mark.parametrize(("tolerated", "most"), [(0.0, 3), (0.6, MOST_RUNS), (0.2, 5)])
def test_each_case_runs_until_it_is_decided_as_the_coin_says(tolerated, most):
    repeat = {} if most == MOST_RUNS else {"repeat": most}
    truth = truth_of(tolerated=tolerated, **repeat)
    assert truth.runs is not None
    assert truth.failed_runs is not None
    failing = []
    for place, case in enumerate(from_unit(truth.points, 0, scenario=US23)):
        fell: list[bool] = []
        while len(fell) < most and not (fell and is_decided(sum(fell), len(fell), tolerated)):
            fell.append(stops(replace(case, draw=len(fell)).told_seed))
        assert (truth.failed_runs[place], truth.runs[place]) == (sum(fell), len(fell))
        failing.append(sum(fell) / len(fell) > tolerated)
    assert np.array_equal(truth.failures, truth.points[failing])
    assert truth.all_runs == truth.in_sumo == truth.runs.sum()


def test_runs_that_are_no_number_of_runs_are_refused():
    for keywords, sentence in (({"repeat": 0}, "`repeat` is 0"), ({"tolerated": 1.0}, "tolerated")):
        with pytest.raises(UserError, match=sentence):
            truth_of(**keywords)


def test_what_is_known_to_have_no_chance_runs_once():
    assert ms.truth("design2", 0, cases=20, tolerated=0.2, workers=1).truths[0].runs is None
