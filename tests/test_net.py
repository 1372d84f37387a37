"""The road: exact lane coordinates around M, copies side by side, and broken nets refused."""

from __future__ import annotations

import math
import re
import subprocess
import sys
from pathlib import Path

import pytest

from merge_sumo.errors import UserError
from merge_sumo.sumo.binding import load_libsumo
from merge_sumo.sumo.net import (
    CORRIDOR_SPACING_M,
    MAIN_IN,
    MAIN_OUT,
    RAMP,
    Net,
    default_net_path,
)
from merge_sumo.sumo.world import World

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def net() -> Net:
    return Net()


def test_the_shipped_nets_are_what_their_sources_build(tmp_path):
    tool = ROOT / "tools" / "build_net.py"
    subprocess.run([sys.executable, tool, "--out", tmp_path], check=True, capture_output=True)
    built = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert built == {path.name: path.read_bytes() for path in (ROOT / "sumo_net").glob("*.net.xml")}
    assert default_net_path().name in built


class TestTheShippedNet:
    def test_has_the_merge_point_as_origin_of_all_lanes(self, net):
        assert (net.main_in.x1_m, net.main_in.y1_m) == (0.0, 0.0)
        assert (net.ramp.x1_m, net.ramp.y1_m) == (0.0, 0.0)
        assert (net.main_out.x0_m, net.main_out.y0_m) == (0.0, 0.0)

    def test_has_lanes_of_whole_lengths(self, net):
        lengths = [lane.length_m for lane in (net.main_in, net.main_out, net.ramp)]
        assert lengths == [1000.0, 2000.0, 425.0]

    def test_draws_its_lanes_as_long_as_they_are(self, net):
        for lane in (net.main_in, net.main_out, net.ramp):
            drawn = math.hypot(lane.x1_m - lane.x0_m, lane.y1_m - lane.y0_m)
            assert drawn == pytest.approx(lane.length_m, abs=1e-9)

    def test_is_a_main_road_with_two_lanes_and_a_ramp_with_one(self, net):
        lanes = re.findall(r'<lane id="(\w+)_\d"', net.text.decode())
        assert [lanes.count(edge) for edge in (MAIN_IN, MAIN_OUT, RAMP)] == [2, 2, 1]

    def test_limits_no_speed_of_the_scenario(self, net):
        assert net.speed_limit_mps >= 45.0

    @pytest.mark.parametrize("on_ramp", [False, True])
    def test_puts_a_lane_coordinate_at_its_distance_from_the_merge_point(self, net, on_ramp):
        for x_m in (-340.0, -182.0, -1e-6, 0.0, 1e-6, 25.0):
            lane, position, x, y, _ = net.lane_point(x_m, on_ramp=on_ramp)
            assert math.hypot(x, y) == pytest.approx(abs(x_m), abs=1e-9)
            before = RAMP if on_ramp else MAIN_IN
            assert lane == (f"{before}_0" if x_m < 0 else f"{MAIN_OUT}_0")
            length = {"ramp_0": 425.0, "main_in_0": 1000.0, "main_out_0": 0.0}[lane]
            assert position == pytest.approx(length + x_m, abs=1e-9)

    def test_points_the_main_road_east_and_the_ramp_towards_it(self, net):
        assert net.lane_point(-10.0, on_ramp=False)[4] == pytest.approx(90.0)
        assert net.lane_point(10.0, on_ramp=True)[4] == pytest.approx(90.0)
        # From (-420, -65): atan(420 / 65), clockwise from north.
        assert net.lane_point(-10.0, on_ramp=True)[4] == pytest.approx(81.2025893, abs=1e-6)

    def test_has_a_hash_of_its_bytes(self, net, tmp_path):
        copy = tmp_path / "copy.net.xml"
        copy.write_bytes(net.text)
        assert Net(copy).sha256 == net.sha256
        copy.write_bytes(net.text + b"\n")
        assert Net(copy).sha256 != net.sha256


def test_three_corridors_are_three_equal_roads_for_sumo(net, tmp_path):
    file = tmp_path / "corridors.net.xml"
    file.write_bytes(net.replicate(3))
    libsumo = load_libsumo()
    libsumo.start(["sumo", "--net-file", str(file), "--no-step-log", "--xml-validation", "never"])
    try:
        lines = {MAIN_IN: net.main_in, MAIN_OUT: net.main_out, RAMP: net.ramp}
        for k in range(3):
            shift = k * CORRIDOR_SPACING_M
            assert libsumo.junction.getPosition(f"M.{k}") == (0.0, 1.6 - shift)
            for edge, line in lines.items():
                lane = f"{edge}.{k}_0"
                assert libsumo.lane.getLength(lane) == line.length_m
                ends = [(line.x0_m, line.y0_m - shift), (line.x1_m, line.y1_m - shift)]
                assert [tuple(point[:2]) for point in libsumo.lane.getShape(lane)] == ends
            for start in (MAIN_IN, RAMP):
                route = libsumo.simulation.findRoute(f"{start}.{k}", f"{MAIN_OUT}.{k}")
                assert list(route.edges) == [f"{start}.{k}", f"{MAIN_OUT}.{k}"]
        assert len(libsumo.edge.getIDList()) == 9
        assert not libsumo.simulation.findRoute("ramp.0", "main_out.1").edges
    finally:
        libsumo.close()


def edited(old: str, new: str):
    """Return an edit of the net's text that must find what it replaces."""

    def edit(text: str) -> str:
        assert old in text
        return text.replace(old, new)

    return edit


