"""Merges in nets that are not ours: found, drawn where SUMO draws them, and driven by eq. (4)."""

# mypy: no-strict-optional

from __future__ import annotations

import math
import re
from dataclasses import replace

import pytest
from support.foreign_nets import FOREIGN, edge, lane, node, plain, straight

from merge_sumo.errors import UserError
from merge_sumo.road.finder import RoadNet, find_road, read_net
from merge_sumo.road.loader import road_for
from merge_sumo.road.road import LanePath, Piece
from merge_sumo.scenario.scenario import US23
from merge_sumo.sumo.binding import load_libsumo
from merge_sumo.sumo.sumo_simulation import SumoSimulation


@pytest.mark.parametrize("name", FOREIGN)
def test_a_point_of_a_path_is_where_sumo_draws_its_lane(built_road, name):
    road = built_road(name)
    libsumo = load_libsumo()
    libsumo.start(["sumo", "-n", str(road.path), "--no-step-log", "--no-warnings"])
    compared = 0
    try:
        for path in (road.mainline, road.ramp):
            for piece, following in zip(path.pieces, [*path.pieces[1:], None], strict=True):
                changes = road.lane_drop and following and following.start_m == 0.0
                length_m = libsumo.lane.getLength(piece.lane)
                if changes and piece.is_internal:
                    continue  # one of both is next to the lane of the file
                name_of_edge, _, index = piece.lane.rpartition("_")
                for share in (0.0, 0.3, 0.71, 1.0):
                    x, y = libsumo.simulation.convert2D(name_of_edge, share * length_m, int(index))
                    at = piece.point(share * length_m)
                    assert math.dist((x, y), at[:2]) < 1e-5
                    compared += 1
    finally:
        libsumo.close()
    assert compared >= 20


BEND = Piece("a_0", -140.0, 140.0, 30.0, ((0, 0, 0), (30, 0, 0), (30, 40, 0)))
"""A lane of which 70 m are drawn for 140 m that are driven."""


def test_a_lane_point_by_hand():
    assert BEND.point(0.0) == (0.0, 0.0, 90.0)
    assert BEND.point(20.0) == (10.0, 0.0, 90.0)
    assert BEND.point(100.0) == pytest.approx((30.0, 20.0, 0.0))
    assert BEND.point(140.0) == pytest.approx((30.0, 40.0, 0.0))


def test_a_body_has_both_bumpers_on_its_lane_by_hand():
    # 3 m past the corner of a right angle, with a body of 7 m: its rear is 4 m before the corner.
    path = LanePath((replace(BEND, start_m=-70.0, length_m=70.0),))
    at = replace(road_for(US23), ramp=path).front_bumper(-37.0, 7.0, on_ramp=True)
    assert at[2:] == pytest.approx((30.0, 3.0, math.degrees(math.atan2(4.0, 3.0))))


def test_the_nearest_place_of_a_path_by_hand():
    path = LanePath((BEND,))
    assert path.nearest(10.0, -2.0) == pytest.approx((2.0, -120.0))
    assert path.nearest(33.0, 20.0) == pytest.approx((3.0, -40.0))
    assert path.nearest(-3.0, 4.0) == pytest.approx((5.0, -140.0))
    assert path.nearest(31.0, -1.0) == pytest.approx((math.sqrt(2.0), -80.0))


@pytest.mark.parametrize(
    ("name", "lane_drop_found", "mainline", "ramp"),
    [
        ("curved", False, ("M", False), ("m", True)),
        ("zipper", False, ("Z", True), ("Z", True)),
        ("lane drop", True, ("M", False), ("m", True)),
        ("OSM", True, ("M", False), ("m", True)),
    ],
)
def test_the_junction_at_m_says_who_goes_first(built_road, name, lane_drop_found, mainline, ramp):
    road = built_road(name)
    assert road.lane_drop is lane_drop_found
    approaches = (road.mainline_approach, road.ramp_approach)
    assert [(a.state, a.yields) for a in approaches] == [mainline, ramp]


def test_lanes_that_cars_may_not_use_are_left_out(tmp_path):
    net = plain(
        tmp_path,
        node("a", -500, 0) + node("m", 0, 0) + node("b", 500, 0) + node("r", -300, -100),
        edge("in", "a", "m", 1, 30, priority=9, sidewalkWidth=2, bikeLaneWidth=1)
        + edge("out", "m", "b", 1, 30, priority=9, sidewalkWidth=2, bikeLaneWidth=1)
        + edge("r", "r", "m", 1, 20, priority=3),
    )
    road = find_road(read_net(net), ["in", "out"], ["r", "out"])
    assert [piece.lane for piece in road.mainline.pieces] == ["in_2", ":m_2_1", "out_2"]


