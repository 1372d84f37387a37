"""Merges in nets that are not ours: found, drawn where SUMO draws them, and driven by eq. (4)."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from foreign_nets import FOREIGN, edge, lane, node, plain, straight

from merge_sumo.errors import UserError
from merge_sumo.road.corridor import DRAWN_MIN_M, LanePath, Piece
from merge_sumo.road.finder import find_corridor
from merge_sumo.road.netfile import NetFile
from merge_sumo.scenario.scenario import DT_S, US23
from merge_sumo.sumo.binding import load_libsumo
from merge_sumo.sumo.hosting import hosted_paths
from merge_sumo.sumo.world import World

EXACT = 1e-9


@pytest.fixture(scope="module")
def straight_net(tmp_path_factory) -> NetFile:
    return NetFile(straight(tmp_path_factory.mktemp("net"), "priority"))


class Commander:
    """Drives the vehicles of a world with random accelerations and integrates eq. (4) itself."""

    def __init__(self, world, seed=0):
        self.world, self.rng = world, np.random.default_rng(seed)
        self.paths = (world.road.mainline, world.road.ramp)
        self.x_m = np.zeros((2, world.corridors))
        self.v_mps = np.zeros((2, world.corridors))
        self.left = np.zeros(world.corridors, dtype=int)
        self.episodes = self.stands = 0
        self.visited = set()

    def refill(self, k):
        """Begin an episode anywhere before M or shortly behind, at any speed."""
        for row, path in enumerate(self.paths):
            near, far = self.rng.uniform(-30, 60), -path.before_m * self.rng.random()
            self.x_m[row, k] = max(near if self.rng.random() < 0.3 else far, -path.before_m)
            self.v_mps[row, k] = self.rng.choice([0.0, self.rng.uniform(0, 45), 90.0])
        starts = zip(self.x_m[:, k].tolist(), self.v_mps[:, k].tolist(), strict=True)
        self.world.place(k, list(starts))
        self.left[k] = self.rng.integers(20, 120)
        self.episodes += 1

    def step(self):
        shape = self.x_m.shape
        drawn = self.rng.uniform(US23.a_min_mps2, US23.a_max_mps2, shape) * self.rng.integers(
            0, 2, shape
        )
        to_a_stand = self.rng.random(shape) < 0.02
        a = np.where(to_a_stand, -self.v_mps / DT_S, drawn)
        self.world.step(a)
        self.x_m = self.x_m + self.v_mps * DT_S
        self.v_mps = np.maximum(self.v_mps + a * DT_S, 0.0)
        self.stands += int((self.v_mps == 0.0).sum())
        self.left -= 1

    def worst(self):
        """Return how far SUMO's vehicles are from eq. (4), in metres or m/s."""
        off = np.abs(self.world.x_m - self.x_m).max(), np.abs(self.world.v_mps - self.v_mps).max()
        return max(off)


@pytest.mark.parametrize("name", FOREIGN)
def test_sumo_drives_300_random_episodes_by_eq_4_over_every_lane_of_the_paths(corridor, name):
    road = corridor(name)
    with World(16, road, scenario=US23) as world:
        commander = Commander(world)
        for k in range(16):
            commander.refill(k)
        while commander.episodes < 300:
            commander.step()
            assert commander.worst() < EXACT
            for k in np.flatnonzero((commander.left <= 0) | (commander.x_m.max(0) > 1700)).tolist():
                commander.refill(k)
                assert commander.worst() < EXACT
            commander.visited |= {world._get_lane(name) for name in world._ids}
    assert commander.stands > 100
    hosted = {lane for path in hosted_paths(road) for k in range(16) for lane in path.lanes(k)}
    kinds = {re.sub(r"\.\d+", "", lane) for lane in hosted}
    visited = {re.sub(r"\.\d+", "", lane) for lane in commander.visited}
    short = {
        re.sub(r"\.\d+", "", lane)
        for own, path in zip((road.mainline, road.ramp), hosted_paths(road), strict=True)
        for lane, piece in zip(path.lanes(0), own.pieces, strict=True)
        if piece.length_m < 1.0 or piece.start_m > 500.0
    }
    assert visited <= kinds
    assert kinds - visited <= short