def without(pattern: str):
    """Return an edit that takes out what a pattern finds."""

    def edit(text: str) -> str:
        assert re.search(pattern, text, re.DOTALL)
        return re.sub(pattern, "", text, flags=re.DOTALL)

    return edit


RAMP_SHAPE = "-420.000000,-65.000000 0.000000,0.000000"

BROKEN = {
    "empty": (lambda text: "", "not readable XML"),
    "no XML": (lambda text: "ceci n'est pas une route", "not readable XML"),
    "cut off": (lambda text: text[: len(text) // 2], "not readable XML"),
    "another root": (lambda text: "<routes/>", "another root than <net>"),
    "no edge": (lambda text: "<net/>", "no edge main_in"),
    "no ramp": (without(r'<edge id="ramp".*?</edge>'), "no edge ramp"),
    "no main road behind M": (without(r'<edge id="main_out".*?</edge>'), "no edge main_out"),
    "no lane 0": (
        edited('<lane id="ramp_0" index="0"', '<lane id="ramp_0" index="7"'),
        "no edge ramp",
    ),
    "a short ramp": (
        edited('speed="45.000000" length="425', 'speed="45.000000" length="125'),
        "183",
    ),
    "a length that is not drawn": (
        edited('length="425.000000" shape="-4', 'length="426" shape="-4'),
        "as long as they are drawn",
    ),
    "a ramp that misses M": (
        edited(f'"425.000000" shape="{RAMP_SHAPE}"/>', '"425.000000" shape="-420,-65.5 0,-0.5"/>'),
        "meet at M",
    ),
    "a main road that misses M": (
        edited("-1000.000000,0.000000 0.0", "-1001.0,0.000000 -1.0"),
        "meet at M",
    ),
    "a bent ramp": (
        edited(f'shape="{RAMP_SHAPE}"/>', 'shape="-420,-65 -200,-30 0,0"/>'),
        "straight",
    ),
    "a shape of words": (
        edited(f'shape="{RAMP_SHAPE}"/>', 'shape="here there"/>'),
        "is not points x,y",
    ),
    "a shape that is no number": (
        edited(f'shape="{RAMP_SHAPE}"/>', 'shape="-420,nan 0,0"/>'),
        "lane whose shape is not points x,y",
    ),
    "a length that is no number": (
        edited('length="425.000000" shape="-4', 'length="nan" shape="-4'),
        "edge whose length is not a number",
    ),
    "no speed": (edited('speed="45.000000" length="425', 'length="425'), "straight"),
    "internal links": (
        edited("</net>", '<edge id=":M_0" function="internal"/></net>'),
        "--no-internal-links",
    ),
    "no way off the ramp": (without(r'<connection from="ramp"[^>]*/>'), "lane 0 of ramp"),
    "no way along the main road": (
        edited(
            'from="main_in" to="main_out" fromLane="0"', 'from="main_in" to="main_out" fromLane="1"'
        ),
        "lane 0 of main_in",
    ),
}


class TestABrokenNet:
    @pytest.mark.parametrize("name", BROKEN)
    def test_is_refused_in_one_sentence(self, name, tmp_path):
        edit, reason = BROKEN[name]
        path = tmp_path / "broken.net.xml"
        path.write_text(edit(default_net_path().read_text()))
        with pytest.raises(UserError) as error:
            Net(path)
        assert "\n" not in str(error.value)
        assert str(path) in str(error.value)
        assert reason in str(error.value)

    @pytest.mark.parametrize("missing", ["nowhere.net.xml", "."])
    def test_that_is_no_file_is_refused_in_one_sentence(self, missing, tmp_path):
        with pytest.raises(UserError, match="cannot read the net") as error:
            Net(tmp_path / missing)
        assert "\n" not in str(error.value)

    @pytest.mark.parametrize(
        "edit",
        [
            without(r"<junction.*?</junction>|<junction[^>]*/>"),
            edited('type="zipper"', 'type="chaos"'),
            edited('x="0.000000" y="1.600000"', 'x="0.000000" y="north"'),
        ],
        ids=["no junctions", "an unknown junction", "a junction nowhere"],
    )
    def test_that_only_sumo_sees_through_is_refused_in_one_sentence(self, edit, tmp_path):
        path = tmp_path / "broken.net.xml"
        path.write_text(edit(default_net_path().read_text()))
        with pytest.raises(UserError) as error, World(2, Net(path)):
            pass
        assert "\n" not in str(error.value)
        assert str(path) in str(error.value)

    def test_shows_no_file_that_an_external_entity_names(self, tmp_path):
        secret, path = tmp_path / "secret.xml", tmp_path / "broken.net.xml"
        text = default_net_path().read_text()
        (ramp,) = re.findall(r'<edge id="ramp".*?</edge>', text, re.DOTALL)
        secret.write_text(ramp)
        doctype = f'<!DOCTYPE net [<!ENTITY ramp SYSTEM "{secret.as_uri()}">]>\n<net '
        path.write_text(text.replace(ramp, "&ramp;").replace("<net ", doctype))
        with pytest.raises(UserError, match="declares a document type"):
            Net(path)


@pytest.mark.parametrize("extra", ["<!-- surveyed -->", "<?editor id='7'?>"])
def test_notes_between_the_lanes_do_no_harm(extra, tmp_path):
    path = tmp_path / "noted.net.xml"
    lane = '<lane id="ramp_0"'
    path.write_text(edited(lane, extra + lane)(default_net_path().read_text()))
    assert Net(path).replicate(1).count(b"<lane ") == 5
