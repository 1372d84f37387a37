"""What decides between the twin's model and the surrogate, with values that follow by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from merge_sumo.samplers.prediction_skill import PredictionSkill

from merge_sumo.metrics.prediction import Prediction
from merge_sumo.metrics.score import Measures, Outcome
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import US23
from merge_sumo.scenario.trajectory import End

LIMIT_M = 6.0
AGREE, DISAGREE = np.array([[0.5, 0.5]]), np.array([[0.5, 5.0]])
"""Gaps, (E, G), in units of the limit: all members expect a failure, or one of two."""


def ran(*, failed, said=None, level=0, index=0, batch=0):
    """Return the outcome of a case of which `said` was predicted."""
    case = Case(level=level, x_pov0_m=-273.0, v_pov0_mps=33.0, scenario=US23)
    score, dx_m = (-600.0, 0.0) if failed else (-50.0, 60.0)
    measures = Measures(end=End.MERGED, score=score, t_end_s=8.3, dx_m=dx_m)
    return Outcome(index, batch, case, measures, said)


def said(gaps=AGREE, *, twin=0.5, surrogate=0.5, p_fail=0.5):
    """Return a prediction, by default one that favours nobody."""
    return Prediction.of(LIMIT_M * gaps, twin, surrogate, p_fail)


def skill(*outcomes, level=0, replayed=None):
    return PredictionSkill(outcomes, level, LIMIT_M, replayed)


def test_without_a_record_nobody_is_preferred():
    none = skill()
    assert (none.twin.tolist(), none.experts.tolist()) == ([0.5, 0.5], [1.0])
    assert (none.trust, none.kept) == (1.0, 1.0)
    assert [none.is_worthless, none.is_doubted, none.breaks_promises] == 3 * [False]


def test_without_a_record_a_gap_is_off_by_each_width_as_the_prior_says():
    # The limit is at arsinh(1) = .8814. A gap that is predicted as 0 is within it with erf(.8814 /
    # (sqrt(2) w)): 1, 1 and 1 for the widths .01, .03 and .1, .98820 for .35, .53736 for 1.2; and
    # with 2 * .8814 / 9 = .19586 anywhere. These count .5, .5, 1, 1, 1 and .5.
    by_hand = (0.5 + 0.5 + 1.0 + 0.98820 + 0.53736 + 0.5 * 0.19586) / 4.5
    assert skill().chance(np.zeros((1, 1, 1))) == pytest.approx([by_hand], abs=1e-5)
    # At the limit itself half of each width is within it, less what is beyond the other limit.
    beyond = 0.5 - 0.5 * math.erf(2.0 * math.asinh(1.0) / (math.sqrt(2.0) * 1.2))
    at_limit = (2.0 - beyond + 0.5 * 0.19586) / 4.5
    assert skill().chance(np.ones((1, 1, 1))) == pytest.approx([at_limit], abs=1e-5)


@pytest.mark.parametrize(
    ("failed", "twin", "surrogate", "expected"),
    [
        (True, 0.8, 0.2, 0.8),  # the odds are 4
        (False, 0.8, 0.2, 0.2),
        (True, 0.6, 0.6, 0.5),
        (True, 1.0, 0.0, 0.995),  # no chance counts as nearer to 0 or 1 than .005
    ],
)
def test_one_verdict_weighs_twin_and_surrogate_by_their_chances(failed, twin, surrogate, expected):
    told = {"twin": twin, "surrogate": surrogate}
    agreed = skill(ran(failed=failed, said=said(**told)))
    assert agreed.twin == pytest.approx([0.5, expected])
    apart = skill(ran(failed=failed, said=said(DISAGREE, **told)))
    assert apart.twin == pytest.approx([expected, 0.5])


def test_a_verdict_counts_half_after_forty_cases_and_two_fifths_at_another_level():
    first = ran(failed=True, said=said(twin=0.8, surrogate=0.2))
    later = [ran(failed=True, said=said(), index=index) for index in range(1, 41)]
    assert skill(first, *later).twin[1] == pytest.approx(2.0 / 3.0)  # the odds are 4 ** .5
    odds = 4.0**0.4
    assert skill(first, level=1).twin[1] == pytest.approx(odds / (1.0 + odds))


def test_a_verdict_is_forgotten_after_two_thousand_cases():
    first = ran(failed=True, said=said(twin=0.8, surrogate=0.2))
    later = [ran(failed=False, index=index) for index in range(1, 2001)]
    assert skill(first, *later[:-1]).twin[1] == pytest.approx(0.8)
    assert skill(first, *later).twin[1] == 0.5


def test_the_weight_decides_between_the_chances_of_twin_and_surrogate():
    learned = skill(ran(failed=True, said=said(twin=0.8, surrogate=0.2)))
    gaps = np.stack([AGREE, DISAGREE], axis=-1)
    mixed = learned.mixed(gaps, np.array([0.9, 0.9]), np.array([0.4, 0.4]))
    assert mixed == pytest.approx([0.8 * 0.9 + 0.2 * 0.4, 0.5 * 0.9 + 0.5 * 0.4])


@pytest.mark.parametrize(("came", "trust"), [(0, 0.25), (1, 0.5), (3, 1.0)])
def test_trust_is_the_failures_that_came_over_those_promised_and_one_of_each_more(came, trust):
    told = [ran(failed=index < came, said=said(p_fail=1.0), index=index) for index in range(3)]
    other_level = ran(failed=False, said=said(p_fail=1.0), level=1, index=3)
    assert skill(*told, other_level).trust == pytest.approx(trust)
    timid = ran(failed=True, said=said(p_fail=0.1))
    assert skill(timid).trust == 1.0, "gains are never made larger"


def test_what_was_kept_is_the_slope_of_the_verdicts_over_the_promises():
    assert skill(ran(failed=False, said=said(p_fail=1.0))).kept == pytest.approx(0.25 / 1.25)
    assert skill(ran(failed=True, said=said(p_fail=1.0))).kept == 1.0
    half = skill(ran(failed=False, said=said(p_fail=0.5)))
    assert half.kept == pytest.approx(0.25 / (0.25 + 0.25))
    seldom = skill(ran(failed=False, said=said(p_fail=1.0)), level=1)
    assert seldom.kept == pytest.approx(0.25 / 0.65)


@pytest.mark.parametrize(("batches", "broken"), [(3, False), (4, True)])
def test_promises_are_broken_after_four_batches_at_the_earliest(batches, broken):
    told = [ran(failed=False, said=said(p_fail=1.0), index=i, batch=i) for i in range(batches)]
    assert skill(*told).breaks_promises == broken


@pytest.mark.parametrize(("cases", "worthless"), [(39, False), (40, True)])
def test_a_twin_without_skill_is_worthless_after_forty_cases(cases, worthless):
    wrong = {"twin": 0.9, "surrogate": 0.1}
    told = [
        ran(failed=False, said=said((AGREE, DISAGREE)[index % 2], **wrong), index=index)
        for index in range(cases)
    ]
    assert skill(*told).is_worthless == worthless
    only_agreed = [ran(failed=False, said=said(**wrong), index=index) for index in range(cases)]
    assert not skill(*only_agreed).is_worthless, "of members that disagree nothing is known"


def test_the_expert_that_knew_the_gap_has_the_weight():
    told = [ran(failed=True, index=index) for index in range(10)]
    alike = {outcome.index: np.array([0.0, 0.0]) for outcome in told}
    assert skill(*told, replayed=alike).experts.tolist() == [0.5, 0.5]
    apart = {outcome.index: np.array([0.0, 30.0]) for outcome in told}
    learned = skill(*told, replayed=apart)
    assert learned.experts.sum() == pytest.approx(1.0)
    assert learned.experts[0] > 0.999
    # All experts together, the one that knew, and the one that did not, of a gap of 0.
    gaps = np.zeros((2, 1, 1))
    together, knew = learned.chance(gaps), learned.chance(gaps[:1], expert=0)
    assert together == pytest.approx(knew, abs=1e-3)
    assert knew > learned.chance(gaps[:1], expert=1)


def test_disagreement_is_the_spread_of_members_less_where_the_gap_is_large():
    gaps = np.sinh([[[1.0], [3.0]]])
    assert skill().disagreement(gaps) == pytest.approx([math.exp(-1.0)])  # 1 around a median of 2
    never = np.full((1, 2, 1), np.nan)
    assert skill().disagreement(never) == pytest.approx([0.0])