@pytest.mark.parametrize("name", FOREIGN)
def test_a_point_of_a_path_is_where_sumo_draws_its_lane(corridor, name):
    road = corridor(name)
    libsumo = load_libsumo()
    libsumo.start(["sumo", "-n", str(road.path), "--no-step-log", "--no-warnings"])
    compared = 0
    try:
        for path in (road.mainline, road.ramp):
            for piece, following in zip(path.pieces, [*path.pieces[1:], None], strict=True):
                beside = road.lane_drop and following and following.start_m == 0.0
                length_m = libsumo.lane.getLength(piece.lane)
                if beside and piece.is_internal:
                    continue  # one of both is beside the lane that the file has
                name_of_edge, _, index = piece.lane.rpartition("_")
                for share in (0.0, 0.3, 0.71, 1.0):
                    x, y = libsumo.simulation.convert2D(name_of_edge, share * length_m, int(index))
                    at = piece.point(share * length_m)
                    assert math.dist((x, y), at[:2]) < 1e-5
                    compared += 1
    finally:
        libsumo.close()
    assert compared >= 20


@pytest.mark.parametrize("name", FOREIGN)
def test_coordinates_and_the_drawing_go_on_from_lane_to_lane(corridor, name):
    for path in (corridor(name).mainline, corridor(name).ramp):
        for one, other in zip(path.pieces, path.pieces[1:], strict=False):
            assert one.start_m + one.length_m == pytest.approx(other.start_m, abs=1e-9)
            end, begin = one.point(one.length_m)[:2], other.point(0.0)[:2]
            assert math.dist(end, begin) < 1e-3
        assert path.pieces[-1].start_m + path.pieces[-1].length_m == pytest.approx(2000.0)


def test_a_lane_point_by_hand():
    bend = ((0.0, 0.0, 0.0), (30.0, 0.0, 0.0), (30.0, 40.0, 0.0))
    piece = Piece("a_0", -140.0, 140.0, 30.0, bend)  # 70 m drawn for 140 m driven
    assert piece.point(0.0) == (0.0, 0.0, 90.0)
    assert piece.point(20.0) == (10.0, 0.0, 90.0)
    assert piece.point(100.0) == pytest.approx((30.0, 20.0, 0.0))
    assert piece.point(140.0) == pytest.approx((30.0, 40.0, 0.0))


def test_the_nearest_place_of_a_path_by_hand():
    bend = ((0.0, 0.0, 0.0), (30.0, 0.0, 0.0), (30.0, 40.0, 0.0))
    path = LanePath((Piece("a_0", -140.0, 140.0, 30.0, bend),))
    assert path.nearest(10.0, -2.0) == pytest.approx((2.0, -120.0))
    assert path.nearest(33.0, 20.0) == pytest.approx((3.0, -40.0))
    assert path.nearest(-3.0, 4.0) == pytest.approx((5.0, -140.0))
    assert path.nearest(31.0, -1.0) == pytest.approx((math.sqrt(2.0), -80.0))


@pytest.mark.parametrize("name", FOREIGN)
def test_the_nearest_place_to_a_point_of_a_path_is_the_points(corridor, name):
    road = corridor(name)
    for path in (road.mainline, road.ramp):
        x_m = np.arange(-path.before_m, path.after_m, 0.7)
        away_m, nearest_m = np.transpose([path.nearest(*path.point(x)[2:4]) for x in x_m])
        assert max(away_m) < 1e-9
        off_m = np.sort(np.abs(nearest_m - x_m))
        # Lanes that are drawn as one point have one place.
        assert off_m[-1] < DRAWN_MIN_M
        assert off_m[-3] < 1e-6


