"""The margin of a regression: below 0 where the new version fails and the old one passes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.handmade import cases_of, drive

from merge_sumo.metrics.measures import Measures
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.regression import FARTHEST, margins, regression, regression_gaps

NAN = float("nan")


def outcome(dx_m: float | None, margin: float | None = None) -> Outcome:
    """Return an outcome with this signed gap; its score is that of a failure within 6 m."""
    case = cases_of(0, 2)[0]
    measures = Measures.of(drive(case)).values
    failing = dx_m is not None and abs(dx_m) < 6.0
    return Outcome(
        0,
        0,
        case,
        Measures(**measures | {"dx_m": dx_m, "score": -1e6 if failing else -1.0}),
        None,
        margin,
    )


def test_margins_are_those_that_gaps_stand_for():
    gaps = np.array([2.0, -2.0, 1.0, 0.5, -1.0 / 6.0, 0.0, NAN])
    expected = [1.0, 1.0, 0.0, -1.0, -5.0, -97.0 / 3.0, 97.0 / 3.0]
    assert margins(gaps) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("new_m", "old_m", "margin", "gap"),
    [
        (3.0, 12.0, -1.0, 0.5),  # broke: the old one passes with a margin of 1
        (3.0, 6.6, -0.1, 1.0 / 1.1),  # broke, but the old one has little margin
        (12.0, 18.0, 1.0, 2.0),  # both pass
        (3.0, 3.0, 1.0, 2.0),  # both fail
        (3.0, None, -1.0, 0.5),  # the old one never arrives
        (None, 12.0, FARTHEST, 100.0 / 3.0),  # the new one never arrives: that is no failure
        (3.0, 0.0, FARTHEST, 100.0 / 3.0),
    ],
)
def test_is_the_larger_of_new_and_minus_old(new_m, old_m, margin, gap):
    found = regression(outcome(new_m), outcome(old_m))
    assert found.margin == pytest.approx(margin)
    assert found.failed == (margin < 0.0)
    assert found.signed_gap == pytest.approx(gap)
    new, old = (np.array([NAN if m is None else m / 6.0]) for m in (new_m, old_m))
    assert regression_gaps(new, old) == pytest.approx([gap])


def test_takes_the_margins_of_another_criterion_as_they_are():
    assert regression(outcome(30.0, -0.4), outcome(30.0, 0.3)).margin == pytest.approx(-0.3)
    assert regression(outcome(30.0, -0.4), outcome(30.0, -0.2)).margin == pytest.approx(0.2)


@pytest.mark.parametrize("which", ["new", "old"])
def test_has_no_verdict_without_one_on_both(which):
    passing, silent = outcome(30.0), outcome(30.0)
    silent = replace(silent, measures=Measures.of(drive(silent.case, "answered nan")), margin=None)
    pair = (silent, passing) if which == "new" else (passing, silent)
    found = regression(*pair)
    assert found.margin is None
    assert not found.failed
