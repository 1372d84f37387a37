"""Why a case fails: what is said is true of the simulation, and the smallest change by hand."""

# mypy: no-strict-optional

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from typing import Any

import pytest
from support.plans import plan_for

import merge_sumo as ms
from merge_sumo.analysis.explanation import (
    EXPLANATIONS,
    Axis,
    Explanation,
    nearest,
)
from merge_sumo.campaigns.run import Run, failures
from merge_sumo.controllers.kinds import load
from merge_sumo.controllers.parameters import Range, values_of
from merge_sumo.errors import UserError
from merge_sumo.metrics.criterion import Criterion
from merge_sumo.reports.text import changes
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.scenario import US23
from merge_sumo.simulation.evaluate import simulate


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("explained") / "run"
    return ms.campaign("design2", cases=72, level="all", seed=1, out=folder, workers=1).run


@pytest.fixture
def folder(made, tmp_path):
    return shutil.copytree(made.folder, tmp_path / "run")


def uniform(vut, folder, cases, **keywords: Any):
    """Return a campaign of uniform cases, which takes the least time."""
    keywords = {"sampler": "uniform", "seed": 1, "workers": 1, **keywords}
    return ms.campaign(vut, cases=cases, out=folder, **keywords)


def passes(plan, case):
    (episode,) = simulate(plan, [case])
    verdict = episode.outcome
    safe = verdict.is_tested and not verdict.failed
    return safe and verdict.measures.severity != "contact"


def check_axes(found: Explanation, case, plan):
    """Check values that pass, and those a unit nearer, in SUMO; return how many there were."""
    checked = 0
    for axis in found.start:
        for value in (v for v in (axis.below, axis.above) if v is not None):
            sign = math.copysign(1.0, value - axis.value)
            nearer = round(value - sign * 10.0**-axis.digits, axis.digits)
            assert axis.low <= value <= axis.high
            assert passes(plan, replace(case, **{axis.name: value})), axis
            if (nearer - axis.value) * sign > 0.0:
                assert not passes(plan, replace(case, **{axis.name: nearer})), axis
            checked += 1
    return checked


class TestACampaign:
    def test_explains_its_worst_failure_alone(self, made):
        worst = failures(made.cases)[0]
        (found,) = EXPLANATIONS.read_lines(made)
        assert (found.index, found.vut) == (worst.index, None)
        assert [axis.name for axis in found.start[:2]] == ["x_pov0_m", "v_pov0_mps"]
        assert found.parameters == ()
        assert check_axes(found, worst.case, plan_for("design2"))

    def test_of_ones_own_controller_explains_none_by_itself(self, tmp_path):
        (tmp_path / "mine.py").write_text("def drive(seen):\n    return 1.0\n")
        own = uniform(f"{tmp_path / 'mine.py'}:drive", tmp_path / "run", 60, level=0)
        assert own.failures
        assert not (own.folder / EXPLANATIONS.name).exists()

    def test_is_not_explained_where_the_engines_differ(self, tmp_path, monkeypatch):
        monkeypatch.setattr("merge_sumo.analysis.explanation.pass_of", lambda _: True)
        run = uniform("level0", tmp_path / "run", 60, level=0)
        assert run.failures
        assert not (run.folder / EXPLANATIONS.name).exists()
        with pytest.raises(UserError, match=r"case \d+ ends otherwise .* the VUT is not that"):
            ms.explain(run)


@pytest.mark.parametrize(
    ("vut", "scenario", "level", "fail_when"),
    [
        ("design1", "us23-traffic", 0, "paper"),
        ("level0", "us23-lane", 2, "dx_m < 12 and dx_m > -12"),
        pytest.param("sumo:Krauss", "us23", 0, "contact", marks=pytest.mark.slow),
    ],
)
def test_what_is_said_is_true_in_sumo(tmp_path, vut, scenario, level, fail_when):
    keywords: dict[str, Any] = {"scenario": scenario, "level": level, "fail_when": fail_when}
    run = uniform(vut, tmp_path / "run", 60, **keywords).run
    case = failures(run.cases)[0].case
    found = ms.explain(run.folder).found
    plan = plan_for(vut, scenario=named_scenario(scenario), criterion=Criterion(fail_when))
    assert check_axes(found, case, plan)
    assert ("svo_rad" in [axis.name for axis in found.start]) == (level == 2)
    for name, passed in found.levels.items():
        psi = 0.0 if name == "2" else None
        assert passes(plan, replace(case, level=int(name), svo_rad=psi)) == passed


