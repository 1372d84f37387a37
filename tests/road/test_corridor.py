"""Merges in nets that are not ours: found, drawn where SUMO draws them, and driven by eq. (4)."""

from __future__ import annotations

import math
import pickle
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
from foreign_nets import ALL, AUXILIARY, edge, lane_drop, node, plain, straight
from plans import POVS

from merge_sumo.engine.povs import PovLibrary
from merge_sumo.engine.rollout import rollout
from merge_sumo.errors import UserError
from merge_sumo.road.corridor import Piece
from merge_sumo.road.finder import find_corridor
from merge_sumo.road.merge import default_net_path
from merge_sumo.road.netfile import NetFile
from merge_sumo.sumo.binding import SPEED_MODE_COMMANDED, load_libsumo, sumo_program
from merge_sumo.sumo.hosting import hosted_net, hosted_paths
from merge_sumo.sumo.world import SimulationError, World
from merge_sumo.values.case import from_unit
from merge_sumo.values.scenario import A_MAX_MPS2, A_MIN_MPS2, DT_S, POV, US23, VUT
from merge_sumo.vuts.registry import VutFactory

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
        drawn = self.rng.uniform(A_MIN_MPS2, A_MAX_MPS2, shape) * self.rng.integers(0, 2, shape)
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


@pytest.mark.parametrize("name", ALL)
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


@pytest.mark.parametrize("name", ALL)
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


def test_paths_are_as_long_as_their_lanes_and_those_of_the_junctions(corridor):
    road = corridor("curved")
    # 770 m and 420 m are given in the sources, and drawn shorter; 36.75 and 38.58 lie in between.
    assert road.mainline.before_m == pytest.approx(770.0 + 36.75)
    assert road.ramp.before_m == pytest.approx(420.0 + 38.58)
    assert road.drawn_after_m == pytest.approx(568.19)
    assert [piece.lane for piece in road.ramp.pieces] == ["slip_0", ":m_0_0", "out_0"]
    assert [piece.start_m for piece in road.mainline.pieces][1:] == [-36.75, 0.0]


@pytest.mark.parametrize("name", ALL)
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
        pytest.param(
            *("zipper with an auxiliary lane", False, ("Z", True), ("Z", True)),
            marks=pytest.mark.long,
        ),
        pytest.param(
            *("mainline that ends", True, ("m", True), ("M", False)), marks=pytest.mark.long
        ),
        pytest.param(*("traffic light", False, ("o", False), ("o", True)), marks=pytest.mark.long),
        pytest.param(*("left turn", False, ("M", False), ("m", True)), marks=pytest.mark.long),
    ],
)
def test_the_junction_at_m_says_who_goes_first(corridor, name, lane_drop_found, mainline, ramp):
    road = corridor(name)
    assert road.lane_drop is lane_drop_found
    approaches = (road.mainline_approach, road.ramp_approach)
    assert [(a.state, a.yields) for a in approaches] == [mainline, ramp]


@pytest.mark.parametrize("name", ["priority", "zipper"])
def test_sumo_sees_the_same_right_of_way_in_the_hosted_net(corridor, tmp_path, name):
    road = corridor(name)
    hosted = tmp_path / "hosted.net.xml"
    hosted.write_bytes(hosted_net(road, 2))
    libsumo = load_libsumo()
    seen = []
    for file, lanes in (
        (road.path, ("in_0", "r1_0")),
        (hosted, [path.lanes(1)[n] for path, n in zip(hosted_paths(road), (0, 2), strict=True)]),
    ):
        libsumo.start(["sumo", "-n", str(file), "--no-step-log", "--xml-validation", "never"])
        try:
            links = [libsumo.lane.getLinks(name)[0] for name in lanes]
            # Whether it has priority, its state, and the length of the lane inside the junction.
            seen.append([(link[1], link[5], link[7]) for link in links])
        finally:
            libsumo.close()
    assert seen[0] == seen[1]


