"""Criteria that no case can meet, or that every case meets: said before the first one, or after.

What the analysis calls certain is compared with random values inside the ranges, and the ranges
with what episodes give.
"""

# mypy: no-strict-optional

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import assert_refused
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from merge_sumo.analysis.plausibility import doubts
from merge_sumo.campaigns.store import Run
from merge_sumo.errors import UserError
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.values.criteria import CRITERIA
from merge_sumo.values.criterion import TEXTS, Criterion, condition_of, values_of
from merge_sumo.values.expression import AllOf, AnyOf, Comparison, Condition, Equality, Negation
from merge_sumo.values.measures import OURS
from merge_sumo.values.scenario import DT_S, US23
from merge_sumo.values.temporal import NEVER_S, SIGNALS, _robustness, _specification
from merge_sumo.values.vacuity import (
    Domain,
    Range,
    Speeds,
    domain_of,
    measure_ranges,
    robustness_range,
)

SCENARIOS = ["us23", "roundabout", "us23-traffic"]


class TestACriterion:
    @pytest.mark.parametrize("name", SCENARIOS)
    @pytest.mark.parametrize("criterion", CRITERIA)
    def test_that_has_a_name_is_sound(self, name, criterion):
        named = Criterion(criterion)
        named.check(named_scenario(name))
        assert named.notes(named_scenario(name)) == []

    @pytest.mark.parametrize(
        ("text", "said"),
        [
            ("clearance_m < 0 and clearance_m > 1", "no case can meet it: its parts rule each"),
            ("ttc_s < -1", "no case can meet it: ttc_s is above 0"),
            ("ttc_s <= 0", "no case can meet it: ttc_s is above 0"),
            ("impact_speed_mps > 130", r"no case can meet it: .*; 130 km/h are 36\.1 m/s"),
            ("ttc_s > 0", "every case meets it: ttc_s is above 0"),
            ("not ttc_s <= 0", "every case meets it"),
            ("ttc_s < 3 or ttc_s > 1", "every case meets it: its parts leave nothing out"),
            ("end == 'MERGED' or end == 'TIMEOUT'", "every case meets it"),
            ("end == 'MERGED' and end == 'TIMEOUT'", "no case can meet it"),
            ("nearest == 'behind'", "no case can meet it: nearest is pov"),
            ("vut_max_brake_mps2 > 4", "vut_max_brake_mps2 is 0 to 4"),
            ("t_end_s > 30", r"no case can meet it: t_end_s is 0\.1 to 30"),
            ("pet_s < ttc_s and ttc_s < pet_s", "its parts rule each other out"),
            ("pet_s < ttc_s and ttc_s < dx_m and dx_m < 1 and pet_s > 2", "rule each other out"),
            ("score > drac_mps2", "no case can meet it"),
            ("drac_mps2 >= score", "every case meets it"),
            ("paper and score > -400", "no case can meet it"),
        ],
    )
    def test_that_decides_nothing_is_refused(self, text, said):
        with pytest.raises(UserError, match=said):
            Criterion(text).check(US23)

    @pytest.mark.parametrize(
        "text",
        [
            "ttc_s < 1.5 or drac_mps2 > 4",
            "vut_max_brake_mps2 >= 4",
            "merged_first == 'VUT' or merged_first == 'POV'",  # not in an episode that times out
            "severity != 'contact'",
            "t_end_s >= 30",
            "last_avoidable_s < -1",
            "pet_s < ttc_s",
            " or ".join(f"ttc_s < {n} and pet_s > {n}" for n in range(1, 30)),
        ],
    )
    def test_that_may_be_met_is_taken_without_a_word(self, text):
        Criterion(text).check(US23)
        assert Criterion(text).notes(US23) == []

    def test_of_another_car_is_one_of_traffic(self):
        Criterion("nearest == 'behind'").check(named_scenario("us23-traffic"))

    @pytest.mark.parametrize(
        ("text", "said"),
        [
            ("dv_mps > 60", "at speeds up to 35 m/s no case can meet it: .*60 km/h are 16.7 m/s"),
            ("impact_speed_mps > 60", "at speeds up to 35 m/s no case can meet it"),
            ("dv_mps < 60", "at speeds up to 35 m/s every case meets it"),
            ("ttc_s < 2 or drac_mps2 < -1", "drac_mps2 < -1 never holds: drac_mps2 is 0 or more"),
            ("ttc_s < 2 and pet_s >= 0", "pet_s >= 0 always holds"),
        ],
    )
    def test_that_is_odd_is_taken_with_a_note(self, text, said):
        Criterion(text).check(US23)
        (note,) = Criterion(text).notes(US23)
        assert re.search(said, note)

    def test_is_refused_by_every_command_that_runs_cases(self, command_line, tmp_path):
        for command in (
            ("campaign", "--out", tmp_path / "run", "--gate", "failures"),
            ("truth", "--level", 0),
            ("benchmark", "--level", 0),
            ("certify", "--level", 0, "--out", tmp_path / "certificate"),
        ):
            assert_refused(
                command_line(*command, "--vut", "design1", "--fail-when", "ttc_s < -1"),
                "no case can meet it",
            )
        assert list(tmp_path.iterdir()) == []


