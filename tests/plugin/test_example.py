"""The example package keeps the contracts; so may the tests of any other."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from merge_sumo_braking import BrakingScenario
from merge_sumo_example import CLOSEST, CLOSEST_APPROACH, ENDINGS, NEAR, MiddleSampler

import merge_sumo as ms
from merge_sumo import api
from merge_sumo.errors import UserError
from merge_sumo.testing import (
    CriterionContract,
    ExportContract,
    MeasureContract,
    ReportSectionContract,
    SamplerContract,
    ScenarioKindContract,
    VutContract,
)
from merge_sumo.vuts.registry import KINDS

installed = pytest.mark.skipif(
    "constant" not in KINDS, reason="the example package is not installed"
)


class TestMiddleSampler(SamplerContract):
    sampler = MiddleSampler


class TestClosest(MeasureContract):
    measure = CLOSEST


class TestEndings(ExportContract):
    export_format = ENDINGS


class TestClosestApproach(ReportSectionContract):
    section = CLOSEST_APPROACH


@installed
class TestBraking(ScenarioKindContract):
    scenario_kind = BrakingScenario


def keep_distance(seen):
    """Brake where the leader is nearer than two seconds."""
    gap_m = seen.x_pov_m - seen.x_vut_m - 5.0
    return -4.0 if gap_m < 3.0 + 2.0 * seen.v_vut_mps else 0.0


@installed
class TestCampaignOfBraking:
    """Two cars on one lane: what is of merges alone is left out of every text."""

    @pytest.fixture(scope="class")
    @classmethod
    def run(cls, tmp_path_factory):
        folder = tmp_path_factory.mktemp("braking") / "run"
        keywords: dict[str, Any] = {
            "scenario": BrakingScenario(),
            "cases": 60,
            "seed": 1,
            "progress": False,
        }
        return ms.campaign(keep_distance, out=folder, **keywords)

    def test_fails_by_contacts(self, run):
        failed = [o for o in run.run.outcomes if o.failed]
        assert 0 < len(failed) < len(run.run.outcomes)
        for outcome in run.run.outcomes:
            assert outcome.failed == (outcome.measures.clearance_m <= 0.0)

    def test_moves_as_eq_4_says(self, run):
        for outcome in run.run.outcomes[:10]:
            x_m, v_mps, a_mps2 = np.moveaxis(run.run.trajectory(outcome.index).motion, 2, 0)
            assert np.abs(x_m[1:] - x_m[:-1] - 0.1 * v_mps[:-1]).max() < 1e-9
            braking = a_mps2[:-1, 0][v_mps[1:, 0] > 0.0]
            assert np.abs(braking - outcome.case.a_pov_mps2).max() < 1e-9

    def test_the_report_says_nothing_of_merges(self, run):
        html = run.report_file.read_text(encoding="utf-8")
        page = re.sub("<(script|style).*?</(script|style)>|<[^>]*>", " ", html, flags=re.DOTALL)
        assert "braking m/s2" in page
        assert not re.findall(r"merge point|merging|[Mm]erges|mainline| ramp|keeps its speed", page)

    def test_a_case_is_run_again_replayed_and_looked_at(self, run, tmp_path):
        worst = next(o for o in run.run.outcomes if o.failed)
        again = ms.run(keep_distance, recorded=(run, worst.index), out=tmp_path / "case")
        assert again.measures == worst.measures
        assert "contact" in "\n".join(again.lines())
        assert ms.replay(tmp_path / "case").identical

    def test_coordinates_are_given_by_name(self):
        keywords: dict[str, Any] = {"scenario": BrakingScenario(), "level": 0}
        near = ms.run(keep_distance, case={"gap0_m": 6.0, "a_pov_mps2": -1.0}, **keywords)
        assert near.outcome.case.gap0_m == 6.0
        with pytest.raises(UserError, match="`at` a_pov_mps2=NUMBER is missing"):
            ms.run(keep_distance, case={"gap0_m": 6.0}, **keywords)
        with pytest.raises(UserError, match="a case has no gap: it has gap0_m"):
            ms.run(keep_distance, at={"gap": 6.0}, **keywords)

    def test_its_road_is_one_lane(self):
        lines = api.check_scenario(BrakingScenario()).lines()
        assert lines[1].startswith("lane of all vehicles: main_in main_out, 1000.0 m before M")
        assert not re.findall("ramp|mainline|trained", "\n".join(lines))

    def test_has_the_levels_of_its_kind(self):
        with pytest.raises(UserError, match="no POV level 1: choose 0"):
            ms.campaign(keep_distance, scenario=BrakingScenario(), level=1)
        with pytest.raises(UserError, match="`fail_when` paper is of merges"):
            ms.campaign(keep_distance, scenario=BrakingScenario(), fail_when="paper")


@installed
class TestNear(CriterionContract):
    criterion = NEAR


@installed
class TestConstant(VutContract):
    vut = "constant:0.5"