def test_the_auxiliary_lane_of_a_lane_drop_leads_to_where_that_of_a_zipper_does(corridor, tmp_path):
    drop = corridor("lane drop")
    other = find_corridor(
        NetFile(lane_drop(tmp_path, "zipper")), ["in", "acc", "out"], ["ramp", "acc", "out"]
    )
    assert drop.ramp.pieces[-2].lane == drop.mainline.pieces[-2].lane == ":d_0_0"
    assert [p.lane for p in drop.ramp.pieces[:3]] == [p.lane for p in other.ramp.pieces[:3]]
    assert drop.ramp.before_m == pytest.approx(other.ramp.before_m, abs=0.5)
    middle = drop.lane_point(-4.0, on_ramp=True), drop.lane_point(-4.0, on_ramp=False)
    assert middle[0].y_m == pytest.approx(middle[1].y_m - 1.6, abs=0.01), "half a lane beside"


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


def foreign_us23(folder: Path) -> NetFile:
    """Return the shipped road with other names, elsewhere and turned by a quarter."""
    text = default_net_path().read_text()
    for ours, theirs in (
        ("main_in", "-4711#0"),
        ("main_out", "east&amp;west"),
        ("ramp", "1/2.0@x"),
    ):
        text = re.sub(rf"\b{ours}(?=[_\"])", theirs, text)

    def turned(found: re.Match[str]) -> str:
        points = (map(float, point.split(",")) for point in found[1].split())
        return f'shape="{" ".join(f"{7000 - y:.6f},{x - 300:.6f}" for x, y in points)}"'

    path = folder / "foreign.net.xml"
    path.write_text(re.sub(r'\bshape="([^"]*)"', turned, text))
    return NetFile(path)


@pytest.mark.parametrize("vut", ["design2", "sumo:IDM"])
def test_a_straight_foreign_net_with_the_lengths_of_us23_gives_its_very_outcomes(tmp_path, vut):
    road = find_corridor(foreign_us23(tmp_path), ["-4711#0", "east&west"], ["1/2.0@x", "east&west"])
    assert (road.mainline.before_m, road.ramp.before_m) == (1000.0, 425.0)
    assert road.lane_point(-10.0, on_ramp=False)[2:] == pytest.approx((7000.0, -310.0, 0.0))
    cases = from_unit(np.random.default_rng(4).random((100, 2)), level=0, scenario=US23)
    factory = VutFactory(vut)
    motions = []
    for where in (None, road):
        with World(16, where, factory.vut.vut_type, scenario=US23) as world:
            ran = dict(rollout(world, PovLibrary(16, POVS), factory(16, world), cases))
        motions.append([ran[place].motion for place in range(100)])
    for ours, theirs in zip(*motions, strict=True):
        assert np.array_equal(ours, theirs)


def test_a_corridor_travels_to_other_processes(corridor):
    road = corridor("curved")
    assert pickle.loads(pickle.dumps(road)) == road  # noqa: S301 (our own bytes)


def test_a_world_says_when_sumo_does_not_drive_what_it_was_told(corridor):
    def drive(world):
        for _ in range(40):
            world.step(np.array([[0.0], [2.0]]))

    with World(1, corridor("priority"), scenario=US23) as world:
        world.place(0, [(-300.0, 30.0), (-100.0, 12.0)])
        drive(world)
        world.place(0, [(-300.0, 30.0), (-100.0, 12.0)])
        world._libsumo.vehicle.setSpeedMode("vut.0", SPEED_MODE_COMMANDED - 1)
        with pytest.raises(SimulationError, match="away from where it drives"):
            drive(world)


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


def test_idle_vehicles_of_a_short_ramp_stand_where_it_begins(tmp_path):
    net = plain(
        tmp_path,
        node("a", -500, 0) + node("m", 0, 0) + node("b", 500, 0) + node("r", -60, -30),
        edge("in", "a", "m", 1, 30, priority=9) + edge("out", "m", "b", 1, 30, priority=9)
        + edge("r", "r", "m", 1, 20, priority=3),
    )  # fmt: skip
    road = find_corridor(NetFile(net), ["in", "out"], ["r", "out"])
    assert road.ramp.before_m < 100.0
    with World(2, road, scenario=US23) as world:
        world.park(1)
        world.step(np.zeros((2, 2)))
        assert world.x_m[POV, 1] == pytest.approx(-182.0, abs=EXACT)
        assert world.x_m[VUT, 1] == pytest.approx(-road.ramp.before_m, abs=EXACT)


