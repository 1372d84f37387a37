"""The road as OpenDRIVE, for simulators other than SUMO."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from itertools import groupby, pairwise

from lxml import etree

from merge_sumo.errors import UserError
from merge_sumo.road.corridor import Corridor, LanePath
from merge_sumo.road.xml_input import harmless_net, read_xml, to_bytes
from merge_sumo.sumo.binding import run_program, scratch_folder

NET = "road.net.xml"
ROAD = "road.xodr"
ENTRY = "entry"
"""OpenDRIVE's type of an acceleration lane."""
CONVERSION_LIMIT_S = 180.0
"""Time that netconvert has for a net; it needs 10 s for that of a city."""
SAME_M = 0.5
"""Distance of the ends of one lane in SUMO and in OpenDRIVE, at most."""


def opendrive(road: Corridor) -> bytes:
    """Return the net of a road as OpenDRIVE in the same coordinates.

    Raises `UserError` when the net file is gone or is another one now, or netconvert refuses it.
    """
    content = read_xml(road.path, "the net")
    if hashlib.sha256(content).hexdigest() != road.sha256:
        raise UserError(
            f"the net {road.path} is not the one that was driven in: it changed; put that one there"
        )
    net = harmless_net(road.path)
    for element in [*net.iter("tlLogic", "roundabout")]:
        net.remove(element)
    for connection in net.iterfind("connection"):
        for name in ("tl", "linkIndex", "via"):
            connection.attrib.pop(name, "")
    with scratch_folder() as stage:
        (stage / NET).write_bytes(to_bytes(net))
        arguments = [
            *("--sumo-net-file", NET, "--opendrive-output", ROAD),
            *("--offset.disable-normalization", "true"),
            # It smooths the corners of a shape by itself, by metres; SUMO drives along them.
            *("--opendrive-output.straight-threshold", "180"),
            *("--precision", "6", "--no-warnings", "true", "--xml-validation", "never"),
        ]
        ended = run_program("netconvert", arguments, stage, limit_s=CONVERSION_LIMIT_S)
        if ended.code == 0 and (stage / ROAD).is_file():
            return _with_paths((stage / ROAD).read_bytes(), road)
    raise UserError(f"netconvert cannot write {road.path} as OpenDRIVE: {ended.reason}")


_Place = tuple[float, float]


def _with_paths(made: bytes, road: Corridor) -> bytes:
    """Return OpenDRIVE in which the ways over junctions are those of both paths.

    netconvert draws a way of its own, up to a metre off the lanes inside of a junction. Here its
    reference line becomes the centre of the lane that is driven on. The acceleration lane, which it
    writes as any other, gets the type "entry".
    """
    crossings = {line for path in (road.mainline, road.ramp) for line in _crossings(path)}
    if not crossings and road.lane_m is None:
        return made
    parser = etree.XMLParser(resolve_entities=False, no_network=True, huge_tree=True)
    root = etree.fromstring(made, parser)
    roads = {str(element.get("id")): element for element in root.iterfind("road")}
    for element in roads.values():
        if element.get("junction") != "-1":
            for lane, begin, end in _joined(element, roads):
                for line in crossings:
                    if max(math.dist(line[0], begin), math.dist(line[-1], end)) <= SAME_M:
                        _draw(element, lane, line)
        else:
            _mark_entry(element, road)
    return etree.tostring(root, xml_declaration=True, encoding="UTF-8")


def _mark_entry(element: etree._Element, road: Corridor) -> None:
    """Write of which type the lane of a road is, if it is the acceleration lane."""
    begin_m, end_m = road.lane_m or (0.0, 0.0)
    ends = [p.shape[-1][:2] for p in road.ramp.pieces if begin_m <= p.start_m < end_m]
    for lane in element.iterfind("lanes/laneSection/right/lane"):
        place = _end_of_lane(element, int(lane.get("id", "")), last=True)
        if any(math.dist(place, end) <= SAME_M for end in ends):
            lane.set("type", ENTRY)


def _crossings(path: LanePath) -> Iterator[tuple[_Place, ...]]:
    """Yield the lines on which a path goes over junctions, from road to road."""
    for internal, pieces in groupby(path.pieces, key=lambda piece: piece.is_internal):
        if internal:
            points = [(x, y) for piece in pieces for x, y, _ in piece.shape]
            yield (*(a for a, b in pairwise(points) if math.dist(a, b) > 1e-6), points[-1])


def _joined(
    element: etree._Element, roads: dict[str, etree._Element]
) -> Iterator[tuple[int, _Place, _Place]]:
    """Yield the lanes of a connecting road, each with the ends of the lanes that it joins."""
    before, after = element.find("link/predecessor"), element.find("link/successor")
    if before is None or after is None:
        return
    source, target = (roads.get(str(link.get("elementId"))) for link in (before, after))
    for lane in element.iterfind("lanes/laneSection/right/lane"):
        ends = lane.find("link/predecessor"), lane.find("link/successor")
        if source is None or target is None or ends[0] is None or ends[1] is None:
            continue
        begin = _end_of_lane(source, int(ends[0].get("id", "")), last=True)
        end = _end_of_lane(target, int(ends[1].get("id", "")), last=False)
        yield int(lane.get("id", "")), begin, end


def _end_of_lane(element: etree._Element, lane: int, *, last: bool) -> _Place:
    """Return begin or end of the centre of a lane of a road of straight lines."""
    line = element.findall("planView/geometry")[-1 if last else 0]
    x, y, heading, length_m = (float(line.get(name, "")) for name in ("x", "y", "hdg", "length"))
    along_m = length_m if last else 0.0
    offset = element.find("lanes/laneOffset")
    left_m = _centre_m(element, lane) + (0.0 if offset is None else float(offset.get("a", "")))
    cos, sin = math.cos(heading), math.sin(heading)
    return x + along_m * cos - left_m * sin, y + along_m * sin + left_m * cos


def _centre_m(element: etree._Element, lane: int) -> float:
    """Return the distance of a lane's centre to the left of the reference line, without offset."""
    widths_m = {
        int(other.get("id", "")): float(width.get("a", ""))
        for other in element.iterfind("lanes/laneSection/right/lane")
        if (width := other.find("width")) is not None
    }
    return -sum(widths_m[other] for other in widths_m if other > lane) - widths_m[lane] / 2.0


def _draw(element: etree._Element, lane: int, line: tuple[_Place, ...]) -> None:
    """Make a line the reference line of a road, and the centre of one of its lanes."""
    plan, lanes = element.find("planView"), element.find("lanes")
    if plan is None or lanes is None:
        return
    plan[:] = []
    s_m = 0.0
    for (x0, y0), (x1, y1) in pairwise(line):
        length_m = math.dist((x0, y0), (x1, y1))
        values = {"s": s_m, "x": x0, "y": y0, "hdg": math.atan2(y1 - y0, x1 - x0)}
        values["length"] = length_m
        geometry = etree.SubElement(plan, "geometry", {k: f"{v:.8f}" for k, v in values.items()})
        etree.SubElement(geometry, "line")
        s_m += length_m
    element.set("length", f"{s_m:.8f}")
    for offset in lanes.findall("laneOffset"):
        lanes.remove(offset)
    polynomial = {"a": f"{-_centre_m(element, lane):.8f}", "b": "0", "c": "0", "d": "0"}
    lanes.insert(0, etree.Element("laneOffset", {"s": "0", **polynomial}))
