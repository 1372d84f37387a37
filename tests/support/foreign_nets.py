"""Nets of others, drawn, downloaded and converted, as netconvert builds them."""

from __future__ import annotations

import math
import subprocess
from pathlib import Path

from merge_sumo.road.finder import find_road, read_net
from merge_sumo.road.road import Road
from merge_sumo.scenario.scenario import Bounds
from merge_sumo.sumo.binding import sumo_program


def netconvert(*arguments: str | Path) -> None:
    command = [sumo_program("netconvert"), *map(str, arguments)]
    subprocess.run(command, check=True, capture_output=True)


def plain(folder: Path, nodes: str, edges: str, connections: str = "", *options: str) -> Path:
    """Build a net from plain XML, with the defaults of netconvert."""
    for name, text in (("nodes", nodes), ("edges", edges), ("connections", connections)):
        (folder / f"{name}.xml").write_text(f"<{name}>{text}</{name}>")
    files = ("-n", folder / "nodes.xml", "-e", folder / "edges.xml", "-x")
    out = folder / "built.net.xml"
    netconvert(*files, folder / "connections.xml", *options, "-o", out)
    return out


def edge(name: str, begin: str, end: str, lanes: int, speed: float, **more: object) -> str:
    extra = "".join(f' {key}="{value}"' for key, value in more.items())
    return (
        f'<edge id="{name}" from="{begin}" to="{end}" numLanes="{lanes}" speed="{speed}"{extra}/>'
    )


def node(name: str, x: float, y: float, kind: str = "priority") -> str:
    return f'<node id="{name}" x="{x}" y="{y}" type="{kind}"/>'


def lane(source: str, source_lane: int, target: str, target_lane: int) -> str:
    return (
        f'<connection from="{source}" to="{target}" fromLane="{source_lane}" '
        f'toLane="{target_lane}"/>'
    )


def curved(folder: Path) -> Path:
    """Everything bends, and two edges are longer than they are drawn."""
    return plain(
        folder,
        node("a", -600, 300) + node("m", 0, 0) + node("b", 500, 250) + node("r", -300, -200),
        edge(
            *("in", "a", "m", 2, 33),
            priority=9,
            shape="-600,300 -500,150 -400,60 -300,15 -200,-5 -100,-8 0,0",
            length=770,
        )
        + edge("out", "m", "b", 2, 33, priority=9, shape="0,0 150,30 300,90 500,250")
        + edge(
            *("slip", "r", "m", 1, 14),
            priority=3,
            shape="-300,-200 -250,-100 -180,-50 -90,-28 0,0",
            length=420,
        ),
    )


def straight(folder: Path, kind: str) -> Path:
    """Edges in a row with internal lanes of 0.1 m in between, and a merge of a kind."""
    return plain(
        folder,
        node("a", -700, 0) + node("m", 0, 0, kind) + node("b", 600, 0) + node("c", 1200, 20)
        + node("r0", -500, -120) + node("r1", -150, -40),
        edge("in", "a", "m", 2, 30, priority=9) + edge("out", "m", "b", 2, 30, priority=9)
        + edge("out2", "b", "c", 2, 30, priority=9) + edge("r0", "r0", "r1", 1, 14, priority=3)
        + edge("r1", "r1", "m", 1, 14, priority=3),
        lane("r1", 0, "out", 0) + lane("in", 0, "out", 0) + lane("in", 1, "out", 1),
    )  # fmt: skip


def lane_drop(folder: Path, kind: str = "priority") -> Path:
    """An auxiliary lane next to two lanes: it ends, or at a zipper it is led into the next one."""
    into = lane("acc", 0, "out", 0) if kind == "zipper" else ""
    return plain(
        folder,
        node("a", -800, 0) + node("n", -200, 0) + node("d", 0, 0, kind) + node("b", 700, 0)
        + node("r", -500, -90),
        edge("in", "a", "n", 2, 36, priority=9) + edge("acc", "n", "d", 3, 36, priority=9)
        + edge("out", "d", "b", 2, 36, priority=9) + edge("ramp", "r", "n", 1, 22, priority=3),
        lane("in", 0, "acc", 1) + lane("in", 1, "acc", 2) + lane("ramp", 0, "acc", 0)
        + lane("acc", 1, "out", 0) + lane("acc", 2, "out", 1) + into,
    )  # fmt: skip


