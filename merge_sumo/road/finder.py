"""Finding the merge in a net that sumolib reads: where two sequences of edges come to one lane.

Where a lane ends from which no connection leads on, the driver changes to the lane next to it. The
path then crosses the junction next to the connection of that lane, as if the net had a connection
of its own for it, and M is after the junction, where it is in a net that has one.

A scenario with an acceleration lane says where M is along it: the paths become one where the lane
ends, at a coordinate above 0, and before that they run side by side, on lanes of the same edges.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain, pairwise, product
from pathlib import Path
from typing import Any, NamedTuple

from lxml import etree

from merge_sumo.errors import UserError
from merge_sumo.printable import meant
from merge_sumo.road.road import (
    AccelerationLane,
    Approach,
    LanePath,
    Piece,
    Point,
    Road,
    lane_around_m,
)
from merge_sumo.road.xml_input import NET_TAGS, parse_xml, read_xml
from merge_sumo.scenario.scenario import ROOM_AFTER_M, Bounds

SumoNet = Any
SumoLane = Any
SumoConnection = Any
"""Classes of sumolib, which has no types."""

FARTHEST_M = 2e7
"""Largest coordinate and length in a net: half way round the earth, in metres of UTM."""
SURROUNDINGS_M = 500.0
"""Distance to M up to which lanes next to the paths are drawn."""
VISIBILITY = "visibility"
"""Attribute of a connection: from how far its driver sees the others, in m."""
POINT_M = 1e-6
"""Length at which a lane is drawn that the file draws as a point."""
NAME_LAST = "name the edge after the merge point as the last one of both"
MAINLINE, RAMP = 0, 1
"""Places of the paths in pairs."""


@dataclass(frozen=True, slots=True)
class RoadNet:
    """A net file.

    Attributes:
        path: the file.
        sha256: hash of its unpacked bytes: a packed net is the same road.
        net: its content, a `sumolib.net.Net`.
    """

    path: Path
    sha256: str
    net: SumoNet

    @property
    def edges(self) -> list[str]:
        """Ids of the edges outside of junctions."""
        return sorted(edge.getID() for edge in self.net.getEdges(withInternal=False))


def read_net(path: Path, content: bytes | None = None) -> RoadNet:
    """Read a net with sumolib.

    sumolib gets the elements that `parse_xml` has checked and not the file, of which it would
    resolve the entities.

    Args:
        path: the net file.
        content: its unpacked bytes, where they are read already.

    Returns:
        The net.

    Raises:
        UserError: the file cannot be read, is not a SUMO net, or has a missing or wrong value.
    """
    from sumolib.net import NetReader  # late: other commands do not need it

    if content is None:
        content = read_xml(path, "the net")
    root = parse_xml(content, f"the net {path}", NET_TAGS)
    if root.tag != "net":
        raise UserError(
            f"{path} is not a SUMO net: it does not begin with <net>; netconvert makes a net of a "
            "map (`--osm-files`, `--opendrive-files`)"
        )
    reader = NetReader(withInternal=True)
    _feed(reader, root, path)
    return RoadNet(path, hashlib.sha256(content).hexdigest(), reader.getNet())


def _feed(reader: Any, element: etree._Element, path: Path) -> None:
    """Pass an element and those in it to a reader of sumolib."""
    try:
        reader.startElement(element.tag, element.attrib)
        if element.tag == "connection" and VISIBILITY in element.attrib:
            # sumolib leaves out this attribute, and keeps parameters.
            visibility = float(element.attrib[VISIBILITY])
            reader.startElement("param", {"key": VISIBILITY, "value": visibility})
        for child in element:
            _feed(reader, child, path)
        reader.endElement(element.tag)
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"{path} is not a valid SUMO net: <{element.tag}> in line {element.sourceline} has a "
            f"missing or wrong value ({error!r:.200})"
        ) from error


def find_road(
    road_net: RoadNet,
    mainline: Sequence[str],
    ramp: Sequence[str],
    *,
    room_after_m: float = ROOM_AFTER_M,
    edge_at_m: str | None = None,
    lane_m: Bounds | None = None,
) -> Road:
    """Find the merge of two sequences of edges in a net.

    Both name the edge on which the paths become one, and may continue after it. Equal sequences are
    one path.

    Args:
        road_net: the net.
        mainline: edges of the mainline.
        ramp: edges of the ramp.
        room_after_m: where the file ends nearer after M, the last lane is continued straight on.
        edge_at_m: the edge of a single path that begins at M, by default its last one.
        lane_m: where a scenario has its acceleration lane: that of the road ends with it, and may
            begin before it.

    Returns:
        The road.

    Raises:
        UserError: an edge is unknown, a sequence is not connected, the paths never meet, or the
            road has no such lane.
    """
    edges = tuple(mainline), tuple(ramp)
    try:
        return _road(road_net, edges, edge_at_m, room_after_m, lane_m)
    except UserError as error:
        raise UserError(f"the net {road_net.path} cannot host a merge: {error}") from error


class _Link(NamedTuple):
    """A connection between lanes of two edges, or the change from a lane that ends."""

    source: SumoLane
    target: SumoLane
    via: tuple[Piece, ...]
    """The internal lanes in between."""
    state: str
    """SUMO's letter for the right of way: "M" goes first, "m" yields, "Z" is a zipper."""
    visibility_m: float | None
    """From how far its driver sees the others, where the net says so."""
    connection: SumoConnection = None


