"""How predictions of a model become P(fail) and its weight, with values that follow by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.histories import CASE, ended

from merge_sumo.metrics.outcome import Prediction
from merge_sumo.samplers.predictions import (
    chance_by_gaps,
    disagreement,
    gain_factor,
    model_weight,
)


def outcome(*, failed, model=0.5, surrogate=0.5, p_fail=0.5, predicted=True):
    """Return the outcome of a case, by default of a prediction that favours nothing."""
    score, dx_m = (-600.0, 0.0) if failed else (-50.0, 60.0)
    prediction = Prediction.of(np.zeros(8), model, surrogate, p_fail) if predicted else None
    return replace(ended(CASE, score, dx_m=dx_m), prediction=prediction)


def test_p_fail_is_the_share_of_members_that_predict_a_failure():
    gaps = np.array([[0.0, 0.0, 8.0], [0.0, 8.0, np.nan]])
    # asinh(1) is .8814; a gap of 0 is 2.518 times the largest width from the limits: P .98821.
    anywhere = 0.05 * 2.0 * 0.881374 / 9.0
    all_members = 0.7 + 0.25 * 0.98821 + anywhere
    expected = [all_members, (all_members + anywhere) / 2.0, anywhere]
    assert chance_by_gaps(gaps) == pytest.approx(expected, abs=1e-4)


def test_a_member_that_predicts_the_limit_itself_counts_half():
    anywhere = 0.05 * 2.0 * 0.881374 / 9.0
    assert chance_by_gaps(np.array([[1.0]])) == pytest.approx([0.475 + anywhere], abs=1e-4)


def test_disagreement_is_the_spread_of_members_less_where_the_gap_is_large():
    gaps = np.sinh([[1.0], [3.0]])
    assert disagreement(gaps) == pytest.approx([math.exp(-1.0)])  # 1 around a median of 2
    assert disagreement(np.full((2, 1), np.nan)) == pytest.approx([0.0])


@pytest.mark.parametrize(
    ("failed", "model", "surrogate", "expected"),
    [
        (True, 0.8, 0.2, 0.8),  # the odds are 4
        (False, 0.8, 0.2, 0.2),
        (True, 0.6, 0.6, 0.5),
        (True, 1.0, 0.0, 0.995),  # no probability counts as nearer to 0 or 1 than .005
    ],
)
def test_one_verdict_weighs_model_and_surrogate_by_their_likelihoods(
    failed, model, surrogate, expected
):
    known = outcome(failed=failed, model=model, surrogate=surrogate)
    assert model_weight([known]) == pytest.approx(expected)


def test_a_verdict_counts_half_after_forty_predicted_cases():
    first = outcome(failed=True, model=0.8, surrogate=0.2)
    without = [outcome(failed=True, predicted=False)] * 40
    later = [outcome(failed=True)] * 40
    assert model_weight([first, *without]) == pytest.approx(0.8)
    assert model_weight([first, *later]) == pytest.approx(2.0 / 3.0)  # the odds are 4 ** .5


def test_without_predictions_neither_has_more_weight():
    assert model_weight([]) == model_weight([outcome(failed=True, predicted=False)]) == 0.5


@pytest.mark.parametrize(("failures", "factor"), [(0, 0.25), (1, 0.5), (3, 1.0)])
def test_gains_are_multiplied_by_the_share_of_predicted_failures_that_came(failures, factor):
    known = [outcome(failed=index < failures, p_fail=1.0) for index in range(3)]
    assert gain_factor(known) == pytest.approx(factor)
    assert gain_factor([outcome(failed=True, p_fail=0.1)]) == 1.0, "gains are never made larger"
