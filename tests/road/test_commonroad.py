"""CommonRoad scenarios by hand, and by the reader and the schema of CommonRoad."""

# mypy: no-strict-optional

from __future__ import annotations

import math
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lxml import etree

from merge_sumo.engine.simulator import road_for
from merge_sumo.reports.exports import write_commonroad
from merge_sumo.road.commonroad import commonroad, obstacle_ids, straight_road
from merge_sumo.road.scenario_file import named_scenario, shipped_scenarios
from merge_sumo.values.case import MergeCase
from merge_sumo.values.scenario import US23, VUT, Scenario
from merge_sumo.values.trajectory import End, Trajectory

CHECK = Path(__file__).with_name("commonroad_check.py")


def episode(scenario: Scenario = US23, rows: int = 3) -> Trajectory:
    """Return an episode in which all keep their speeds."""
    more: dict[str, Any] = (
        {"headway_ahead_s": 1.0, "headway_behind_s": 1.0} if scenario.vehicles > 2 else {}
    )
    speeds: dict[str, Any] = {
        "v_pov0_mps": min(30.0, scenario.v_start_max_mps),
        "v_vut0_mps": scenario.bounds("v_vut0_mps")[0],
    }
    case = MergeCase(level=0, x_pov0_m=-100.0, scenario=scenario, **speeds, **more)
    starts = np.array([(x, v, 0.0) for x, v in case.starts()])
    motion = np.repeat(starts[None], rows, axis=0)
    motion[:, :, 0] += 0.1 * np.arange(rows)[:, None] * starts[:, 1]
    return Trajectory(case, motion, End.MERGED)


def numbers(element: etree._Element, *paths: str) -> list[float]:
    return [float(element.findtext(path) or "nan") for path in paths]


class TestAnEpisode:
    def test_has_the_centres_of_bodies_at_every_step(self):
        root = etree.fromstring(commonroad(episode(), road_for(US23), number=7, source="mine"))
        assert root.get("benchmarkID") == "ZAM_MergeSumo-1_7_T-1"
        assert root.get("timeStepSize") == "0.1"
        pov, vut = root.findall("dynamicObstacle")
        assert [int(o.get("id") or 0) for o in (pov, vut)] == obstacle_ids(road_for(US23), 2)
        assert numbers(pov, "shape/rectangle/length", "shape/rectangle/width") == [5.0, 1.8]
        place = "position/point/x", "position/point/y", "orientation/exact", "velocity/exact"
        assert numbers(pov.find("initialState"), *place) == [-102.5, 0.0, 0.0, 30.0]
        states = pov.findall("trajectory/state")
        assert [numbers(state, "time/exact", *place) for state in states] == [
            [1.0, -99.5, 0.0, 0.0, 30.0],
            [2.0, -96.5, 0.0, 0.0, 30.0],
        ]
        # The ramp runs straight from (-420, -65) to M, and is drawn as long as it is driven.
        heading = math.atan2(65.0, 420.0)
        back_m = 182.0 * math.hypot(420.0, 65.0) / 425.0 + 2.5
        x, y, angle, v = numbers(vut.find("initialState"), *place)
        assert (x, y) == pytest.approx(
            (-back_m * math.cos(heading), -back_m * math.sin(heading)), abs=1e-3
        )
        assert (angle, v) == pytest.approx((heading, 18.0), abs=1e-9)

    def test_has_the_lanes_of_both_paths_and_how_they_go_on(self):
        root = etree.fromstring(commonroad(episode(), road_for(US23), number=1, source="mine"))
        inner, outer, ramp = root.findall("lanelet")
        bounds = [
            [numbers(p, "x", "y") for p in inner.findall(f"{side}/point")]
            for side in ("leftBound", "rightBound")
        ]
        assert bounds == [[[-1000.0, 1.6], [0.0, 1.6]], [[-1000.0, -1.6], [0.0, -1.6]]]
        for lane in (inner, ramp):
            assert [one.get("ref") for one in lane.findall("successor")] == [outer.get("id")]
        assert {one.get("ref") for one in outer.findall("predecessor")} == {
            inner.get("id"),
            ramp.get("id"),
        }
        assert ramp.findtext("laneletType") == "accessRamp"

    def test_of_an_acceleration_lane_says_which_lane_is_beside_it(self):
        scenario = named_scenario("us23-lane")
        road = road_for(scenario)
        root = etree.fromstring(commonroad(episode(scenario), road, number=1, source="mine"))
        assert [
            (lane.findtext("laneletType"), side.tag)
            for lane in root.findall("lanelet")
            for side in lane
            if side.tag.startswith("adjacent")
        ] == [("mainCarriageWay", "adjacentRight"), ("accessRamp", "adjacentLeft")]

    def test_that_is_free_has_no_vut_but_its_start(self):
        road = road_for(US23)
        made = [
            etree.fromstring(commonroad(episode(), road, number=1, source="x", free=free))
            for free in (False, True)
        ]
        numbered = [[o.get("id") for o in root.findall("dynamicObstacle")] for root in made]
        assert numbered[1] == [one for row, one in enumerate(numbered[0]) if row != VUT]
        starts = [root.find("planningProblem/initialState") for root in made]
        assert numbers(starts[1], "velocity/exact", "yawRate/exact") == [18.0, 0.0]
        assert len({etree.tostring(start) for start in starts}) == 1
        assert made[1].findtext("planningProblem/goalState/time/intervalEnd") == "300"

    def test_of_one_straight_lane_has_lane_coordinates_as_x(self):
        root = etree.fromstring(commonroad(episode(), straight_road(US23), number=1, source="x"))
        for obstacle, x_m in zip(root.findall("dynamicObstacle"), (-102.5, -184.5), strict=True):
            x, y = numbers(obstacle, "initialState/position/point/x", ".//point/y")
            assert (x, y) == pytest.approx((x_m, 0.0), abs=0.02)


def test_commonroad_reads_what_is_exported(run, tmp_path):
    """The reader and the schema of CommonRoad, in an environment of their own: `.ci/commonroad`."""
    python = os.environ.get("COMMONROAD_PYTHON")
    if python is None:
        pytest.skip("COMMONROAD_PYTHON names no Python with commonroad-io: .ci/commonroad")
    write_commonroad(run, 3, tmp_path / "case", road_for(US23))
    files = [*(tmp_path / "case").iterdir()]
    for name in shipped_scenarios():
        scenario = named_scenario(name)
        file = tmp_path / f"{name}.xml"
        file.write_bytes(
            commonroad(episode(scenario), road_for(scenario), number=1, source="<&> ä")
        )
        files.append(file)
    done = subprocess.run(
        [python, str(CHECK), *map(str, files)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("valid") == len(files)