_Edges = tuple[str, ...]
_Layer = dict[SumoLane, list[_Link]]
"""Lanes of an edge that a path can reach, each with the links that lead to it."""
_Pieces = tuple[list[Piece], list[Piece]]
"""Lanes of mainline and ramp."""


class _Meeting(NamedTuple):
    """The links by which both paths come to their first common lane."""

    links: tuple[_Link, _Link]
    ending: int | None
    """The path of which a lane ends there."""
    place: int
    """Of the edge of the common lane, among the edges that follow on both paths."""


def _road(
    road_net: RoadNet,
    edges: tuple[_Edges, _Edges],
    edge_at_m: str | None,
    room_after_m: float,
    lane_m: Bounds | None,
) -> Road:
    """Return the road of two sequences of edges."""
    net = road_net.net
    for name in chain(*edges):
        _check_edge(road_net, name)
    own, tail = _split(*edges, edge_at_m)
    main_layers = _layers(net, own[MAINLINE] + tail, len(own[MAINLINE]))
    ramp_layers = _layers(net, own[RAMP] + tail, len(own[RAMP]))
    on_main, on_ramp = len(own[MAINLINE]), len(own[RAMP])
    meeting = _meeting(net, tail, (main_layers[on_main:], ramp_layers[on_ramp:]))
    main_link, ramp_link = meeting.links
    main = _lanes_before(main_layers[: on_main + meeting.place], main_link)
    ramp = _lanes_before(ramp_layers[: on_ramp + meeting.place], ramp_link)
    onward = _onward(net, ramp_link.target, tail[meeting.place :])
    apart, along = _acceleration_lane(main, ramp)
    lane = _lane_of_road(net, meeting, along, lane_m)
    if lane_m is None:
        begin_m = end_m = 0.0
        apart, along = ([*main, *main_link.via], [*ramp, *ramp_link.via]), ([], [])
    elif lane is None:
        raise UserError(
            "ramp and mainline meet in one point, without a lane of the ramp side by side: leave "
            "lane_m out"
        )
    else:
        _check_window(lane, lane_m)
        begin_m, end_m = lane.begin_m, lane.end_m
        onward = [*main_link.via, *onward]
    placed = []
    for own_lanes, side_lanes in zip(apart, along, strict=True):
        pieces = _placed(own_lanes, begin_m - _length_m(own_lanes))
        pieces += _placed(side_lanes, begin_m, pieces[-1])
        shared = _placed(_continued(onward, room_after_m - end_m), end_m, pieces[-1])
        placed.append(LanePath((*pieces, *shared)))
    junction = _junction(ramp_link.source)
    return Road(
        path=road_net.path,
        sha256=road_net.sha256,
        mainline_edges=edges[MAINLINE],
        ramp_edges=edges[RAMP],
        mainline=placed[MAINLINE],
        ramp=placed[RAMP],
        junction_type=junction.getType(),
        mainline_approach=_approach(junction, meeting, MAINLINE),
        ramp_approach=_approach(junction, meeting, RAMP),
        lane_drop=meeting.ending is not None,
        drawn_after_m=end_m + _length_m(onward),
        surroundings=_surroundings(net, shared[0].shape[0], placed),
        lane_m=lane_m and (begin_m, end_m),
        acceleration_lane=lane,
    )


