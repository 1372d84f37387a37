"""The shipped road: exact lane coordinates around M, and nets that their sources build."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import pytest

from merge_sumo.road.corridor import Corridor
from merge_sumo.road.merge import default_net_path, road_of

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def road() -> Corridor:
    return road_of()


def test_the_shipped_nets_are_what_their_sources_build(tmp_path):
    tool = ROOT / "tools" / "build_net.py"
    subprocess.run([sys.executable, tool, "--out", tmp_path], check=True, capture_output=True)
    built = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert built == {path.name: path.read_bytes() for path in (ROOT / "sumo_net").glob("*.net.xml")}
    assert default_net_path().name in built


class TestTheShippedRoad:
    def test_has_the_merge_point_as_origin_of_all_lanes(self, road):
        for path in (road.mainline, road.ramp):
            before, behind = path.pieces
            assert before.shape[-1][:2] == behind.shape[0][:2] == (0.0, 0.0)

    @pytest.mark.parametrize("on_ramp", [False, True])
    def test_puts_a_lane_coordinate_at_its_distance_from_the_merge_point(self, road, on_ramp):
        for x_m in (-340.0, -182.0, -1e-6, 0.0, 1e-6, 25.0):
            lane, position, x, y, _ = road.lane_point(x_m, on_ramp=on_ramp)
            assert math.hypot(x, y) == pytest.approx(abs(x_m), abs=1e-9)
            before = "ramp_0" if on_ramp else "main_in_0"
            assert lane == (before if x_m < 0 else "main_out_0")
            length = {"ramp_0": 425.0, "main_in_0": 1000.0, "main_out_0": 0.0}[lane]
            assert position == pytest.approx(length + x_m, abs=1e-9)