class TestAFormula:
    @pytest.fixture(autouse=True)
    def rtamt(self):
        pytest.importorskip("rtamt")

    @pytest.mark.parametrize(
        ("text", "said"),
        [
            ("always (v_vut_mps < 200)", "it holds in every case"),
            ("always (ttc_s > -1)", "it holds in every case"),
            ("not (eventually (a_vut_mps2 < -5))", "it holds in every case"),
            ("always (abs(dv_mps) < 300)", "it holds in every case"),
            ("(v_vut_mps > -1) or (x_vut_m > 3)", "it holds in every case"),
            ("eventually (x_vut_m < -1000)", "it holds in no case"),
            ("always (v_vut_mps - v_pov_mps > 300)", "it holds in no case"),
            ("always ((ttc_s < 101) implies (v_vut_mps < 0))", "it holds in no case"),
        ],
    )
    def test_that_decides_nothing_is_refused(self, text, said):
        with pytest.raises(UserError, match=said):
            Criterion(require=text).check(US23)

    @pytest.mark.parametrize(
        "text",
        [
            "always ((x_vut_m > -20) implies (bumper_gap_m > 2))",
            "always (ttc_s >= 0)",  # 0 is no robustness
            "always[1,2] (v_vut_mps < 200)",
            "always (v_vut_mps > 2)",
        ],
    )
    def test_that_may_decide_is_taken(self, text):
        Criterion(require=text).check(US23)

    @pytest.mark.parametrize(
        "text",
        [
            "always (v_vut_mps > 2)",
            "eventually (abs(dv_mps - 2*v_pov_mps) <= 3.5)",
            "always ((x_vut_m > -20) implies (bumper_gap_m > 2))",
            "not (always (a_vut_mps2 > -3) and eventually (ttc_s < 2 or dx_m > 1))",
            "historically (v_vut_mps > 2) or once (a_pov_mps2 + a_vut_mps2 > 1)",
            "(v_vut_mps > 2) until[0,2] (ttc_s < 3)",
        ],
    )
    def test_has_a_robustness_inside_what_is_said_of_it(self, text):
        rng = np.random.default_rng(3)
        limits = {name: Range(-rng.random() * 9, rng.random() * 9) for name in SIGNALS}
        (formula,) = _specification(text).ast.specs
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("merge_sumo.values.vacuity.signal_ranges", lambda *_: limits)
            said = robustness_range(formula, US23, Speeds.possible(US23), NEVER_S)
        for steps in (2, 5, 30):
            for _ in range(20):
                values = {name: rng.uniform(*limits[name], steps) for name in SIGNALS}
                assert said.low - 1e-9 <= _robustness(text, values) <= said.high + 1e-9


# ------------------------------------------------------------------------- never and always

