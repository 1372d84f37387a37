"""Episodes on roads that are not ours: replayed, exported, drawn, and driven over TraCI."""

# mypy: no-strict-optional

from __future__ import annotations

import gzip
import math
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from lxml import etree
from support.foreign_nets import FOREIGN, LANES, lane_corridor_of
from support.handmade import write_run

from merge_sumo import api
from merge_sumo.errors import UserError
from merge_sumo.metrics.measures import Measures
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.reports.exports import write_openscenario
from merge_sumo.road.drawing import road_data
from merge_sumo.road.merge import default_net_path, road_of
from merge_sumo.road.xml_input import MAX_BYTES
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import DT_S, US23
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.sumo import mirror
from merge_sumo.sumo.opendrive import opendrive
from merge_sumo.sumo.replay import replay
from merge_sumo.sumo.replay_folder import HOLD_STEPS, write_scenario
from merge_sumo.sumo.world import World

LANE_WIDTH_M = 3.2


def commanded(a_mps2: np.ndarray, road) -> Trajectory:
    """Return the motion of eq. (4) under accelerations, (steps, 2); no speed falls below 0."""
    far_m = (road.mainline.before_m, road.ramp.before_m)
    case = Case(level=0, x_pov0_m=-300.0, v_pov0_mps=30.0, scenario=US23)
    x, v = -np.minimum([-case.x_pov0_m, 182.0], far_m), np.array([case.v_pov0_mps, case.v_vut0_mps])
    rows = []
    for wanted in a_mps2:
        a = np.maximum(wanted, -v / DT_S)
        rows.append([x[0], v[0], a[0], x[1], v[1], a[1]])
        x, v = x + v * DT_S, np.maximum(v + a * DT_S, 0.0)
    rows.append([x[0], v[0], 0.0, x[1], v[1], 0.0])
    return Trajectory(case, np.array(rows).reshape(-1, 2, 3), End.TIMEOUT)


STEPS = 300
RANDOM = np.random.default_rng(0).uniform(US23.a_min_mps2, US23.a_max_mps2 + 1.5, (STEPS, 2))
STANDS_THEN_GOES = np.array([(2.0, -4.0 if step < 120 else 2.0) for step in range(STEPS)])


def write(folder: Path, road, trajectory: Trajectory) -> Path:
    write_scenario(
        folder, road, Outcome(0, 0, trajectory.case, Measures.of(trajectory)), trajectory
    )
    return folder


def assert_identical(folder: Path, steps: int) -> None:
    result = replay(folder)
    assert (result.diverged_at_s, result.detail) == (None, "")
    assert result.rows == 2 * (steps + 1 + HOLD_STEPS)


class TestAReplay:
    @pytest.mark.parametrize("name", FOREIGN)
    def test_of_any_motion_is_identical_also_behind_the_end_of_the_net(
        self, corridor, tmp_path, name
    ):
        road = corridor(name)
        for number, accelerations in enumerate((RANDOM, STANDS_THEN_GOES)):
            trajectory = commanded(accelerations, road)
            assert_identical(write(tmp_path / str(number), road, trajectory), STEPS)
        assert (trajectory.v_vut_mps == 0.0).sum() > 50
        assert trajectory.x_pov_m[-1] > 1400.0
        assert trajectory.x_vut_m[-1] > 0.0


def lane_centres(road_file: Path) -> np.ndarray:
    """Return the centres of all lanes of an OpenDRIVE file as segments, (n, 2, 2).

    Reads what netconvert writes: lines and cubic curves, lanes of constant width.
    """
    segments = []
    for road in etree.parse(road_file).findall("road"):
        places = []
        for geometry in road.findall("planView/geometry"):
            x, y, heading, length = (float(geometry.get(n)) for n in ("x", "y", "hdg", "length"))
            curve = geometry.find("paramPoly3")
            for share in np.linspace(0.0, 1.0, 2 if curve is None else 40):
                u, v, du, dv = share * length, 0.0, 1.0, 0.0
                if curve is not None:
                    u, v = (poly(curve, axis, share) for axis in "UV")
                    du, dv = (slope(curve, axis, share) for axis in "UV")
                c, s = math.cos(heading), math.sin(heading)
                at = np.array([x + c * u - s * v, y + s * u + c * v])
                ahead = np.array([c * du - s * dv, s * du + c * dv])
                places.append((at, ahead / np.linalg.norm(ahead)))
        shift = road.find("lanes/laneOffset")
        offset = 0.0 if shift is None else float(shift.get("a"))
        for section in road.findall("lanes/laneSection"):
            across = offset
            for lane in sorted(section.findall("right/lane"), key=lambda e: -int(e.get("id"))):
                width = float(lane.find("width").get("a"))
                centre = across - width / 2.0
                across -= width
                line = [at + centre * np.array([-d[1], d[0]]) for at, d in places]
                segments += list(pairwise(line))
    return np.array(segments)