def test_behind_the_end_of_the_file_the_road_goes_straight_on(corridor):
    road = corridor("zipper")
    at, far = (road.lane_point(x_m, on_ramp=True) for x_m in (1200.0, 1900.0))
    assert at.lane == far.lane == "out2_0"
    assert far.angle_deg == at.angle_deg
    assert math.dist(at[2:4], far[2:4]) == pytest.approx(700.0, abs=0.1)


@pytest.mark.parametrize(
    ("name", "lane_drop_found", "mainline", "ramp"),
    [
        ("curved", False, ("M", False), ("m", True)),
        ("zipper", False, ("Z", True), ("Z", True)),
        ("lane drop", True, ("M", False), ("m", True)),
        ("OSM", True, ("M", False), ("m", True)),
    ],
)
def test_the_junction_at_m_says_who_goes_first(corridor, name, lane_drop_found, mainline, ramp):
    road = corridor(name)
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
    road = find_corridor(NetFile(net), ["in", "out"], ["r", "out"])
    assert [piece.lane for piece in road.mainline.pieces] == ["in_2", ":m_2_1", "out_2"]


def test_a_start_before_the_path_is_refused(corridor):
    road = corridor("priority")
    road.check_room(mainline_m=340.0, ramp_m=182.0)
    with pytest.raises(UserError, match=r"ramp \(r0 r1 out\) begins 505.9 m before .* further up"):
        road.check_room(mainline_m=340.0, ramp_m=600.0)
    with (
        World(1, road, scenario=US23) as world,
        pytest.raises(UserError, match=r"begins 505\.94 m before"),
    ):
        world.place(0, [(-340.0, 30.0), (-600.0, 12.0)])


@pytest.mark.parametrize(
    ("mainline", "ramp", "said"),
    [
        ("in out", "r9 out", "has no edge r9: did you mean r[01] or r[01]"),
        ("in :m_0", "r1 out", "has no edge :m_0"),
        ("in out", "r1", 'never meet; both lead to edge out: name "in out" and "r1 out"'),
        ("in", "r0", 'never meet; both lead to edge out: name "in out" and "r0 r1 out"'),
        ("out", "out2", "never meet; the mainline leads to edge out2.*: the net has no other$"),
        ("in r1 out", "r0 out", "edge in does not lead to edge r1; r0 do"),
        ("in out", "r0 out", "edge r0 does not lead to edge out; in and r1 do"),
        ("out out2", "r1 out", "mainline begins with edge out, which the other path uses too"),
        ("in out", "out out2", "ramp begins with edge out.*before it: r1$"),
        ("out", "r1", "ramp leads to edge out, with which the mainline begins: .*before it: in$"),
        ("in out out2", "r1 out in", "behind edge out the mainline goes to out2 and the ramp to"),
        ("", "r1 out", "never meet"),
    ],
)
def test_what_is_no_merge_is_refused_in_one_sentence(straight_net, mainline, ramp, said):
    with pytest.raises(UserError, match=said) as error:
        find_corridor(straight_net, mainline.split(), ramp.split())
    assert "\n" not in str(error.value)
    assert str(straight_net.path) in str(error.value)


NAMED = [
    (
        *("in acc", "ramp acc"),
        "the ramp's lane leads to exit or mid and the mainline's to mid; name the edges that "
        "follow on both: mid out",
    ),
    (
        *("in acc mid", "ramp acc mid"),
        "the ramp's lane leads to no edge and the mainline's to out; name the edge that follows on "
        "both: out",
    ),
    (
        *("back acc", "ramp acc"),
        "up to 5 edges on they come to no common lane, so no merge is needed there",
    ),
    ("in", "ramp", 'both lead to edge acc: name "in acc" and "ramp acc"'),
    ("exit", "out", ", nor do they within 5 edges more"),
    ("acc mid", "ramp acc mid", "name an edge before it: in"),
]