def _surroundings(
    net: SumoNet, place: Point, paths: Sequence[LanePath]
) -> tuple[tuple[Point, ...], ...]:
    """Return the shapes of lanes that are not in the paths and begin or end near a point."""
    used = {piece.lane for path in paths for piece in path.pieces}
    roads: list[tuple[Point, ...]] = []
    internal: list[tuple[Point, ...]] = []
    for edge in net.getEdges(withInternal=True):
        if edge.getFunction() in ("crossing", "walkingarea"):
            continue
        shapes = internal if edge.isSpecial() else roads
        for index, lane in enumerate(edge.getLanes()):
            ends = lane.getShape3D()[:1] + lane.getShape3D()[-1:]
            is_near = any(math.dist(end, place) <= SURROUNDINGS_M for end in ends)
            if is_near and f"{edge.getID()}_{index}" not in used:
                shapes.append(_shape(lane))
    return (*roads, *internal)


def _junction(lane: SumoLane) -> Any:
    """Return the junction at the end of a lane."""
    junction = lane.getEdge().getToNode()
    if junction is None or junction.getType() is None:
        raise UserError(f"there is no junction at the end of lane {lane.getID()}")
    return junction


def _approach(junction: Any, meeting: _Meeting, path: int) -> Approach:
    """Return how a path comes to the junction, where it meets the other one."""
    link, other = meeting.links[path], meeting.links[1 - path]
    if meeting.ending is not None:
        yields = path == meeting.ending
    elif junction.getType().startswith("traffic_light"):
        yields = path == RAMP
    else:
        try:
            yields = junction.forbids(other.connection, link.connection)
        except (IndexError, KeyError) as error:
            raise UserError(f"junction {junction.getID()} has no right of way") from error
    return Approach(link.state, yields, link.visibility_m)


def _check_edge(road_net: RoadNet, name: str) -> None:
    """Raise `UserError` where a net has no such edge, or cars may not drive there."""
    net = road_net.net
    if not net.hasEdge(name) or net.getEdge(name).isSpecial():
        hint = meant(name, road_net.edges, 0.5).strip()  # ids of edges are short
        raise UserError(f"it has no edge {name}{': ' if hint else ''}{hint}")
    if not _lanes(net, name):
        raise UserError(f"no lane of edge {name} is open to cars")


def _allows_cars(found: SumoLane | SumoConnection) -> bool:
    # To sumolib "all" is one more class.
    return bool(found.allows("passenger") or found.allows("all"))


def _lanes(net: SumoNet, edge: str) -> list[SumoLane]:
    """Return the lanes of an edge on which cars may drive."""
    return [lane for lane in net.getEdge(edge).getLanes() if _allows_cars(lane)]


def _shape(lane: SumoLane) -> tuple[Point, ...]:
    """Return the shape of a lane, whose numbers are checked."""
    shape = tuple(lane.getShape3D())
    for number in chain((lane.getLength(), lane.getSpeed()), *shape):
        if not abs(number) <= FARTHEST_M:
            raise UserError(f"lane {lane.getID()} has {number}, not within {FARTHEST_M:g}")
    return shape


