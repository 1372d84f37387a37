"""Episodes on roads that are not ours: replayed, exported, drawn, and driven over TraCI."""

# mypy: no-strict-optional

from __future__ import annotations

import gzip
import math
import re
from pathlib import Path

import numpy as np
import pytest
from lxml import etree
from shapely import MultiLineString, Point
from support.foreign_nets import FOREIGN, LANES, foreign_lane_road
from support.handmade import write_run
from support.replays import assert_identical, commanded, write_replay

from merge_sumo import api
from merge_sumo.errors import UserError
from merge_sumo.reports.exports import write_openscenario
from merge_sumo.road.drawing import road_data
from merge_sumo.road.loader import default_net_path, road_of
from merge_sumo.road.xml_input import MAX_BYTES
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import US23
from merge_sumo.sumo import mirror
from merge_sumo.sumo.opendrive import opendrive
from merge_sumo.sumo.sumo_simulation import SumoSimulation

STEPS = 300
RANDOM = np.random.default_rng(0).uniform(US23.a_min_mps2, US23.a_max_mps2 + 1.5, (STEPS, 2))
STANDS_THEN_GOES = np.array([(2.0, -4.0 if step < 120 else 2.0) for step in range(STEPS)])


@pytest.mark.parametrize("name", FOREIGN)
def test_a_replay_of_any_motion_is_identical_also_after_the_end_of_the_net(
    built_road, tmp_path, name
):
    road = built_road(name)
    case = Case(level=0, x_pov0_m=-300.0, v_pov0_mps=30.0, scenario=US23)
    x_m = [-min(300.0, road.mainline.before_m), -min(182.0, road.ramp.before_m)]
    for number, accelerations in enumerate((RANDOM, STANDS_THEN_GOES)):
        trajectory = commanded(case, accelerations, x_m)
        assert_identical(write_replay(tmp_path / str(number), road, trajectory), STEPS + 1)
    assert (trajectory.v_vut_mps == 0.0).sum() > 50
    assert trajectory.x_pov_m[-1] > 1400.0
    assert trajectory.x_vut_m[-1] > 0.0


def lane_centres(road_file: Path) -> MultiLineString:
    """Return the centres of all lanes of an OpenDRIVE file.

    Reads the straight lines that netconvert writes, with lanes of constant width.
    """
    lines = []
    for road in etree.parse(road_file).findall("road"):
        shift = road.find("lanes/laneOffset")
        across = 0.0 if shift is None else float(shift.get("a"))
        for lane in sorted(road.iterfind(".//right/lane"), key=lambda e: -int(e.get("id"))):
            width = float(lane.find("width").get("a"))
            line = []
            for geometry in road.findall("planView/geometry"):
                x, y, heading, length = (
                    float(geometry.get(n)) for n in ("x", "y", "hdg", "length")
                )
                ahead = np.array([math.cos(heading), math.sin(heading)])
                left = np.array([-ahead[1], ahead[0]])
                begin = np.array([x, y]) + (across - width / 2.0) * left
                line += [begin, begin + length * ahead]
            lines.append(line)
            across -= width
    return MultiLineString(lines)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("exports") / "run", per_level=3)


class TestAnExport:
    @pytest.mark.parametrize("name", FOREIGN)
    def test_to_openscenario_lies_on_the_lanes_of_its_opendrive(
        self, made, built_road, tmp_path, name
    ):
        road = built_road(name)
        tree = etree.parse(write_openscenario(made, 0, tmp_path / "case", road))
        road_file = tree.find(".//RoadNetwork/LogicFile").get("filepath")
        centres = lane_centres(tmp_path / "case" / road_file)
        compared = 0
        for who, column in (("pov", 0), ("vut", 1)):
            vertices = tree.findall(f".//Trajectory[@name='{who} recorded']//Vertex")
            motion = made.trajectory(0).motion[:, column, 0].tolist()
            for vertex, x_m in zip(vertices, motion, strict=True):
                place = vertex.find("Position/WorldPosition")
                off_m = centres.distance(Point(float(place.get("x")), float(place.get("y"))))
                path = road.ramp if who == "vut" else road.mainline
                if not path.piece(x_m).is_internal:
                    assert off_m < 0.03, x_m
                    compared += 1
                elif not road.lane_drop or who == "pov":
                    assert off_m < 1.0, "netconvert draws its own ways over junctions"
        assert compared > 150

    @pytest.mark.parametrize("name", LANES)
    def test_to_opendrive_has_both_lanes_of_a_merge(self, tmp_path, name):
        road = foreign_lane_road(name, tmp_path)
        begin_m, end_m = road.used_lane_m
        (tmp_path / "road.xodr").write_bytes(opendrive(road))
        centres = lane_centres(tmp_path / "road.xodr")
        for on_ramp in (False, True):
            for x_m in np.arange(max(begin_m, -200.0), end_m + 100.0, 1.7):
                at = road.lane_point(float(x_m), on_ramp=on_ramp)
                if not at.lane.startswith(":"):
                    assert centres.distance(Point(at.x_m, at.y_m)) < 0.03, x_m
        entries = etree.parse(tmp_path / "road.xodr").findall(".//lane[@type='entry']")
        assert len(entries) == len(road.acceleration_lane.lanes)