OSM_NODES_M = {
    **{1: (-900, 0), 2: (-500, 10), 3: (-200, 5), 4: (0, 0), 5: (300, -20), 6: (900, -100)},
    **{7: (-450, -160), 8: (-300, -90), 9: (-150, -30), 10: (1500, -200)},
}
"""Nodes of the OpenStreetMap piece, in metres east and north of 42.3 N 83.7 W."""
OSM_WAYS = """
<way id="4711" version="1" visible="true"><nd ref="1"/><nd ref="2"/><nd ref="3"/><nd ref="4"/>
<nd ref="5"/><nd ref="6"/><nd ref="10"/><tag k="highway" v="motorway"/><tag k="lanes" v="2"/>
<tag k="maxspeed" v="70 mph"/></way><way id="4712" version="1" visible="true"><nd ref="7"/>
<nd ref="8"/><nd ref="9"/><nd ref="4"/><tag k="highway" v="motorway_link"/><tag k="lanes" v="1"/>
<tag k="oneway" v="yes"/></way>
"""


def osm(folder: Path) -> Path:
    """Return a motorway with a link, as OpenStreetMap writes it and its import makes a net."""
    degree_m = 111_320
    east_m = degree_m * math.cos(math.radians(42.3))
    nodes = ""
    for n, (x, y) in OSM_NODES_M.items():
        place = f'lat="{42.3 + y / degree_m:.9f}" lon="{-83.7 + x / east_m:.9f}"'
        nodes += f'<node id="{n}" version="1" visible="true" {place}/>'
    (folder / "piece.osm").write_text(f'<osm version="0.6">{nodes}{OSM_WAYS}</osm>')
    out = folder / "osm.net.xml"
    netconvert("--osm-files", folder / "piece.osm", "--ramps.guess", "--geometry.remove", "-o", out)
    return out


def opendrive(folder: Path, of: Path) -> Path:
    """Convert a net to OpenDRIVE, and that to a net, with the names that this makes."""
    out = folder / "xodr.net.xml"
    netconvert("-s", of, "--opendrive-output", folder / "road.xodr")
    netconvert("--opendrive-files", folder / "road.xodr", "-o", out)
    return out


def two_edges(folder: Path) -> Path:
    """A curved acceleration lane of two edges, with a sidewalk and internal lanes."""
    bend = "-200,0 -120,6 -60,16 0,30"
    return plain(
        folder,
        node("a", -900, 0) + node("g", -200, 0) + node("h", 0, 30) + node("e", 120, 70)
        + node("b", 700, 200) + node("r", -500, -90),
        edge("in", "a", "g", 2, 33, priority=9) + edge("out", "e", "b", 2, 33, priority=9)
        + edge("acc1", "g", "h", 3, 33, priority=9, shape=bend, sidewalkWidth=2)
        + edge("acc2", "h", "e", 3, 33, priority=9) + edge("ramp", "r", "g", 1, 17, priority=3),
        lane("ramp", 0, "acc1", 1) + lane("in", 0, "acc1", 2) + lane("in", 1, "acc1", 3)
        + lane("acc1", 1, "acc2", 0) + lane("acc1", 2, "acc2", 1) + lane("acc1", 3, "acc2", 2)
        + lane("acc2", 1, "out", 0) + lane("acc2", 2, "out", 1),
    )  # fmt: skip


AUXILIARY = "4711#1-AddedOnRampEdge"
FOREIGN = {
    "curved": (curved, "in out", "slip out"),
    "priority": (lambda f: straight(f, "priority"), "in out out2", "r0 r1 out"),
    "zipper": (lambda f: straight(f, "zipper"), "in out", "r0 r1 out out2"),
    "lane drop": (lane_drop, "in acc out", "ramp acc out"),
    "OSM": (osm, f"4711#0 {AUXILIARY} 4711#1", f"4712 {AUXILIARY} 4711#1"),
    "OpenDRIVE": (lambda f: opendrive(f, curved(f)), "-40 -41", "-42 -41"),
}
"""Name, builder, edges of the mainline and of the ramp."""

LANES = {
    "two edges": (two_edges, "in acc1 acc2 out", "ramp acc1 acc2 out"),
    "lane drop": FOREIGN["lane drop"],
    "OSM": FOREIGN["OSM"],
    "zipper": (lambda f: lane_drop(f, "zipper"), "in acc out", "ramp acc out"),
}
"""Those with an acceleration lane."""
LANE_M = (-30.0, 60.0)
"""Of a scenario; the lanes of these nets are longer."""


def foreign_road(name: str, folder: Path, lane_m: Bounds | None = None) -> Road:
    """Build a net and find its merge."""
    build, mainline, ramp = (LANES if lane_m else FOREIGN)[name]
    net = read_net(build(folder))
    return find_road(net, mainline.split(), ramp.split(), lane_m=lane_m)


def foreign_lane_road(name: str, folder: Path) -> Road:
    """Return the merge in one of `LANES`, with its acceleration lane."""
    return foreign_road(name, folder, LANE_M)