@pytest.mark.parametrize(
    ("mainline", "ramp", "said"),
    [
        ("in out", "r9 out", "has no edge r9: did you mean r[01] or r[01]"),
        ("in :m_0", "r1 out", "has no edge :m_0"),
        ("in out", "r1", "never meet; name the edge behind the merge point"),
        ("in r1 out", "r0 out", "edge in does not lead to edge r1; r0 do"),
        ("in out", "r0 out", "edge r0 does not lead to edge out; in and r1 do"),
        ("out out2", "r1 out", "mainline begins with edge out, which the other path uses too"),
        ("in out", "out out2", "ramp begins with edge out.*before it: in or r1"),
        ("in out out2", "r1 out in", "behind edge out the mainline goes to out2 and the ramp to"),
        ("", "r1 out", "never meet"),
    ],
)
def test_what_is_no_merge_is_refused_in_one_sentence(straight_net, mainline, ramp, said):
    with pytest.raises(UserError, match=said) as error:
        find_corridor(straight_net, mainline.split(), ramp.split())
    assert "\n" not in str(error.value)
    assert str(straight_net.path) in str(error.value)


def test_a_ramp_that_keeps_a_lane_of_its_own_is_refused(tmp_path):
    net = NetFile(lane_drop(tmp_path))
    with pytest.raises(UserError, match="no lane in common up to the end of edge acc"):
        find_corridor(net, ["in", "acc"], ["ramp", "acc"])


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
        (edited(r'(id="r1_0" .*)length="[\d.]+"', r'\1length="far"'), "is no number"),
        (edited(r'(id="r1_0" .*)length="[\d.]+"', r'\1length="nan"'), "is no number"),
        (edited(r'(id="r1_0" .*)length="[\d.]+"', r'\1length="0"'), "r1_0 has no length"),
        (edited(r'(id="r1_0" .*)shape="[^"]*"', r'\1shape="1,1 1,1"'), "r1_0 has no length"),
        (edited(r'(id="r1_0" .*)shape="[^"]*"', r'\1shape="here"'), "is no number"),
        (edited(r'(id="r1_0" index="0" )', r'\1disallow="all" '), "no lane of edge r1 is open"),
        (edited(r'(<connection from="r1" [^>]*)via="[^"]*"', r'\1via=":x_0"'), "over lane :x_0"),
        (edited(r'<connection from="r1" [^>]*/>', ""), "edge r1 does not lead to edge out; in do"),
        (edited('<junction id="m" type="priority"', '<junction id="m" type="x"'), "of type x"),
        (edited('(<junction id="m" .*)incLanes="[^"]*"', r"\1"), "no junction at the end of lane"),
    ],
)
def test_a_broken_net_is_refused_in_one_sentence(straight_net, tmp_path, edit, said):
    path = tmp_path / "broken.net.xml"
    path.write_text(edit(straight_net.content.decode()))
    with pytest.raises(UserError, match=said) as error:
        find_corridor(NetFile(path), ["in", "out"], ["r1", "out"])
    assert "\n" not in str(error.value)


def test_a_net_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(UserError, match="cannot read the net"):
        NetFile(tmp_path / "nowhere.net.xml")


def test_netconvert_reads_the_hosted_net_too(corridor, tmp_path):
    hosted = tmp_path / "hosted.net.xml"
    hosted.write_bytes(hosted_net(corridor("OSM"), 1))
    done = subprocess.run(
        [sumo_program("netconvert"), "-s", hosted, "-o", tmp_path / "again.net.xml"],
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert AUXILIARY not in hosted.read_text(), "names of the file stay in the corridor"