@pytest.mark.parametrize("name", ["curved", "zipper", "OSM"])
def test_the_report_draws_cars_where_they_are_with_m_as_origin_and_the_road_to_the_right(
    built_road, name
):
    road = built_road(name)
    drawn = road_data(road)
    m = road.lane_point(0.0, on_ramp=False)
    turn = np.exp(-1j * math.radians(90.0 - m.angle_deg))
    for on_ramp, path in ((False, drawn["main"]), (True, drawn["ramp"])):
        along, x, y = np.array(path).T
        assert (np.diff(along) >= 0.0).all()
        for x_m in np.linspace(-180.0, 400.0, 59):
            at = road.lane_point(float(x_m), on_ramp=on_ramp)
            turned = complex(at.x_m - m.x_m, at.y_m - m.y_m) * turn
            seen = complex(np.interp(x_m, along, x), np.interp(x_m, along, y))
            assert abs(seen - turned) < 0.06
    assert np.interp(5.0, *np.array(drawn["main"]).T[:2]) == pytest.approx(5.0, abs=0.1)


ODD = [
    ('"ramp_start"', f'"cluster_{"1234567890_" * 60}"'),
    ('"ramp_start"', '"Köln/A3(Süd)=[1]@2"'),
    ('projParameter="!"', 'projParameter="+proj=utm +zone=32 +geoidgrids=egm96.gtx +no_defs"'),
]
"""Ids and a projection of a net, and odd ones."""


@pytest.mark.parametrize(("usual", "odd"), ODD)
def test_an_odd_net_is_taken_by_every_kind_of_controller_and_export(tmp_path, usual, odd):
    path, text = tmp_path / "a.net.xml.gz", default_net_path().read_text(encoding="utf-8")
    assert usual in text
    path.write_bytes(gzip.compress(text.replace(usual, odd).encode()))
    road = road_of(path)
    assert (road.mainline, road.ramp) == (road_of().mainline, road_of().ramp)
    mirror.write_files(tmp_path, road, US23)
    assert b"main_out" in (tmp_path / mirror.NET).read_bytes()
    assert b"<road " in opendrive(road)
    with SumoSimulation(1, road, scenario=US23) as simulation:
        simulation.advance()


@pytest.mark.parametrize(
    ("name", "order", "first"),
    [
        ("priority", 1, "the mainline has priority"),
        ("priority", -1, "the ramp has priority (did you swap mainline and ramp?)"),
        ("zipper", 1, "neither road has priority"),
    ],
)
def test_a_road_has_its_right_of_way_and_its_limits_after_m(tmp_path, name, order, first):
    build, *edges = FOREIGN[name]
    mainline, ramp = edges[::order]
    net = build(tmp_path)
    net.write_text(re.sub(r'(id="out_\d" .*?speed=)"[\d.]+"', r'\1"1.39"', net.read_text()))
    lines = api.new_scenario(tmp_path / "a.toml", net=net, mainline=mainline, ramp=ramp).lines()
    assert f"right of way: {first}" in lines
    for line in lines[1:3]:
        assert "lowest speed limit 1.39 m/s, highest " in line


class TestRoadOf:
    @pytest.mark.parametrize(
        ("content", "said"),
        [
            (gzip.compress(b"<net>" + b" " * MAX_BYTES, mtime=0), "unpacked it is larger than"),
            (
                gzip.compress(b"<net/>", mtime=0)[:-3],
                "cannot unpack the net .*: copy or pack it again",
            ),
            (b"\x1f\x8bmore", "cannot unpack the net .*: copy or pack it again"),
        ],
    )
    def test_refuses_what_cannot_be_unpacked(self, tmp_path, content, said):
        (tmp_path / "a.net.xml.gz").write_bytes(content)
        with pytest.raises(UserError, match=said):
            road_of(tmp_path / "a.net.xml.gz")

    def test_finds_a_merge_once_until_the_file_changes(self, tmp_path):
        path = FOREIGN["zipper"][0](tmp_path)
        edges = (["in", "out"], ["r0", "r1", "out", "out2"])
        first = road_of(path, *edges)
        assert road_of(path, *edges) is first
        path.write_text(path.read_text().replace('speed="14.00"', 'speed="15.00"'))
        assert road_of(path, *edges).ramp.pieces[0].speed_limit_mps == 15.0