def _piece(lane: SumoLane) -> Piece:
    """Return a lane as a piece of a path, which begins at 0 until it is placed."""
    shape = _corners(_shape(lane))
    is_point = len(shape) == 1 and not lane.getEdge().isSpecial()
    if lane.getLength() <= 0.0 or not shape or is_point:
        raise UserError(f"lane {lane.getID()} has no length")
    return Piece(lane.getID(), 0.0, lane.getLength(), lane.getSpeed(), shape)


def _links(net: SumoNet, source: SumoLane, to_edge: str) -> list[_Link]:
    """Return the links of a lane to the lanes of an edge, as far as cars may drive there."""
    links = []
    for found in source.getOutgoing():
        target = found.getToLane()
        if found.getTo().getID() == to_edge and _allows_cars(target) and _allows_cars(found):
            via, visibility_m = _via(net, found), found.getParam(VISIBILITY)
            links.append(_Link(source, target, via, found.getState(), visibility_m, found))
    return links


def _via(net: SumoNet, connection: SumoConnection) -> tuple[Piece, ...]:
    """Return the internal lanes of a connection; there are two where drivers wait inside."""
    pieces: dict[str, Piece] = {}
    while (name := connection.getViaLaneID()) and name not in pieces:
        try:
            lane = net.getLane(name)
        except (IndexError, KeyError, ValueError) as error:
            raise UserError(f"a connection leads over lane {name}, which is not there") from error
        pieces[name] = _piece(lane)
        if not lane.getOutgoing():
            break
        connection = lane.getOutgoing()[0]
    return tuple(pieces.values())


def _acceleration_lane(main: list[Piece], ramp: list[Piece]) -> tuple[_Pieces, _Pieces]:
    """Return the lanes of both paths before an acceleration lane, and those side by side along it.

    There are none of the second kind where the paths come to M without such a lane. The ramp's get
    the length of the mainline's, from which they differ a little inside of junctions and where a
    net says so: both have one coordinate.
    """
    on_main, on_ramp = len(main), len(ramp)
    for one, other in zip(_roads(main), _roads(ramp), strict=False):
        main_edge, _, main_index = main[one].lane.rpartition("_")
        ramp_edge, _, ramp_index = ramp[other].lane.rpartition("_")
        if main_edge != ramp_edge or abs(int(main_index) - int(ramp_index)) != 1:
            break
        on_main, on_ramp = one, other
    along_main, along_ramp = main[on_main:], []
    for lane in ramp[on_ramp:]:
        stretch = _length_m(along_main) / _length_m(ramp[on_ramp:])
        along_ramp.append(replace(lane, length_m=lane.length_m * stretch))
    return (main[:on_main], ramp[:on_ramp]), (along_main, along_ramp)


def _roads(pieces: list[Piece]) -> list[int]:
    """Return the numbers of the pieces outside of junctions, the last one first."""
    numbers = range(len(pieces) - 1, -1, -1)
    return [number for number in numbers if not pieces[number].is_internal]


def _lane_of_road(
    net: SumoNet, meeting: _Meeting, along: _Pieces, lane_m: Bounds | None
) -> AccelerationLane | None:
    """Return the acceleration lane of a road: it ends with that of a scenario, or at the junction.

    None where the paths are not side by side before M, or the lane that ends is the mainline's.
    """
    main, ramp = along
    if not ramp or meeting.ending == MAINLINE:
        return None
    link = meeting.links[RAMP]
    end_m = lane_m[1] if lane_m else -_length_m(link.via)
    lanes = [net.getLane(piece.lane) for piece in ramp]
    exits = set()
    for connection in lanes[-1].getOutgoing():
        turns_back = connection.getDirection() in ("t", "T")
        if _allows_cars(connection) and _allows_cars(connection.getToLane()) and not turns_back:
            exits.add(connection.getTo().getID())
    return AccelerationLane(
        begin_m=end_m - _length_m(main),
        end_m=end_m,
        lanes=tuple(piece.lane for piece in ramp if not piece.is_internal),
        mainline_lanes=tuple(piece.lane for piece in main if not piece.is_internal),
        is_marked=any(lane.isAccelerationLane() for lane in lanes),
        exits=tuple(sorted(exits - {link.target.getEdge().getID()})),
    )


