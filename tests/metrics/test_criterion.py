"""What counts as a failure: conditions by hand, their margins, and campaigns that go by them."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from metrics.test_score import ending
from support.histories import CASE

from merge_sumo.errors import UserError
from merge_sumo.metrics.bodies import SPACING_M, CentreLines, encounters
from merge_sumo.metrics.criterion import PAPER_CRITERION, Criterion, vocabulary
from merge_sumo.metrics.expression import MOST_MARGIN, parse_condition
from merge_sumo.metrics.measures import Measures
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.scenario.scenario import US23
from merge_sumo.scenario.trajectory import End, Trajectory

WORDS = {"x": None, "y": None, "who": frozenset({"A", "B"})}

AB = st.sampled_from(["A", "B"])
SIDE = st.one_of(st.sampled_from(["x", "y"]), st.integers(-3, 3).map(str))
SIGN = st.sampled_from(["<", "<=", ">", ">="])
CONDITIONS = st.recursive(
    st.one_of(
        st.builds("x {} {}".format, SIGN, SIDE),
        st.builds("{} {} y {} {}".format, SIDE, SIGN, SIGN, SIDE),
        st.builds("who {} {!r}".format, st.sampled_from(["==", "!="]), AB),
    ),
    lambda inner: st.one_of(
        st.builds("not ({})".format, inner),
        st.builds("({}) {} ({})".format, inner, st.sampled_from(["and", "or"]), inner),
    ),
    max_leaves=8,
)
"""Comparisons, chains of them, and what `not`, `and` and `or` make of these, as texts."""


def margin(text, **values):
    """Return the margin of a condition over the values x, y and who."""
    condition, _ = parse_condition(text, WORDS, {})
    return condition.margin({"x": 0.0, "y": 0.0, "who": "A", **values})


def of(expression, trajectory):
    """Return the margin of an episode under a criterion."""
    return Criterion(expression).margin(Measures.of(trajectory))


def nearest(trajectory, lines):
    """Return the smallest clearance before M."""
    return encounters([trajectory], lines)[0].before_m


class TestMargins:
    def test_are_in_units_of_the_threshold(self):
        # 1.5 is the threshold: 3 is one of it away, 0.75 half of it beyond.
        assert margin("x < 1.5", x=3.0) == 1.0
        assert margin("x < 1.5", x=0.75) == -0.5
        assert margin("x > 4", x=3.0) == 0.25
        assert margin("-4 < x", x=-6.0) == 0.5
        assert margin("x < 0", x=2.5) == 2.5
        assert margin("x < y", x=5.0, y=3.0) == 2.0

    def test_or_is_the_nearest_and_and_the_farthest(self):
        # x is 1 of its threshold away, y 0.25 of its own.
        assert margin("x < 1 or y > 4", x=2.0, y=3.0) == 0.25
        assert margin("x < 1 and y > 4", x=2.0, y=3.0) == 1.0
        assert margin("x < 1 and y > 4", x=0.5, y=5.0) == -0.25

    def test_are_finite_and_never_0(self):
        assert margin("x < 1", x=math.inf) == MOST_MARGIN
        assert margin("x > 1", x=math.inf) == -MOST_MARGIN
        assert 0.0 < margin("x < 1", x=1.0) < 1e-6
        assert -1e-6 < margin("x <= 1", x=1.0) < 0.0
        assert margin("x < y", x=math.inf, y=math.inf) > 0.0

    @given(CONDITIONS, *[st.one_of(st.integers(-3, 3), st.floats(allow_nan=False))] * 2, AB)
    def test_of_any_condition_are_negative_exactly_where_python_says_it_is_met(
        self, condition, x, y, who
    ):
        values = {"x": float(x), "y": float(y), "who": who}
        assert (margin(condition, **values) < 0.0) is eval(condition, {}, values)  # noqa: S307


class TestParsing:
    @pytest.mark.parametrize(
        ("text", "said"),
        [
            ("speed > 3", "unknown measure 'speed' (write a text in quotes): choose one of score"),
            ("tcc_s < 1.5", "'tcc_s' (write a text in quotes): did you mean ttc_s"),
            ("papr", "did you mean paper?"),
            ('end == "TIMEOT"', "cannot be 'TIMEOT': choose MERGED or TIMEOUT"),
            ('end < "TIMEOUT"', "compare it with == or !="),
            ("end == merged_first", "with a text in quotes"),
            ("ttc_s == 1.5", "compare numbers with <"),
            ('ttc_s < "soon"', "with a text in quotes"),
            ("ttc_s", "is not a condition"),
            ("end == TIMEOUT", "unknown measure 'TIMEOUT' (write a text in quotes)"),
            ("ttc_s < True", "True is not a measure"),
            ("ttc_s < 2 && dx_m > 3", "and, or, not as in Python"),
            ('__import__("os").system("true")', "is not a condition"),
            ("ttc_s < 1\0", "is not a condition over measures"),
            ("(" * 500, "is not a condition over measures"),
            ("ttc_s < 1 and " * 200 + "ttc_s < 1", "write at most 1000"),
            ("ttc_s < " + "9" * 900, "finite"),
        ],
    )
    def test_other_texts_are_refused_in_one_sentence(self, text, said):
        with pytest.raises(UserError, match=r"^`fail_when`") as error:
            Criterion(text)
        assert said in str(error.value)


class TestMeasures:
    @pytest.mark.parametrize(
        ("text", "needs"),
        [
            ("lane_share > 0.9", "an acceleration lane: .* than us23$"),
            ("after_gap_m < 0", "a follow-up: .* `follow_up_s` above 0$"),
            ('nearest == "pov"', "traffic: .* than us23$"),
        ],
    )
    def test_that_a_scenario_does_not_have_are_refused(self, text, needs):
        with pytest.raises(UserError, match=f"needs {needs}"):
            Criterion(text).check(replace(US23, follow_up_s=0.0))

    def test_every_name_has_a_value_in_every_episode(self):
        for end in (End.MERGED, End.TIMEOUT):
            for name, choices in vocabulary().items():
                text = f"{name} < 1" if choices is None else f'{name} == "{min(choices)}"'
                assert math.isfinite(of(text, ending(3.0, end=end)))

    def test_that_are_missing_count_as_never_meeting(self):
        never = ending(0.0, end=End.TIMEOUT)
        for harmless in ("ttc_s < 9", "bumper_gap_m < 9", "pet_s < 9", "dx_m < 9", "drac_mps2 > 0",
                         "brake_after_mps2 > 0", "impact_speed_mps > 0", 'merged_first == "VUT"',
                         "last_avoidable_s < 99"):  # fmt: skip
            assert of(harmless, never) > 0.0, harmless
        assert of('end == "TIMEOUT"', never) == -1.0

    def test_within_6_m_no_braking_would_do(self):
        crash = ending(0.0)
        assert Measures.of(crash).drac_mps2 is None
        assert of("drac_mps2 > 1000", crash) == -MOST_MARGIN
        assert of("last_avoidable_s < -9", crash) == -MOST_MARGIN

    def test_braking_after_the_merge_by_hand(self):
        # 20 m between bumpers, closing by 10 m/s: 12.5 m are left after 0.75 s, so 100 / 25.
        behind = ending(-25.0, v_pov=36.0, v_vut=26.0)
        assert of("brake_after_mps2 > 8", behind) == pytest.approx(0.5)
        ahead = ending(25.0, v_pov=16.0, v_vut=26.0)
        assert of("brake_after_mps2 > 8", ahead) == pytest.approx(0.5)
        assert of("brake_after_mps2 > 8", ending(25.0, v_pov=30.0)) == 1.0
        # 7 m are gone in 0.75 s at 10 m/s.
        assert of("brake_after_mps2 > 8", ending(-12.0, v_pov=36.0)) == -MOST_MARGIN

    def test_severity_by_hand(self):
        for dx_m, severity in ((4.9, "contact"), (5.1, "conflict"), (6.0, "safe")):
            assert Measures.of(ending(dx_m, v_pov=40.0)).severity == severity
        assert Measures.of(ending(0.0, end=End.TIMEOUT)).severity is None
        assert of('severity == "contact"', ending(0.0)) == -1.0
        assert of('severity != "contact"', ending(0.0, end=End.TIMEOUT)) == -1.0


class TestNamed:
    def test_contact_is_of_bodies_and_not_of_points(self):
        # 5 m long: at 5.5 m between the fronts, a failure of the paper, they do not touch.
        assert PAPER_CRITERION.outcome(ending(5.5)).failed
        assert not Criterion("contact").outcome(ending(5.5)).failed
        # 0.1 m of overlap.
        assert Criterion("contact").outcome(ending(-4.9)).margin == pytest.approx(-0.1)

    def test_may_be_part_of_a_condition(self):
        either = Criterion('unsafe or end == "TIMEOUT"')
        assert either.as_written == "unsafe or end == 'TIMEOUT'"
        # 20 m and 10 m/s: 4 m/s2, a third beyond 3.
        hard = ending(-25.0, v_pov=36.0, v_vut=26.0)
        assert of(either.as_written, hard) == pytest.approx(-1.0 / 3.0)
        assert of(either.as_written, ending(9.0, end=End.TIMEOUT)) == -1.0
        assert of("not (contact or unsafe)", ending(-25.0, v_pov=27.0)) < 0.0
        with pytest.raises(UserError, match="did you mean unsafe"):
            Criterion("unsave or ttc_s < 1")


def lines(apart_m, ends_m=-20.0):
    """Return a mainline along y = 0 and a ramp that runs next to it and joins in the last metre."""
    mainline = np.array([[-400.0, -400.0, 0.0], [400.0, 400.0, 0.0]])
    y = [(-400.0, 50.0), (ends_m - 1.0, 50.0), (ends_m, apart_m), (-1.0, apart_m), (0.0, 0.0)]
    return CentreLines.of(mainline, np.array([[x, x, side] for x, side in [*y, (400.0, 0.0)]]))


def lines_that_cross():
    """Return a mainline along y = 0 and a ramp at a right angle to it."""
    mainline = np.array([[-400.0, -400.0, 0.0], [400.0, 400.0, 0.0]])
    ramp = np.array([[-400.0, 0.0, -400.0], [0.0, 0.0, 0.0], [400.0, 400.0, 0.0]])
    return CentreLines.of(mainline, ramp)


def side_by_side(dx, x_vut=-5.0):
    """Return an episode of one step in which the VUT is still before M."""
    motion = np.array([[[x_vut + dx, 20.0, 0.0], [x_vut, 20.0, 0.0]]])
    return Trajectory(CASE, motion, End.TIMEOUT)


class TestBodiesBeforeM:
    @pytest.mark.parametrize(
        ("dx", "apart", "clearance"),
        [
            (0.0, 1.0, -0.8),  # side by side, 1.8 m wide
            (0.0, 2.0, 0.2),
            (4.9, 1.0, -0.1),  # 5 m long: one would have to move aside by less, along the lane
            (-8.0, 1.0, 3.0),
        ],
    )
    def test_clear_each_other_by_hand(self, dx, apart, clearance):
        found = nearest(side_by_side(dx), lines(apart))
        assert found == pytest.approx(clearance)

    def test_that_cross_by_hand(self):
        # The nose of the car on the ramp, at y = -2, is 1.1 m from the side of the other.
        crossing = lines_that_cross()
        assert crossing.together_m == 2.5
        ahead = Trajectory(CASE, np.array([[[2.5, 20.0, 0.0], [-2.0, 0.0, 0.0]]]), End.TIMEOUT)
        assert nearest(ahead, crossing) == pytest.approx(1.1)

    def test_are_looked_at_where_the_lanes_run_together(self):
        assert lines(1.0, ends_m=-20.0).together_m == pytest.approx(20.0, abs=SPACING_M)
        assert lines(3.2).together_m == pytest.approx(1.0, abs=SPACING_M)
        assert nearest(side_by_side(0.0, x_vut=-30.0), lines(1.0)) == math.inf

    def test_that_overlap_are_a_contact_whether_the_vut_merges_or_not(self):
        # The POV overtakes a VUT at -5 m; they overlap in the second row.
        motion = np.array([[[-13.0, 30.0, 0.0], [-5.0, 12.0, 0.0]]] * 3)
        motion[1:, 0] = (-9.5, 20.0, 0.0), (90.0, 20.0, 0.0)
        merged = np.concatenate((motion[:2], [[[90.0, 20.0, 0.0], [0.0, 12.0, 0.0]]]))
        for rows, end in ((motion, End.TIMEOUT), (merged, End.MERGED)):
            found = Measures.of(Trajectory(CASE, rows, end), lines(1.0))
            assert (found.severity, found.impact_speed_mps) == ("contact", 8.0)
            assert found.before_clearance_m == found.clearance_m == pytest.approx(-0.5)
        assert Measures.of(Trajectory(CASE, motion, End.TIMEOUT), lines(2.0)).severity is None
        assert Measures.of(Trajectory(CASE, motion, End.VUT_ERROR), lines(1.0)).severity is None
        # Where the road is unknown, only M and what follows are looked at.
        unknown = Measures.of(Trajectory(CASE, merged, End.MERGED))
        assert (unknown.severity, unknown.clearance_m) == ("safe", 85.0)


class TestOutcomes:
    @pytest.mark.parametrize("margin", [True, "1", math.nan])
    def test_with_a_margin_that_is_not_a_number_are_refused(self, margin):
        record = Criterion("ttc_s < 4").outcome(ending(9.0)).to_record()
        with pytest.raises(UserError, match=r"margin|JSON"):
            Outcome.from_json(json.dumps(record | {"margin": margin}), scenario=US23)

    def test_have_a_gap_of_1_where_the_criterion_turns(self):
        # A TTC of 4.2 s, against 4: 1 + 0.05; then 2 s, against 4: 1 / (1 + 0.5).
        criterion = Criterion("ttc_s < 4")
        assert criterion.outcome(ending(-21.0, v_pov=31.0)).signed_gap == pytest.approx(-1.05)
        assert criterion.outcome(ending(20.0, v_pov=16.0)).signed_gap == pytest.approx(1.0 / 1.5)
        assert PAPER_CRITERION.outcome(ending(-21.0)).signed_gap == pytest.approx(-3.5)

    def test_of_a_condition_that_is_that_of_the_paper_are_those_of_the_paper(self):
        found = Criterion("score < -500").outcome(ending(3.0))
        assert found == PAPER_CRITERION.outcome(ending(3.0))