@pytest.mark.parametrize(("mainline", "ramp", "said"), NAMED)
def test_what_is_named_to_follow_on_both_leads_to_a_merge(tmp_path, mainline, ramp, said):
    """An acceleration lane over two edges, with an exit and with places to turn back."""
    net = NetFile(
        plain(
            tmp_path,
            node("a", -800, 0) + node("n", -300, 0) + node("k", 0, 0) + node("d", 200, 0)
            + node("b", 700, 0) + node("r", -500, -90) + node("x", 100, -100),
            edge("in", "a", "n", 2, 36, priority=9) + edge("acc", "n", "k", 3, 36, priority=9)
            + edge("mid", "k", "d", 3, 36, priority=9) + edge("out", "d", "b", 2, 36, priority=9)
            + edge("back", "k", "n", 1, 36) + edge("exit", "k", "x", 1, 20)
            + edge("ramp", "r", "n", 1, 22, priority=3),
            lane("in", 0, "acc", 1) + lane("in", 1, "acc", 2) + lane("ramp", 0, "acc", 0)
            + lane("mid", 1, "out", 0) + lane("mid", 2, "out", 1),
        )
    )  # fmt: skip
    assert net.content.count(b'dir="t"') == 4
    with pytest.raises(UserError, match=re.escape(said)):
        find_corridor(net, mainline.split(), ramp.split())
    road = find_corridor(net, ["in", "acc", "mid", "out"], ["ramp", "acc", "mid", "out"])
    found = road.acceleration_lane
    assert found is not None
    assert (found.lanes, found.exits) == (("acc_0", "mid_0"), ())


def edited(old: str, new: str):
    def edit(text: str) -> str:
        assert re.search(old, text)
        return re.sub(old, new, text, count=1)

    return edit


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (lambda text: text[:500], "not readable XML"),
        (lambda text: "<routes/>", "is no SUMO net: it does not begin with <net>"),
        (lambda text: "<osm/>", "make one of it: `netconvert --osm-files .* -o NAME.net.xml`"),
        (
            edited(r'(id="r1_0" .*)length="[\d.]+"', r'\1length="far"'),
            "r1_0 whose length is",
        ),
        (
            edited(r'(id="r1_0" .*)length="[\d.]+"', r'\1length="nan"'),
            "r1_0 whose length is",
        ),
        (edited(r'(id="r1_0" .*)length="[\d.]+"', r'\1length="0"'), "r1_0 has no length"),
        (edited(r'(id="r1_0" .*)shape="[^"]*"', r'\1shape="1,1 1,1"'), "r1_0 has no length"),
        (
            edited(r'(id="r1_0" .*)shape="[^"]*"', r'\1shape="here"'),
            "r1_0 whose shape is",
        ),
        (edited(r'(id="r1_0" index="0" )', r'\1disallow="all" '), "no lane of edge r1 is open"),
        (edited(r'(<connection from="r1" [^>]*)via="[^"]*"', r'\1via=":x_0"'), "over lane :x_0"),
        (edited(r'<connection from="r1" [^>]*/>', ""), "edge r1 does not lead to edge out; in do"),
        (edited('<junction id="m" type="priority"', '<junction id="m" type="x"'), "of type x"),
        (edited('(<junction id="m" .*)incLanes="[^"]*"', r"\1"), "no junction at the end of lane"),
        (
            edited('(<junction id="m" .*) x="[^"]*"', r'\1 x="far"'),
            "junction m whose x is",
        ),
    ],
)
def test_a_broken_net_is_refused_in_one_sentence(straight_net, tmp_path, edit, said):
    path = tmp_path / "broken.net.xml"
    path.write_text(edit(straight_net.content.decode()))
    with pytest.raises(UserError, match=said) as error:
        find_corridor(NetFile(path), ["in", "out"], ["r1", "out"])
    assert "\n" not in str(error.value)
