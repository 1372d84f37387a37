"""The shipped road: exact lane coordinates around M, and nets that their sources build."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from merge_sumo.road.loader import default_net_path, road_of

ROOT = Path(__file__).resolve().parents[2]


def test_the_shipped_nets_are_what_their_sources_build(tmp_path):
    tool = ROOT / "tools" / "build_net.py"
    subprocess.run([sys.executable, tool, "--out", tmp_path], check=True, capture_output=True)
    built = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert built == {path.name: path.read_bytes() for path in (ROOT / "sumo_net").glob("*.net.xml")}
    assert default_net_path().name in built


def test_the_merge_point_is_the_origin_of_all_lanes():
    road = road_of()
    for path in (road.mainline, road.ramp):
        before, after = path.pieces
        assert before.shape[-1][:2] == after.shape[0][:2] == (0.0, 0.0)


def test_the_ramp_comes_nearer_than_the_width_of_a_car_in_its_last_metres_only():
    """A line with sides of 119 and 408 m and a length of 425 m: 0.28 m aside in a metre."""
    ramp = road_of().ramp
    assert ramp.point(-425.0)[1:4] == (0.0, -408.0, -119.0)
    assert ramp.point(-100.0)[2:4] == pytest.approx((-96.0, -28.0))
    assert ramp.point(-1.8 / 0.28).y_m == pytest.approx(-1.8)