def test_a_start_before_the_path_is_refused(built_road):
    with pytest.raises(UserError, match=r"ramp main_out begins 425.0 m before .* edge upstream"):
        road_for(replace(US23, x_vut0_m=-600.0))
    with (
        SumoSimulation(1, built_road("priority"), scenario=US23) as simulation,
        pytest.raises(UserError, match=r"begins 505\.94 m before"),
    ):
        simulation.place(0, [(-340.0, 30.0), (-600.0, 12.0)])


@pytest.fixture(scope="module")
def straight_net(tmp_path_factory) -> RoadNet:
    return read_net(straight(tmp_path_factory.mktemp("net"), "priority"))


@pytest.mark.parametrize(
    ("mainline", "ramp", "message"),
    [
        ("in out", "r9 out", r"has no edge r9: name edges"),
        ("in out", ":m_0 out", "has no edge :m_0"),
        ("in", "r0", "never meet: end both with the edge after the merge point"),
        ("out out2", "r1 out", "mainline or ramp begins with edge out, .*: name an edge before it"),
        ("in r1 out", "r0 out", "edge in does not lead to edge r1"),
        ("in out out2", "r1 out in", "after edge out the mainline continues on out2 and the ramp"),
    ],
)
def test_edges_without_a_merge_are_refused_in_one_sentence(straight_net, mainline, ramp, message):
    with pytest.raises(UserError, match=message) as error:
        find_road(straight_net, mainline.split(), ramp.split())
    assert "\n" not in str(error.value)
    assert str(straight_net.path) in str(error.value)


def test_an_acceleration_lane_over_two_edges_with_an_exit(tmp_path):
    net = plain(
        tmp_path,
        node("a", -800, 0) + node("n", -300, 0) + node("k", 0, 0) + node("d", 200, 0)
        + node("b", 700, 0) + node("r", -500, -90) + node("x", 300, -100),
        edge("in", "a", "n", 2, 36, priority=9) + edge("acc", "n", "k", 3, 36, priority=9)
        + edge("mid", "k", "d", 3, 36, priority=9) + edge("out", "d", "b", 2, 36, priority=9)
        + edge("exit", "d", "x", 1, 20) + edge("ramp", "r", "n", 1, 22, priority=3),
        lane("in", 0, "acc", 1) + lane("in", 1, "acc", 2) + lane("ramp", 0, "acc", 0)
        + lane("mid", 0, "exit", 0) + lane("mid", 1, "out", 0) + lane("mid", 2, "out", 1),
    )  # fmt: skip
    with pytest.raises(UserError, match="no lane in common up to the end of edge mid"):
        find_road(read_net(net), ["in", "acc", "mid"], ["ramp", "acc", "mid"])
    road = find_road(read_net(net), ["in", "acc", "mid", "out"], ["ramp", "acc", "mid", "out"])
    assert road.acceleration_lane.lanes == ("acc_0", "mid_0")


def edited(old: str, new: str):
    def edit(text: str) -> str:
        assert re.search(old, text)
        return re.sub(old, new, text, count=1)

    return edit


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda text: text[:500], "not readable XML"),
        (lambda text: "<osm/>", "is not a SUMO net: .* convert a map with netconvert"),
        (lambda text: "<net/>", "<net> in line 1 has a missing or wrong value .*version"),
        (edited(r'(id="r1_0" .*)length="[\d.]+"', r'\1length="nan"'), "r1_0 has nan, not within"),
        (edited(r'(id="r1_0" .*)shape="[^"]*"', r'\1shape="1,1 1,1"'), "r1_0 has no length"),
        (edited(r'(id="r1_0" .*)shape="[^"]*"', r'\1shape="1,1 9e9,1"'), "not within 2e.07"),
        (edited(r'(id="r1_0" .*)shape="[^"]*"', r'\1shape="here"'), "<lane> in line .*'here'"),
        (edited(r'(id="r1_0" index="0" )', r'\1disallow="all" '), "no lane of edge r1 is open"),
        (edited(r'(<connection from="r1" .*)via="[^"]*"', r'\1via=":x_0"'), "not a valid .*':x'"),
        (edited('(<edge id="r1" .*)to="m"', r"\1"), "not a valid SUMO net"),
        (edited('(<junction id="m" .*) x="[^"]*"', r'\1 x="far"'), "<junction> in line .*'far'"),
        (lambda text: text.replace("<request ", "<phase "), "not a valid SUMO net"),
        (lambda text: text.replace("junction", "param"), "not a valid SUMO net"),
    ],
)
def test_a_broken_net_is_refused_in_one_sentence(straight_net, tmp_path, edit, message):
    path = tmp_path / "broken.net.xml"
    path.write_text(edit(straight_net.path.read_text()))
    with pytest.raises(UserError, match=message) as error:
        find_road(read_net(path), ["in", "out"], ["r1", "out"])
    assert "\n" not in str(error.value)
