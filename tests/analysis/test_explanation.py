"""Explanations hold in the simulation, and the smallest change is that worked out by hand."""

# mypy: no-strict-optional

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from typing import Any

import pytest
from support.campaigning import campaign_settings, run_campaign
from support.plans import plan_for

import merge_sumo as ms
from merge_sumo.analysis.explanation import (
    EXPLANATIONS,
    Axis,
    Explanation,
    nearest,
)
from merge_sumo.campaigns.recorded import RecordedCampaign, failures
from merge_sumo.controllers.kinds import load
from merge_sumo.controllers.parameters import Range, values_of
from merge_sumo.errors import UserError
from merge_sumo.scenario.scenario import US23
from merge_sumo.simulation.evaluate import simulate


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("explained") / "run"
    return ms.campaign("design2", cases=72, level="all", seed=1, out=folder, workers=1).recorded


@pytest.fixture
def folder(made, tmp_path):
    return shutil.copytree(made.folder, tmp_path / "run")


def uniform(vut, folder, cases, **settings: Any):
    """Return a campaign of uniform cases without studies, which takes the least time."""
    search = campaign_settings(vut=vut, sampler="uniform", cases=cases, seed=1, **settings)
    return run_campaign(search, folder)


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
        assert check_axes(found, worst.case, plan_for("design2"))
        for name, passed in found.levels.items():
            at_level = replace(worst.case, level=int(name), svo_rad=0.0 if name == "2" else None)
            assert passes(plan_for("design2"), at_level) == passed

    def test_is_not_explained_where_the_engines_differ(self, tmp_path, monkeypatch):
        monkeypatch.setattr(
            "merge_sumo.analysis.explanation.passes_without_contact", lambda _: True
        )
        run = ms.campaign(
            "level0", level=0, sampler="uniform", cases=60, seed=1, out=tmp_path / "run"
        )
        assert run.failures
        assert not (run.folder / EXPLANATIONS.name).exists()
        with pytest.raises(UserError, match=r"case \d+ ended differently .* the VUT has changed"):
            ms.explain(run)


def test_the_smallest_change_by_hand(tmp_path):
    """Level 0 against level 0: dx at M is that of eq. (4), worked out here."""
    no_follow_up = replace(US23, follow_up_s=0.0)
    run = uniform("level0", tmp_path / "run", 120, scenario=no_follow_up)
    with_follow_up = uniform("level0", tmp_path / "later", 120)
    moved = 0
    for outcome in failures(run.cases)[:2]:
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
        result = ms.explain(folder, params=["gap_m=8..32"])
        (of_gap,) = result.found.parameters
        for value in of_gap.passing:
            nearer = value - math.copysign(0.01, value - 16.2)
            assert passes(plan_for(f"design2?gap_m={value}"), worst.case)
            assert not passes(plan_for(f"design2?gap_m={nearer:.2f}"), worst.case)
        assert of_gap.passing
        other = ms.explain(folder, vut="design2?kp=1.3", params=["kp=1..1.41"])
        (of_kp,) = other.found.parameters
        assert (of_kp.value, of_kp.low, of_kp.high) == (1.3, 1.0, 1.41)
        assert EXPLANATIONS.read_lines(RecordedCampaign(folder)) == [result.found, other.found], (
            "one a VUT"
        )
        assert (worst.index, other.found.vut) == (result.found.index, "design2?kp=1.3")
        page = ms.open_run(folder).report().read_text("utf-8")
        assert "the VUT's gap_m is 16.20; the case passes at" in page
        assert "with design2?kp=1.3: the VUT's kp is 1.3000" in page

    @pytest.mark.slow
    def test_of_a_controller_of_the_user_by_hand(self, tmp_path):
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
        rule = "vut_max_brake_mps2 > 2.00125"
        run = uniform(f"{mine}:Brakes", tmp_path / "run", 2, fail_when=rule)
        (of_brake,) = ms.explain(
            run, 0, vut=f"{mine}:Brakes", params=["brake_mps2=1.9..2.06"]
        ).found.parameters
        # It fails above 2.00125; values below 1.99 are refused.
        assert of_brake == Axis("brake_mps2", 2.05, 1.9, 2.06, 0.004, 4, below=2.0012)


@pytest.mark.parametrize(
    ("case", "params", "words"),
    [
        (None, ["gap=1..2"], "has no parameter 'gap': choose from"),
        (None, ["gap_m=1..2"], "the present value is 16.2: choose a range"),
        (None, ["gap_m=8"], "write NAME=LOW..HIGH"),
        ("passed", [], "did not fail: choose a case that failed"),
    ],
)
def test_what_cannot_be_explained_is_refused_in_a_sentence(made, case, params, words):
    index = next(o.index for o in made.outcomes if not o.failed) if case == "passed" else case
    with pytest.raises(UserError, match=words):
        ms.explain(made.folder, index, params=params)


def test_a_parameter_of_sumo_needs_its_present_value_in_the_spec():
    with pytest.raises(UserError, match="set it in `vut` with accel=VALUE"):
        values_of(load("sumo:IDM"), [Range("accel", 0.0, 3.0)])


def test_a_controller_that_has_changed_is_refused(tmp_path):
    mine = tmp_path / "mine.py"
    mine.write_text("def drive(seen):\n    return 1.0\n")
    own = uniform(f"{mine}:drive", tmp_path / "run", 60)
    mine.write_text("def drive(seen):\n    return -0.5 if seen.t_s < 4.0 else 0.5\n")
    with pytest.raises(UserError, match="ended differently when it ran again"):
        ms.explain(own, vut=f"{mine}:drive")