def _check_window(lane: AccelerationLane, lane_m: Bounds) -> None:
    """Raise `UserError` where the lane of a scenario begins before that of the road."""
    begin_m, end_m = lane_m
    if begin_m < lane.begin_m:
        low, high = lane_around_m(lane.length_m)
        raise UserError(
            f"lane_m is {begin_m:g} to {end_m:g}, {end_m - begin_m:g} m, and the acceleration lane "
            f"is {lane.length_m:.1f} m long: write lane_m = [{low:.1f}, {high:.1f}]"
        )


def _split(
    mainline: _Edges, ramp: _Edges, edge_at_m: str | None
) -> tuple[tuple[_Edges, _Edges], _Edges]:
    """Return the edges that each path has for itself, and those that follow on both."""
    if mainline == ramp and len(ramp) > 1:
        before = ramp.index(edge_at_m or ramp[-1])
        return (ramp[:before], ramp[:before]), ramp[before:]
    common = next((edge for edge in ramp if edge in mainline), None)
    if common is None:
        raise UserError(
            f"mainline ({' '.join(mainline)}) and ramp ({' '.join(ramp)}) never meet: {NAME_LAST}"
        )
    # A mainline may go round a ring and come by the edge again.
    on_main = mainline.index(common, 1 if common in mainline[1:] else 0)
    on_ramp = ramp.index(common)
    tails = mainline[on_main:], ramp[on_ramp:]
    for own, other in zip(*tails, strict=False):
        if own != other:
            raise UserError(
                f"after edge {common} the mainline goes to {own} and the ramp to {other}; name "
                "the same edges after the merge point"
            )
    if on_main == 0 or on_ramp == 0:
        raise UserError(
            f"the {'mainline' if on_main == 0 else 'ramp'} begins with edge {common}, which the "
            "other path uses too: name an edge before it"
        )
    return (mainline[:on_main], ramp[:on_ramp]), max(tails, key=len)


def _layers(net: SumoNet, edges: _Edges, common: int) -> list[_Layer]:
    """Return the lanes that a path can reach on each of its edges.

    A lane of its own must lead to edge number `common`; after that its lanes may end.
    """
    layers: list[_Layer] = [{lane: [] for lane in _lanes(net, edges[0])}]
    for number, (edge, following) in enumerate(pairwise(edges), start=1):
        layer: _Layer = {}
        for lane in layers[-1]:
            for link in _links(net, lane, following):
                layer.setdefault(link.target, []).append(link)
        if not layer and number <= common:
            raise UserError(f"edge {edge} does not lead to edge {following}: name those in between")
        layers.append(layer)
    return layers


def _meeting(net: SumoNet, tail: _Edges, layers: tuple[list[_Layer], list[_Layer]]) -> _Meeting:
    """Return the meeting of the paths: by connections, or where a lane of one of them ends.

    Args:
        net: the net.
        tail: the edges that follow on both paths.
        layers: for each of these the lanes that mainline and ramp can reach.

    Raises:
        UserError: they have no lane in common.
    """
    for place, edge in enumerate(tail):
        main, ramp = layers[MAINLINE][place], layers[RAMP][place]
        for lane in _lanes(net, edge):
            if lane in main and lane in ramp:
                links = min(main[lane], key=_swerve), min(ramp[lane], key=_swerve)
                return _Meeting(links, None, place)
        if place > 0:
            found = _lane_drop(net, (layers[MAINLINE][place - 1], layers[RAMP][place - 1]), edge)
            if found is not None:
                return _Meeting(*found, place)
    raise UserError(
        f"mainline and ramp have no lane in common up to the end of edge {tail[-1]}: {NAME_LAST}"
    )


