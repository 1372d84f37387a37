"""Requirements over time: signals by hand, words that reach the parser, robustness by rtamt."""

from __future__ import annotations

import sys
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
from conftest import require
from metrics.test_score import ending
from support.histories import CASE

from merge_sumo.errors import UserError
from merge_sumo.metrics.criterion import Criterion
from merge_sumo.metrics.expression import MOST_MARGIN
from merge_sumo.metrics.temporal import NEVER_S, SIGNALS, check_formula, signals
from merge_sumo.scenario.scenario import US23
from merge_sumo.scenario.trajectory import End, Trajectory

NEAR = "always ((x_vut_m > -20) implies (bumper_gap_m > 2))"


@pytest.fixture
def rtamt():
    """Skip where rtamt is not installed."""
    if sys.version_info >= (3, 13):
        pytest.skip("rtamt runs up to Python 3.12")
    require(find_spec("rtamt") is not None, "rtamt is not installed")


class TestSignals:
    def test_by_hand(self):
        motion = np.array([[[-40.0, 30.0, 1.0], [-20.0, 20.0, -1.0]], [[8.0, 20.0, 0.0]] * 2])
        found = signals(Trajectory(CASE, motion, End.MERGED))
        assert tuple(found) == SIGNALS
        # The POV is 20 m behind and 10 m/s faster: 15 m between bumpers, 1.5 s.
        assert {name: float(values[0]) for name, values in found.items()} == {
            **{"x_pov_m": -40.0, "v_pov_mps": 30.0, "a_pov_mps2": 1.0},
            **{"x_vut_m": -20.0, "v_vut_mps": 20.0, "a_vut_mps2": -1.0},
            **{"dx_m": -20.0, "dv_mps": 10.0, "bumper_gap_m": 15.0, "ttc_s": 1.5},
        }
        assert (found["bumper_gap_m"][1], found["ttc_s"][1]) == (-5.0, NEVER_S)

    def test_continue_after_m(self):
        episode = ending(20.0, steps=10)
        after = np.concatenate([episode.motion[-1:], episode.motion[-1:] + 1.0])
        on = signals(replace(episode, after=after))
        assert len(on["x_vut_m"]) == 12
        assert on["x_vut_m"][-1] == episode.x_vut_m[-1] + 1.0


class TestFormulas:
    def test_are_kept_on_one_line(self):
        assert check_formula(" always\n (bumper_gap_m  > 2) ") == "always (bumper_gap_m > 2)"
        assert Criterion(require="always  (bumper_gap_m > 2)") == Criterion(
            require="always (bumper_gap_m > 2)"
        )

    @pytest.mark.parametrize(
        ("text", "said"),
        [
            ("always (bumper_gab_m > 2)", "unknown signal 'bumper_gab_m': choose "),
            ("from os import path always (bumper_gap_m > 2)", "unknown signal 'from'"),
            ("x_vut_m = 2", "'=' is not part"),
            ("bumper_gap_m/dx_m > 2", "'/' is not part"),
            ("always[0:2s] (bumper_gap_m > 2)", "'2' is not part"),
            ("always[0:151] (bumper_gap_m > 2)", "the times [0:151]"),
            ("always[2:1] (bumper_gap_m > 2)", "the times [2:1]"),
            ("x" * 2000, "write at most 1000"),
            ("\ud800", "is not part"),
            ("bumper_gap_m > 2) or (bumper_gap_m < 1", "a closing bracket has no opening"),
        ],
    )
    def test_with_other_words_do_not_reach_the_parser(self, text, said):
        with pytest.raises(UserError, match="`require`") as error:
            Criterion(require=text)
        assert said in str(error.value)

    @pytest.mark.parametrize("text", ["always (dx_m >", "", "(" * 400])
    @pytest.mark.usefixtures("rtamt")
    def test_that_are_not_formulas_are_refused(self, text):
        with pytest.raises(UserError, match="not a formula of signal temporal logic"):
            Criterion(require=text).check(US23)

    @pytest.mark.parametrize(
        "text",
        [
            "always (v_vut_mps - prev v_vut_mps > -5)",
            "always ((prev v_vut_mps) - (prev v_vut_mps) > 0)",
            f"always (x_vut_m * {'9' * 320} > 1)",
        ],
    )
    def test_that_calculate_with_infinity_are_refused(self, rtamt, text):
        with pytest.raises(UserError, match="has infinite values"):
            Criterion(require=text).check(US23)

    def test_go_without_a_condition(self):
        with pytest.raises(UserError, match="choose one"):
            Criterion("contact", NEAR)

    def test_need_the_extra(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "rtamt", None)
        with pytest.raises(UserError, match="merge-sumo\\[stl\\]"):
            Criterion(require="eventually (bumper_gap_m > 3)").check(US23)


@pytest.mark.usefixtures("rtamt")
class TestRobustness:
    @pytest.mark.parametrize(
        ("formula", "margin"),
        [
            ("always (bumper_gap_m > 2)", 9.0),  # from 11 m between bumpers to 15 m
            ("eventually (bumper_gap_m > 17.5)", -2.5),
            ("v_vut_mps > 26", -1e-9),
            ("eventually (x_vut_m > 0)", 1.0),  # 1 m past M at the end, 2.6 m a step
            ("always[0:0.5] (x_vut_m < -10)", 2.0),
            ("always (v_vut_mps > 1000)", -MOST_MARGIN),
            # After the end they hold for no step.
            ("always[20:30] (v_vut_mps > 2)", MOST_MARGIN),
            ("eventually[20:30] (v_vut_mps > 2)", -MOST_MARGIN),
        ],
    )
    def test_is_the_margin(self, formula, margin):
        outcome = Criterion(require=formula).outcome(ending(20.0))
        assert outcome.margin == pytest.approx(margin)
        assert outcome.failed is (margin < 0.0)