def poly(curve, axis: str, p: float) -> float:
    return sum(float(curve.get(f"{n}{axis}")) * p**k for k, n in enumerate("abcd"))


def slope(curve, axis: str, p: float) -> float:
    return sum(float(curve.get(f"{n}{axis}")) * k * p ** (k - 1) for k, n in enumerate("abcd") if k)


def distance(segments: np.ndarray, x: float, y: float) -> float:
    begin, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    to = np.array([x, y]) - begin
    share = np.clip((to * along).sum(1) / np.maximum((along**2).sum(1), 1e-12), 0.0, 1.0)
    return float(np.linalg.norm(to - share[:, None] * along, axis=1).min())


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("exports") / "run", per_level=3)


class TestAnExport:
    @pytest.mark.parametrize("name", FOREIGN)
    def test_to_openscenario_lies_on_the_lanes_of_its_opendrive(
        self, made, corridor, tmp_path, name
    ):
        road = corridor(name)
        scenario = write_openscenario(made, 0, tmp_path / "case", road)
        tree = etree.parse(scenario)
        road_file = tree.find(".//RoadNetwork/LogicFile").get("filepath")
        segments = lane_centres(tmp_path / "case" / road_file)
        # Where a lane ends, OpenDRIVE has no way from it to the next lane.
        crossing_m = road.ramp.pieces[-2].length_m if road.lane_drop else 0.0
        compared = 0
        for who, column in (("pov", 0), ("vut", 1)):
            vertices = tree.findall(f".//Trajectory[@name='{who} recorded']//Vertex")
            motion = made.trajectory(0).motion[:, column, 0].tolist()
            assert len(vertices) == len(motion)
            for vertex, x_m in zip(vertices, motion, strict=True):
                place = vertex.find("Position/WorldPosition")
                off_m = distance(segments, float(place.get("x")), float(place.get("y")))
                beside = who == "vut" and -crossing_m <= x_m < 0.0
                assert off_m < (LANE_WIDTH_M if beside else 0.03), x_m
                compared += not beside
        assert compared > 150

    @pytest.mark.parametrize("name", LANES)
    def test_to_opendrive_has_both_lanes_of_a_merge(self, tmp_path, name):
        road = lane_corridor_of(name, tmp_path)
        begin_m, end_m = road.lane_m
        (tmp_path / "road.xodr").write_bytes(opendrive(road))
        segments = lane_centres(tmp_path / "road.xodr")
        for on_ramp in (False, True):
            for x_m in np.arange(max(begin_m, -200.0), end_m + 100.0, 1.7):
                at = road.lane_point(float(x_m), on_ramp=on_ramp)
                assert distance(segments, at.x_m, at.y_m) < 0.03, x_m
        entries = etree.parse(tmp_path / "road.xodr").findall(".//lane[@type='entry']")
        beside = [p for p in road.ramp.pieces if begin_m <= p.start_m < end_m and not p.is_internal]
        assert len(entries) == len(beside)


@pytest.mark.parametrize("name", ["curved", "zipper", "OSM"])
def test_the_report_draws_cars_where_they_are_with_m_as_origin_and_the_road_to_the_right(
    corridor, name
):
    road = corridor(name)
    drawn = road_data(road)
    m = road.lane_point(0.0, on_ramp=False)
    turn = math.radians(m.angle_deg - 90.0)
    for on_ramp, path in ((False, drawn["main"]), (True, drawn["ramp"])):
        along, x, y = np.array(path).T
        assert (np.diff(along) >= 0.0).all()
        for x_m in np.linspace(-180.0, 400.0, 59):
            at = road.lane_point(float(x_m), on_ramp=on_ramp)
            dx, dy = at.x_m - m.x_m, at.y_m - m.y_m
            turned = (
                dx * math.cos(turn) - dy * math.sin(turn),
                dx * math.sin(turn) + dy * math.cos(turn),
            )
            seen = np.interp(x_m, along, x), np.interp(x_m, along, y)
            assert seen == pytest.approx(turned, abs=0.05)
    assert np.interp(5.0, *np.array(drawn["main"]).T[:2]) == pytest.approx(5.0, abs=0.1)
    assert len(drawn["lanes"]) >= len(road.surroundings) + 4