NAMES = ("ttc_s", "dx_m", "drac_mps2", "score")
DOMAIN = domain_of(US23, Speeds.possible(US23), TEXTS)
LIMITS = sorted({end for name in NAMES for end in DOMAIN.ranges[name]} | {-1.0, 0.0, 1.0, 2.0})
NUMBER = st.sampled_from(LIMITS).filter(math.isfinite)
SIDES = st.one_of(
    st.tuples(st.sampled_from(NAMES), NUMBER),
    st.tuples(NUMBER, st.sampled_from(NAMES)),
    st.tuples(st.sampled_from(NAMES), st.sampled_from(NAMES)),
)
ATOMS: Any = st.one_of(
    st.builds(lambda sides, equal: Comparison(sides[0], sides[1], equal), SIDES, st.booleans()),
    st.builds(lambda text: Equality("end", text), st.sampled_from(sorted(TEXTS["end"]))),
)


def _grown(parts: Any) -> Any:
    several = st.lists(parts, min_size=2, max_size=3).map(tuple)
    return st.one_of(
        st.builds(Negation, parts), st.builds(AllOf, several), st.builds(AnyOf, several)
    )


CONDITIONS = st.recursive(ATOMS, _grown, max_leaves=6)


@st.composite
def cases(draw: Any) -> dict[str, Any]:
    """Return a value inside the range of each measure; often one that conditions name."""
    found: dict[str, Any] = {"end": draw(st.sampled_from(sorted(DOMAIN.texts["end"])))}
    for name in NAMES:
        low, high = DOMAIN.ranges[name]
        near = [math.nextafter(x, to) for x in LIMITS for to in (-math.inf, x, math.inf)]
        inside = [x for x in near if low <= x <= high]
        found[name] = draw(st.one_of(st.sampled_from(inside), st.floats(low, high)))
    return found


UNTIMED = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
"""No test compares a clock."""


@UNTIMED
@given(CONDITIONS, st.lists(cases(), min_size=1, max_size=20))
@example(Comparison("ttc_s", 0.0, True), [{"ttc_s": 5e-324, "end": "MERGED"}])
def test_never_and_always_are_true_of_all_values_inside_the_ranges(condition, values):
    never, always = DOMAIN.is_never(condition), DOMAIN.is_always(condition)
    assert not (never and always)
    for case in values:
        met = _met(condition, case)
        assert not (never and met)
        assert not (always and not met)


@UNTIMED
@given(CONDITIONS)
def test_what_is_never_met_is_always_missed(condition):
    assert DOMAIN.is_never(condition) == DOMAIN.is_always(Negation(condition))


def test_of_two_comparisons_of_one_measure_the_answer_is_exact():
    tiny = Domain({"ttc_s": Range(0.0, 2.0)}, {})
    steps = [0.0, 0.5, 1.0, 1.5, 2.0]
    for a in (0.0, 1.0, 2.0):
        for b in (0.0, 1.0, 2.0):
            pair = (Comparison("ttc_s", a, True), Comparison(b, "ttc_s", False))
            for whole in (AllOf(pair), AnyOf(pair)):
                met = [_met(whole, {"ttc_s": x}) for x in steps]
                assert tiny.is_never(whole) == (not any(met))
                assert tiny.is_always(whole) == all(met)


def _met(condition: Condition, case: dict[str, Any]) -> bool:
    match condition:
        case Comparison(left, right, or_equal):
            a, b = (case[side] if isinstance(side, str) else side for side in (left, right))
            return bool(a <= b if or_equal else a < b)
        case Equality(name, text):
            return bool(case[name] == text)
        case Negation(of):
            return not _met(of, case)
        case AllOf(parts):
            return all(_met(part, case) for part in parts)
        case AnyOf(parts):
            return any(_met(part, case) for part in parts)


# ------------------------------------------------------------------------- ranges


