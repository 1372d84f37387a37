"""Measures by CommonRoad-CriMe: its definitions by hand, a stand-in for its Python, and itself."""

from __future__ import annotations

import json
import os
import stat
import sys
from pathlib import Path

import pytest

from merge_sumo.engine.simulator import road_for
from merge_sumo.errors import UserError
from merge_sumo.studies.crime import DEFINITIONS, measured_by
from merge_sumo.values.scenario import US23
from merge_sumo.values.score import Measures
from merge_sumo.values.trajectory import End

EXPECTED = {one.peer_name: one.expected for one in DEFINITIONS}


def merge(dx_m: float, dv_mps: float, clearance_m: float = 1.0) -> Measures:
    """Return the measures of a merge of cars that are 5 m long."""
    return Measures(
        end=End.MERGED,
        t_end_s=8.0,
        dx_m=dx_m,
        dv_mps=dv_mps,
        bumper_gap_m=abs(dx_m) - 5.0,
        before_clearance_m=clearance_m,
    )


class TestDefinitions:
    @pytest.mark.parametrize(
        ("dx_m", "dv_mps", "hw", "ttc", "needed"),
        [
            (-25.0, 4.0, 20.0, 5.0, -0.4),  # the POV comes up from behind
            (25.0, -5.0, 20.0, 4.0, -0.625),  # the VUT comes up from behind
            (25.0, 4.0, 20.0, None, -0.4),  # the gap opens
            (3.0, -4.0, None, None, 0.0),  # bodies overlap
            (-25.0, 0.0, 20.0, None, 0.0),
        ],
    )
    def test_by_hand(self, dx_m, dv_mps, hw, ttc, needed):
        measures = merge(dx_m, dv_mps)
        assert EXPECTED["HW"](measures) == hw
        assert EXPECTED["TTC"](measures) == (None if ttc is None else pytest.approx(ttc))
        assert EXPECTED["ALongReq"](measures) == pytest.approx(needed)

    def test_of_the_smallest_distance_know_no_overlap(self):
        assert EXPECTED["DCE"](merge(9.0, 0.0, -0.4)) == 0.0
        assert EXPECTED["DCE"](merge(9.0, 0.0, 2.5)) == 2.5


def stand_in(folder: Path, answers: str) -> Path:
    """Return a program that answers as `crime_program.py`, by an expression over its cases."""
    file = folder / "python"
    file.write_text(
        f"#!{sys.executable}\nimport json, sys\ncases = json.load(sys.stdin)\n"
        f"sys.stdout.write(json.dumps({answers}))\n"
    )
    file.chmod(file.stat().st_mode | stat.S_IXUSR)
    return file


ONE = '{"HW": 20.0, "TTC": None, "ALongReq": 0.0, "PET": None}'


class TestItsPython:
    def test_is_told_who_is_behind_and_where_lanes_run_together(self, run, tmp_path):
        keep = tmp_path / "told.json"
        python = stand_in(
            tmp_path,
            f'[open({str(keep)!r}, "w").write(json.dumps(cases)), '
            f'{{"version": "9", "values": [{ONE}] * len(cases)}}][1]',
        )
        tool, found = measured_by(python, run, road_for(US23))
        told = json.loads(keep.read_text())
        assert tool == "CommonRoad-CriMe 9"
        assert {one.definition.peer_name: one.cases for one in found} == {
            **dict.fromkeys(("HW", "TTC", "ALongReq", "PET"), len(told)),
            "DCE": 0,
        }
        merged = [o for o in run.outcomes if o.measures.end is End.MERGED]
        worst = min(merged, key=lambda o: (o.score, o.index)).measures
        pov, vut = 2, 3  # one lanelet comes before them
        behind = vut if worst.merged_first == "POV" else pov
        scene = told[0]["scene"]
        assert (scene["ego"], scene["other"]) == (behind, 5 - behind)
        assert scene["step"] == 0
        assert told[0]["episode"]["step"] > 10

    @pytest.mark.parametrize(
        ("answers", "says"),
        [
            ("3", "not answer as a Python with commonroad-crime; make its"),
            ('{"version": "9", "values": []}', "has measured 0 cases"),
            ("1 / 0", "ZeroDivisionError"),
        ],
    )
    def test_that_answers_something_else_is_refused(self, run, tmp_path, answers, says):
        with pytest.raises(UserError, match=says):
            measured_by(stand_in(tmp_path, answers), run, road_for(US23))

    def test_that_is_not_there_is_refused(self, run, tmp_path):
        with pytest.raises(UserError, match="cannot be run"):
            measured_by(tmp_path / "python", run, road_for(US23))

    def test_that_is_another_program_is_refused_with_what_to_do(self, run):
        with pytest.raises(UserError, match=r"/true does not answer .* crime/bin/pip install"):
            measured_by(Path("/usr/bin/true"), run, road_for(US23))

    def test_without_crime_is_refused_with_what_to_do(self, run):
        with pytest.raises(UserError, match="pip install commonroad-crime"):
            measured_by(Path(sys.executable), run, road_for(US23))


def test_commonroad_crime_measures_as_its_definitions_say(run):
    python = os.environ.get("COMMONROAD_PYTHON")
    if python is None:
        pytest.skip("COMMONROAD_PYTHON names no Python with commonroad-crime: .ci/commonroad")
    _, found = measured_by(Path(python), run, road_for(US23))
    by_name = {one.definition.peer_name: one for one in found}
    for name in ("HW", "TTC", "ALongReq", "PET"):
        assert (by_name[name].cases, by_name[name].same) == (20, 20), name
    # Of bodies that pass each other at an angle corners are farther apart than separating axes.
    distance = by_name["DCE"]
    assert distance.same >= 0.8 * distance.cases
    assert distance.largest is None or distance.largest < 0.2