def _lane_drop(
    net: SumoNet, layers: tuple[_Layer, _Layer], following: str
) -> tuple[tuple[_Link, _Link], int] | None:
    """Return the links of both paths where a lane of one ends next to a lane of the other.

    The number is that of the path whose lane ends. `following` is the edge after that on which it
    ends; None where no such lane ends.
    """
    for ending in (RAMP, MAINLINE):
        for last, neighbour in product(layers[ending], layers[1 - ending]):
            onward = _links(net, neighbour, following)
            is_next = abs(last.getIndex() - neighbour.getIndex()) == 1
            if is_next and onward and not _links(net, last, following):
                drop = _change(last, onward[0])
                return ((onward[0], drop) if ending == RAMP else (drop, onward[0])), ending
    return None


def _change(last: SumoLane, neighbour: _Link) -> _Link:
    """Return the link from a lane that ends to the target of a link of the lane next to it."""
    via = list(neighbour.via[:1])
    if via:
        ends = last.getShape3D()[-1], neighbour.target.getShape3D()[0]
        via = [replace(via[0], length_m=_length_m(neighbour.via), shape=_corners(ends))]
    state = "Z" if _junction(last).getType() == "zipper" else "m"
    # A driver on it sees all along the lane next to it.
    return _Link(last, neighbour.target, tuple(via), state, visibility_m=last.getLength())


def _swerve(link: _Link) -> tuple[int, int]:
    """Order links: straight ones first, then from the right."""
    index = link.source.getIndex()
    return abs(index - link.target.getIndex()), index


def _lanes_before(layers: list[_Layer], last: _Link) -> list[Piece]:
    """Return the lanes from the first edge to the source of a link."""
    lane = last.source
    pieces = [_piece(lane)]
    for layer in layers[:0:-1]:
        link = min(layer[lane], key=_swerve)
        lane = link.source
        pieces = [_piece(lane), *link.via, *pieces]
    return pieces


def _onward(net: SumoNet, lane: SumoLane, edges: _Edges) -> list[Piece]:
    """Return the lanes from one on along edges, the first of which it is on, as far as they go."""
    longest: list[Piece] = []
    links = _links(net, lane, edges[1]) if len(edges) > 1 else []
    for link in sorted(links, key=_swerve):
        pieces = [*link.via, *_onward(net, link.target, edges[1:])]
        longest = max(longest, pieces, key=len)
    return [_piece(lane), *longest]


def _continued(pieces: list[Piece], length_m: float) -> list[Piece]:
    """Return lanes with the last one continued straight on to a length of all of them."""
    missing_m = length_m - _length_m(pieces)
    if missing_m <= 0.0:
        return pieces
    last = pieces[-1]
    before, end = last.shape[-2:]
    # As SUMO draws the lane: a metre of it is this long in the plane.
    drawn_m = missing_m * sum(math.dist(a, b) for a, b in pairwise(last.shape)) / last.length_m
    share = drawn_m / math.dist(before, end)
    x, y, z = (e + share * (e - b) for b, e in zip(before, end, strict=True))
    longer = replace(last, length_m=last.length_m + missing_m, shape=(*last.shape, (x, y, z)))
    return [*pieces[:-1], longer]


def _length_m(pieces: Iterable[Piece]) -> float:
    return math.fsum(piece.length_m for piece in pieces)


def _placed(pieces: Iterable[Piece], start_m: float, before: Piece | None = None) -> list[Piece]:
    """Return pieces one after the other from a coordinate on; `before` is the piece before them."""
    placed = []
    for piece in pieces:
        shape = piece.shape
        if len(shape) == 1 and before is not None:
            # Drawn as a point, as some lanes inside of junctions: it points where the last one did.
            (x0, y0, _), (x1, y1, _) = before.shape[-2:]
            ahead = POINT_M / math.dist(*before.shape[-2:])
            x, y, z = shape[0]
            shape = (*shape, (x + ahead * (x1 - x0), y + ahead * (y1 - y0), z))
        before = replace(piece, start_m=start_m, shape=shape)
        placed.append(before)
        start_m += piece.length_m
    return placed


def _corners(shape: tuple[Point, ...]) -> tuple[Point, ...]:
    """Return a shape without points that repeat the one before."""
    return shape[:1] + tuple(b for a, b in pairwise(shape) if a != b)