def test_the_smallest_change_by_hand(tmp_path):
    """Level 0 against level 0: dx at M is that of eq. (4), worked out here."""
    no_follow_up = replace(US23, follow_up_s=0.0)
    run = uniform("level0", tmp_path / "run", 120, level=0, scenario=no_follow_up).run
    with_follow_up = uniform("level0", tmp_path / "later", 120, level=0).run
    moved = 0
    for outcome in failures(run.cases)[:3]:
        case, (x_m, v_mps, t) = outcome.case, (-182.0, 18.0, 0)
        while x_m < 0.0:
            x_m, v_mps, t = x_m + 0.1 * v_mps, min(v_mps + 0.1, 28.0), t + 1
        of_x, of_v = ms.explain(run, outcome.index).found.start
        # dx is to be 6 or -6: of the start of the POV, then of its speed.
        x_at = [x_m + dx_m - case.v_pov0_mps * 0.1 * t for dx_m in (-6.0, 6.0)]
        assert of_x.below == pytest.approx(math.floor(x_at[0] * 10.0) / 10.0)
        assert of_x.above == pytest.approx(math.ceil(x_at[1] * 10.0) / 10.0)
        v_at = [(x_m + dx_m - case.x_pov0_m) / (0.1 * t) for dx_m in (-6.0, 6.0)]
        slower, faster = math.floor(v_at[0] * 100.0) / 100.0, math.ceil(v_at[1] * 100.0) / 100.0
        assert of_v.below == (pytest.approx(slower) if slower >= 25.0 else None)
        assert of_v.above == (pytest.approx(faster) if faster <= 35.0 else None)
        # With a gap of 1 m at M a faster POV touches the VUT later: that does not pass.
        moved += ms.explain(with_follow_up, outcome.index).found.start[0].below < of_x.below
    assert moved


def first(axis, sign, passing):
    """Return the first value of a side that passes."""
    return nearest(axis, sign, lambda values: list(map(passing, values)))


@pytest.mark.parametrize("value", [8.05, 8.1, 20.0])
def test_a_side_ends_at_the_first_unit_that_passes(value):
    axis = Axis("x", value, 0.0, 30.0, step=1.0, digits=1)
    assert first(axis, 1, lambda v: v > 23.4) == 23.5
    assert first(axis, -1, lambda v: v < 3.3) == 3.2
    assert first(axis, 1, lambda v: True) == pytest.approx(value + 0.1, abs=0.0501)
    # A pass between two values of the grid is missed.
    axis = Axis("x", 0.0, -10.0, 10.0, step=1.0, digits=1)
    assert first(axis, 1, lambda v: 2.2 < v < 2.8 or v > 5.05) == 5.1