def packed(text: str) -> bytes:
    return gzip.compress(text.encode(), mtime=0)


def replaced(old: str, new: str):
    def replace(text: str) -> bytes:
        assert old in text
        return text.replace(old, new).encode()

    return replace


FAR_EDGES = "".join(
    f'<edge id="x{n}" from="a{n}" to="b{n}"><lane id="x{n}_0" index="0" speed="9" length="9" '
    f'shape="0,{n} 9,{n}"/></edge>'
    for n in range(1250)
)
FAR_JUNCTIONS = "".join(
    f'<junction id="a{n}" type="dead_end" x="0" y="{n}" incLanes="" intLanes="" shape="0,0 0,1"/>'
    f'<junction id="b{n}" type="dead_end" x="9" y="{n}" incLanes="x{n}_0" intLanes="" '
    'shape="0,0 0,1"/>'
    for n in range(1250)
)
ODD = {
    "packed": packed,
    "of a town": lambda text: text.replace(
        '<junction id="M"', f'{FAR_EDGES}{FAR_JUNCTIONS}<junction id="M"'
    ).encode(),
    "of an older schema": replaced("http://sumo.dlr.de/", "http://sumo.sf.net/"),
    "with a long id": replaced('"ramp_start"', f'"cluster_{"1234567890_" * 60}"'),
    "with ids of other characters": replaced('"ramp_start"', '"Köln/A3(Süd)=[1]@2"'),
    "with a name of other characters": replaced('name="', 'name="A\u00a03\u200b'),
    "with a file of heights": replaced(
        'projParameter="!"', 'projParameter="+proj=utm +zone=32 +geoidgrids=egm96.gtx +no_defs"'
    ),
}


@pytest.mark.parametrize("name", ODD)
def test_a_net_that_is_taken_once_is_taken_by_every_kind_of_controller_and_export(tmp_path, name):
    path = tmp_path / "a.net.xml"
    path.write_bytes(ODD[name](default_net_path().read_text(encoding="utf-8")))
    road = road_of(path)
    assert (road.mainline, road.ramp) == (road_of().mainline, road_of().ramp)
    mirror.write_files(tmp_path, road, US23)
    assert b"main_out" in (tmp_path / mirror.NET).read_bytes()
    assert b"<road " in opendrive(road)
    with World(1, road, scenario=US23) as world:
        world.advance()


@pytest.mark.parametrize(
    ("name", "first"),
    [("priority", "the mainline goes first"), ("zipper", "neither road goes first")],
)
def test_a_road_says_who_goes_first_and_its_limits_behind_m(tmp_path, name, first):
    build, mainline, ramp = FOREIGN[name]
    net = build(tmp_path)
    text = re.sub(r'(id="out_\d" .*?speed=)"[\d.]+"', r'\1"1.39"', net.read_text())
    net.write_text(text)
    lines = api.new_scenario(tmp_path / "a.toml", net=net, mainline=mainline, ramp=ramp).lines()
    assert f"right of way: {first}" in lines
    assert all(
        re.search(r"limits: .* m/s from -\d.*, 1\.39 m/s from 0 m", line) for line in lines[1:3]
    )


class TestRoadOf:
    def test_finds_the_same_road_in_a_packed_net(self, tmp_path):
        (tmp_path / "us23.net.xml.gz").write_bytes(gzip.compress(default_net_path().read_bytes()))
        road = road_of(tmp_path / "us23.net.xml.gz")
        assert replace(road, path=default_net_path()) == road_of()

    @pytest.mark.parametrize(
        ("content", "said"),
        [
            (
                gzip.compress(b"<net>" + b" " * MAX_BYTES, mtime=0),
                "unpacked it is larger than",
            ),
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
        text = path.read_text()
        path.write_text(text.replace('speed="14.00"', 'speed="15.00"'))
        assert path.read_text() != text
        assert road_of(path, *edges).ramp.pieces[0].speed_limit_mps == 15.0
