"""Stress tests: a verdict flips on a rung where the case alone flips with that change."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs

import merge_sumo as ms
from merge_sumo.analysis.stress import RUNGS, STRESS, Flips, Rung, flips_of
from merge_sumo.records import to_plain
from merge_sumo.road.loader import road_for
from merge_sumo.scenario.imperfection import Actuation
from merge_sumo.scenario.scenario import US23
from merge_sumo.simulation.kinematic_simulation import KinematicSimulation

FAIL_WHEN = "bumper_gap_m < 15"
"""Two fifths of the cases fail: no sampler need look for them."""
TRIED: dict[str, dict[str, Any]] = {
    "lag-0.5": {"act": Actuation(lag_s=0.5)},
    "power": {"act": Actuation(power_w_per_kg=34.0)},
    "long-pov": {"pov_length_m": 10.0},
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stress") / "run"
    return ms.campaign(
        "design2", level=0, sampler="uniform", cases=50, fail_when=FAIL_WHEN, out=folder
    )


@pytest.fixture(scope="module")
def found(run):
    return ms.stress(run)


def rung(found, name):
    return next(rung for rung in found.rungs if rung.name == name)


def test_nothing_flips_where_nothing_is_changed(found):
    assert rung(found, "nothing").runs == (Flips(),)
    assert found.failures
    assert [one.skipped for one in found.rungs] == [""] * len(RUNGS)


@pytest.mark.parametrize("name", TRIED)
def test_verdicts_flip_as_the_cases_by_themselves_say(run, found, name):
    (flips,) = rung(found, name).runs
    scenario = replace(US23, **TRIED[name])
    chosen = {*flips.passes[:2], *flips.fails[:2], *found.failures[:3]}
    for index in chosen:
        row = run.cases[index]
        now = ms.run("design2", row, level=row["level"], scenario=scenario, fail_when=FAIL_WHEN)
        assert now.failed == ((index in found.failures) != (index in (*flips.passes, *flips.fails)))


def test_the_report_lists_robust_failures_first_where_there_is_a_stress_test(run, found):
    assert STRESS.read(run.folder) == found
    page = (run.folder / "report.html").read_text(encoding="utf-8")
    assert "Sensitivity to small changes" not in page
    assert "Worst failures: the worst of each region, then the second of each" in page
    *others, robust = found.failures
    rungs = (
        Rung("one", "<b>one</b>", runs=(Flips(tuple(others)),)),
        Rung("nothing", "nothing is changed", runs=(Flips(fails=(0,)),)),
    )
    kept = structs.replace(found, rungs=rungs)
    (run.folder / STRESS.name).write_text(json.dumps(to_plain(kept)))
    page = Path(run.report()).read_text(encoding="utf-8")
    (run.folder / STRESS.name).unlink()
    assert STRESS.read(run.folder) is None
    assert "Sensitivity to small changes" in page
    assert "1 result changed although nothing was changed" in page
    assert "&lt;b&gt;one&lt;/b&gt;" in page
    assert "<b>one</b>" not in page
    listed = page[page.index("Worst failures: robust ones first") :]
    assert listed.index(f'data-case="{robust}"') == listed.index("data-case=")


def test_flips_by_hand(run):
    failed = next(o for o in run.recorded.outcomes if o.failed)
    passed = next(o for o in run.recorded.outcomes if o.is_tested and not o.failed)
    both = [failed, passed]
    fails, passes, timeout = (True, True, True), (False, True, True), (False, False, True)
    assert flips_of(both, [fails, passes]) == Flips()
    assert flips_of(both, [passes, fails]) == Flips((failed.index,), (passed.index,))
    assert flips_of(both, [timeout] * 2) == Flips((), (), (failed.index, passed.index))


def test_sumo_own_drivers_are_stressed_but_for_the_step(tmp_path):
    own = ms.campaign("sumo:Krauss", cases=4, level=0, sampler="uniform", out=tmp_path / "run")
    skipped = {one.name: one.skipped for one in ms.stress(own).rungs if one.skipped}
    assert skipped == {"step": "sumo:Krauss drives only in a SUMO simulation"}


class TestAShorterStep:
    def simulation(self, x_vut_m=-10.0):
        simulation = KinematicSimulation(1, road_for(US23), US23, substeps=5)
        simulation.place(0, [(-50.0, 30.0), (x_vut_m, 20.0)])
        return simulation

    def test_moves_by_eq_4_five_times(self):
        simulation = self.simulation()
        simulation.command(np.array([[0.0], [1.0]]))
        # 20 m/s for 0.02 s, then 20.02 m/s, ... 20.08 m/s.
        assert simulation.x_m[:, 0] == pytest.approx([-47.0, -10.0 + 2.004], abs=1e-12)
        assert simulation.v_mps[:, 0] == pytest.approx([30.0, 20.1], abs=1e-12)

    def test_ends_an_episode_in_the_part_in_which_the_vut_arrives(self):
        simulation = self.simulation(-1.0)
        simulation.command(np.zeros((2, 1)))
        # After 0.06 s the VUT is at 0.2 m.
        assert simulation.x_m[:, 0] == pytest.approx([-48.2, 0.2], abs=1e-12)