class TestParameters:
    def test_of_a_built_in_vut_are_said_in_the_report(self, made, folder):
        worst = failures(made.cases)[0]
        result = ms.explain(folder, params=["gap_m=8..32", "kp=1..1.41"])
        of_gap, of_kp = result.found.parameters
        for value in of_gap.passing:
            nearer = value - math.copysign(0.01, value - 16.2)
            assert passes(plan_for(f"design2?gap_m={value}"), worst.case)
            assert not passes(plan_for(f"design2?gap_m={nearer:.2f}"), worst.case)
        assert of_gap.passing
        assert (of_kp.value, of_kp.low, of_kp.high) == (1.4, 1.0, 1.41)
        other = ms.explain(folder, vut="design2?kp=1.3", params=["kp=1..1.41"])
        assert EXPLANATIONS.read_lines(Run(folder)) == [result.found, other.found], "one a VUT"
        assert (worst.index, other.found.vut) == (result.found.index, "design2?kp=1.3")
        page = ms.open_run(folder).report().read_text("utf-8")
        assert "the VUT's gap_m is 16.20; passes at" in page
        assert "with design2?kp=1.3: the VUT's kp is 1.3000" in page

    def test_of_ones_own_controller_by_hand(self, tmp_path):
        mine = tmp_path / "mine.py"
        mine.write_text(
            "class Brakes:\n"
            "    def __init__(self, brake_mps2=2.05):\n"
            "        if brake_mps2 < 1.99:\n"
            "            raise ValueError\n"
            "        self.brake_mps2 = brake_mps2\n"
            "    def act(self, seen):\n"
            "        return -self.brake_mps2 if seen.t_s < 0.05 else 1.0\n"
        )
        keywords: dict[str, Any] = {"level": 0, "fail_when": "vut_max_brake_mps2 > 2.00125"}
        run = uniform(f"{mine}:Brakes", tmp_path / "run", 2, **keywords)
        (of_brake,) = ms.explain(
            run, 0, vut=f"{mine}:Brakes", params=["brake_mps2=1.9..2.06"]
        ).found.parameters
        # It fails above 2.00125; the end of the range and some that run beside are refused.
        assert of_brake == Axis("brake_mps2", 2.05, 1.9, 2.06, 0.004, 4, below=2.0012)


@pytest.mark.parametrize(
    ("case", "params", "words"),
    [
        (None, ["gap=1..2"], "has no such parameter: did you mean gap_m"),
        (None, ["gap_m=1..2"], "it is 16.2 today, which is not in that range"),
        (None, ["gap_m=8..32", "gap_m=8..32"], "`params` gap_m is given twice"),
        (None, ["gap_m=8"], "write NAME=LOW..HIGH"),
        ("passed", [], "did not fail: name a failure, such as"),
        (10**6, [], "no case 1000000"),
    ],
)
def test_what_cannot_be_explained_is_refused_in_a_sentence(made, case, params, words):
    index = next(o.index for o in made.outcomes if not o.failed) if case == "passed" else case
    with pytest.raises(UserError, match=words):
        ms.explain(made.folder, index, params=params)


def test_a_parameter_of_sumo_needs_its_present_value_in_the_spec():
    with pytest.raises(UserError, match="write it into `vut` as accel=VALUE"):
        values_of(load("sumo:IDM"), [Range("accel", 0.0, 3.0)])


@pytest.mark.parametrize(
    "now",
    [
        "return -0.5 if seen.t_s < 4.0 else 0.5",
        pytest.param("return next(TURNS)", marks=pytest.mark.slow),
    ],
)
def test_a_controller_that_is_another_now_or_decides_by_chance_is_refused(tmp_path, now):
    mine = tmp_path / "mine.py"
    mine.write_text("def drive(seen):\n    return 1.0\n")
    own = uniform(f"{mine}:drive", tmp_path / "run", 60, level=0)
    turns = "import itertools\nTURNS = itertools.cycle([1.0] * 997 + [-2.0] * 991)\n"
    mine.write_text(f"{turns}def drive(seen):\n    {now}\n")
    with pytest.raises(UserError, match="nothing can be said of its changes"):
        ms.explain(own, vut=f"{mine}:drive")


def test_words_by_hand(made):
    outcome = next(o for o in made.outcomes if o.failed and o.case.level == 1)
    x = Axis("x_pov0_m", -200.04, -340.0, -180.0, 1.0, 1, below=-203.1, above=-199.0)
    v = Axis("v_pov0_mps", 30.0, 25.0, 35.0, 0.06, 2)
    found = Explanation(outcome.index, (x, v), {"0": True, "2": False})
    assert list(changes(found, outcome.case)) == [
        "x_POV0 is -200.0 m; passes at -199.0 m or -203.1 m (tried from -340.0 m to -180.0 m, "
        "every 1.0 m)",
        "v_POV0 is 30.00 m/s; passes at no other value (tried from 25.00 m/s to 35.00 m/s, "
        "every 0.06 m/s)",
        "the same start passes at level 0",
        "the same start does not pass at level 2, psi 0",
    ]
    assert found.nearest_start == ("x_pov0_m", -199.0)