class TestRanges:
    def test_are_of_every_number_that_a_criterion_may_name(self):
        numbers = {one.name for one in OURS if one.missing is not None}
        assert set(measure_ranges(US23, Speeds.possible(US23))) == numbers

    @pytest.mark.parametrize("name", SCENARIOS)
    def test_hold_no_speed_that_full_acceleration_does_not_reach(self, name):
        scenario = named_scenario(name)
        speeds = Speeds.possible(scenario)
        for v0 in np.linspace(0.0, scenario.v_start_max_mps, 7).tolist():
            x, v = scenario.x_vut0_m, v0
            for _ in range(scenario.max_steps):
                x, v = x + v * DT_S, v + scenario.a_max_mps2 * DT_S
                if x >= 0.0:
                    break
            assert v <= speeds.vut_mps

    def test_hold_what_a_campaign_measured(self, run):
        assert_inside(run)

    @pytest.mark.long
    @pytest.mark.parametrize("name", SCENARIOS)
    @pytest.mark.parametrize("acceleration", [-99.0, 99.0, 0.3])
    def test_hold_what_vuts_at_their_limits_measure(
        self, name, acceleration, tmp_path, command_line, monkeypatch
    ):
        monkeypatch.chdir(tmp_path)
        Path("limit.py").write_text(f"def f(seen):\n    return {acceleration}\n")
        asked = ("--vut", "limit.py:f", "--scenario", name, "--follow-up", 4, "--cases", 60)
        code, _, err = command_line("campaign", *asked, "--sampler", "uniform", "--out", "run")
        assert code in (0, 1), err
        assert_inside(Run(Path("run")))


def assert_inside(run: Run) -> None:
    speeds = Speeds.possible(run.scenario)
    ranges = measure_ranges(run.scenario, speeds)
    for outcome in run.outcomes:
        for name, value in values_of(outcome.measures).items():
            if isinstance(value, float):
                assert ranges[name].low <= value <= ranges[name].high, (name, value)
            else:
                allowed = (
                    {*TEXTS[name], ""} if name in ("severity", "merged_first") else TEXTS[name]
                )
                assert value in allowed


# ------------------------------------------------------------------------- after the run


class TestAfterTheRun:
    def test_a_threshold_in_km_h_is_doubted(self, run):
        criterion = Criterion("dv_mps > 34")
        (said,) = under(run, criterion)
        assert said.startswith("no case fails under dv_mps > 34; with dv_mps > 9.44 (34 km/h) ")

    def test_a_threshold_of_the_other_sign_is_doubted(self, run):
        (said,) = under(run, Criterion("dv_mps < -8"))
        assert "(the other sign)" in said

    def test_a_verdict_that_differs_between_cases_is_not(self, run):
        assert under(run, Criterion("dx_m < 0")) == []
        assert under(run, Criterion("paper")) == []

    def test_one_verdict_without_a_neighbour_is_not(self, run):
        assert under(run, Criterion("t_end_s < 0.2")) == []

    def test_accelerations_that_are_clipped_are_told(self, run):
        at_limit = [
            replace(o, measures=replace(o.measures, clipped_steps=round(o.measures.t_end_s / DT_S)))
            for o in run.outcomes
        ]
        steps = sum(o.measures.clipped_steps for o in at_limit)
        (said,) = doubts(at_limit, Criterion())
        assert said.startswith(f"in {steps} of {steps} steps the VUT asks for an acceleration")

    def test_the_command_says_it_in_terminal_json_and_report(
        self, tmp_path, command_line, monkeypatch
    ):
        monkeypatch.chdir(tmp_path)
        Path("hard.py").write_text("def f(seen):\n    return 9.0\n")
        asked = (
            *("campaign", "--vut", "hard.py:f", "--level", 0, "--cases", 6),
            *("--sampler", "uniform"),
        )
        code, out, err = command_line(*asked, "--out", "run")
        assert code == 0, err
        (line,) = (line for line in out.splitlines() if "note: in " in line)
        assert "outside -4 to 2 m/s2" in line
        assert line.strip().removeprefix("note: ") in Path("run/report.html").read_text()
        _, out, _ = command_line(*asked, "--out", "json", "--json")
        assert json.loads(out)["notes"] == [line.strip().removeprefix("note: ")]


def under(run: Run, criterion: Criterion) -> list[str]:
    """Return what is doubted of the outcomes of a run under another criterion."""
    judged = []
    for outcome in run.outcomes:
        condition = condition_of(criterion.words)
        margin = None if criterion.is_papers else condition.margin(values_of(outcome.measures))
        judged.append(replace(outcome, margin=margin))
    return doubts(judged, criterion)
