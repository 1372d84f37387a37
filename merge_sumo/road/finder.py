"""Find the merge in a net: the first lane that two sequences of edges have in common.

A driver on a lane that ends changes to the lane next to it. Its path over the junction follows the
connection of that lane. M is after the junction, as if the ending lane had a connection.

An acceleration lane of a scenario ends at a coordinate above 0. There the paths become one; before,
they are side by side, on lanes of the same edges.
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

from merge_sumo.errors import UserError, explained
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
VISIBILITY = "visibility"
"""Attribute of a connection: distance from which its driver sees the others, in m."""
POINT_M = 1e-6
"""Length at which a lane is drawn that the file draws as a point."""
NAME_LAST = "end both with the edge after the merge point"
INVALID = (AttributeError, IndexError, KeyError, TypeError, ValueError)
"""Errors of sumolib where a value of a net is missing or wrong."""
MAINLINE, RAMP = 0, 1
"""Indices of the paths in pairs."""


@dataclass(frozen=True, slots=True)
class RoadNet:
    """A net file.

    Attributes:
        path: the file.
        sha256: hash of its unpacked bytes: a packed net is the same road.
        net: its content, a `sumolib.net.Net`.

    Example:
        >>> read_net(default_net_path()).edges
        ['main_in', 'main_out', 'ramp']
    """

    path: Path
    sha256: str
    net: SumoNet

    @property
    def edges(self) -> list[str]:
        """Ids of the edges outside of junctions, sorted."""
        return sorted(edge.getID() for edge in self.net.getEdges(withInternal=False))


def read_net(path: Path, content: bytes | None = None) -> RoadNet:
    """Read a net with sumolib.

    sumolib gets the elements that `parse_xml` has checked and not the file, because it would
    resolve the entities of a file.

    Args:
        path: the net file.
        content: its unpacked bytes; None to read them from the file.

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
            f"{path} is not a SUMO net: it does not begin with <net>; convert a map with "
            "netconvert (`--osm-files`, `--opendrive-files`)"
        )
    reader = NetReader(withInternal=True)
    _feed(reader, root, path)
    return RoadNet(path, hashlib.sha256(content).hexdigest(), reader.getNet())


def _feed(reader: Any, element: etree._Element, path: Path) -> None:
    """Pass an element and those in it to a reader of sumolib."""
    try:
        reader.startElement(element.tag, element.attrib)
        if element.tag == "connection" and VISIBILITY in element.attrib:
            # sumolib ignores this attribute, and keeps parameters.
            visibility = float(element.attrib[VISIBILITY])
            reader.startElement("param", {"key": VISIBILITY, "value": visibility})
        for child in element:
            _feed(reader, child, path)
        reader.endElement(element.tag)
    except INVALID as error:
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

    Both sequences name the edge on which the paths become one, and may continue after it. Equal
    sequences are one path.

    Args:
        road_net: the net.
        mainline: ids of the edges of the mainline, in driving order.
        ramp: ids of the edges of the ramp, in driving order.
        room_after_m: minimum length after M, in m. Where the file ends before, the last lane is
            continued straight on.
        edge_at_m: the edge of a single path that begins at M; None for its last one.
        lane_m: begin and end of the acceleration lane of a scenario, in m. The lane of the road
            ends there, and may begin before. None where M is the only place to merge.

    Returns:
        The road.

    Raises:
        UserError: an edge is unknown, a sequence is not connected, the paths never meet, or the
            road has no such lane.

    Example:
        >>> net = read_net(default_net_path())
        >>> find_road(net, ["main_in", "main_out"], ["ramp", "main_out"]).ramp.before_m
        425.0
    """
    edges = tuple(mainline), tuple(ramp)
    try:
        with explained(f"the net {road_net.path} cannot host a merge"):
            return _road(road_net, edges, edge_at_m, room_after_m, lane_m)
    except INVALID as error:
        raise UserError(
            f"{road_net.path} is not a valid SUMO net ({error!r:.200}): convert it again with "
            "netconvert"
        ) from error


class _Link(NamedTuple):
    """A connection between lanes of two edges, or the change from a lane that ends."""

    source: SumoLane
    target: SumoLane
    via: tuple[Piece, ...]
    """The internal lanes in between."""
    state: str
    """SUMO's letter for the right of way: "M" goes first, "m" yields, "Z" is a zipper."""
    visibility_m: float | None
    """Distance from which its driver sees the others; None where the net does not say so."""
    connection: SumoConnection = None


_Edges = tuple[str, ...]
_Layer = dict[SumoLane, Any]
"""Lanes of an edge that a path can reach, each with the straightest `_Link` that leads to it; None
on the first edge."""
_Pieces = tuple[list[Piece], list[Piece]]
"""Lanes of mainline and ramp."""


class _Meeting(NamedTuple):
    """The links by which both paths come to their first common lane."""

    links: tuple[_Link, _Link]
    ending: int | None
    """The path of which a lane ends there."""
    edge: int
    """Index of the edge of the common lane, from the end of both paths: -1 is the last edge."""


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
    # Forwards: the lanes that each path can reach, edge by edge, up to the first common one.
    layers = []
    for before in own:
        layers.append(_layers(net, before + tail, len(before)))
    meeting = _meeting(net, tail, layers)
    # Backwards: the lanes that lead there, and forwards again those after it.
    main_link, ramp_link = meeting.links
    main = _lanes_before(layers[MAINLINE][: meeting.edge], main_link)
    ramp = _lanes_before(layers[RAMP][: meeting.edge], ramp_link)
    onward = _onward(net, ramp_link.target, tail[meeting.edge :])
    apart, along = _side_by_side(main, ramp)
    lane = _acceleration_lane(net, meeting, along, lane_m)
    begin_m = end_m = 0.0
    if lane_m is None:
        apart, along = ([*main, *main_link.via], [*ramp, *ramp_link.via]), ([], [])
    else:
        begin_m, end_m = _window(lane, lane_m)
        onward = [*main_link.via, *onward]
    # Lane coordinates: a path has its own lanes up to begin_m, those side by side up to end_m.
    placed = []
    for own_lanes, side_lanes in zip(apart, along, strict=True):
        pieces = _placed(own_lanes, begin_m - _length_m(own_lanes))
        pieces += _placed(side_lanes, begin_m, pieces[-1])
        shared = _placed(_continued(onward, room_after_m - end_m), end_m, pieces[-1])
        placed.append(LanePath((*pieces, *shared)))
    junction = ramp_link.source.getEdge().getToNode()
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
        used_lane_m=lane_m and (begin_m, end_m),
        acceleration_lane=lane,
    )


def _approach(junction: Any, meeting: _Meeting, path: int) -> Approach:
    """Return how a path comes to the junction at which it meets the other one."""
    link, other = meeting.links[path], meeting.links[1 - path]
    # Also for a lane that ends: a junction that the net lacks has no type.
    has_lights = junction.getType().startswith("traffic_light")
    if meeting.ending is not None:
        yields = path == meeting.ending
    elif has_lights:
        yields = path == RAMP
    else:
        yields = junction.forbids(other.connection, link.connection)
    return Approach(link.state, yields, link.visibility_m)


def _check_edge(road_net: RoadNet, name: str) -> None:
    """Raise `UserError` where a net has no such edge, or cars may not drive there."""
    net = road_net.net
    if not net.hasEdge(name) or net.getEdge(name).isSpecial():
        hint = meant(name, road_net.edges)
        raise UserError(f"it has no edge {name}: {hint}name edges of the net")
    if not _lanes(net, name):
        raise UserError(f"no lane of edge {name} is open to cars")


def _allows_cars(element: SumoLane | SumoConnection) -> bool:
    # To sumolib "all" is one more class.
    return bool(element.allows("passenger") or element.allows("all"))


def _lanes(net: SumoNet, edge: str) -> list[SumoLane]:
    """Return the lanes of an edge on which cars may drive, from the right."""
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
    """Return the links of a lane to the lanes of an edge on which cars may drive."""
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
        lane = net.getLane(name)
        pieces[name] = _piece(lane)
        connection = lane.getOutgoing()[0]
    return tuple(pieces.values())


def _side_by_side(main: list[Piece], ramp: list[Piece]) -> tuple[_Pieces, _Pieces]:
    """Return the lanes of both paths before an acceleration lane, and those along it.

    There are none of the second kind where the paths come to M without such a lane. Both paths have
    one coordinate along it, so the lanes of the ramp get the length of those of the mainline, from
    which they differ a little inside of junctions and where a net says so.
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
    """Return the indices of the pieces outside of junctions, the last one first."""
    indices = range(len(pieces) - 1, -1, -1)
    return [index for index in indices if not pieces[index].is_internal]


def _acceleration_lane(
    net: SumoNet, meeting: _Meeting, along: _Pieces, lane_m: Bounds | None
) -> AccelerationLane | None:
    """Return the acceleration lane of a road: it ends with that of a scenario, or at the junction.

    None where the paths are not side by side before M, or the lane that ends is the mainline's.
    """
    main, ramp = along
    if not ramp or meeting.ending == MAINLINE:
        return None
    end_m = lane_m[1] if lane_m else -_length_m(meeting.links[RAMP].via)
    lanes = [net.getLane(piece.lane) for piece in ramp]
    return AccelerationLane(
        begin_m=end_m - _length_m(main),
        end_m=end_m,
        lanes=tuple(piece.lane for piece in ramp if not piece.is_internal),
        is_marked=any(lane.isAccelerationLane() for lane in lanes),
    )


def _window(lane: AccelerationLane | None, lane_m: Bounds) -> Bounds:
    """Return begin and end of the road's lane; refuse a lane of a scenario that is longer."""
    if lane is None:
        raise UserError(
            "ramp and mainline meet at a point, without an acceleration lane: remove lane_m"
        )
    begin_m, end_m = lane_m
    if begin_m < lane.begin_m:
        low, high = lane_around_m(lane.length_m)
        raise UserError(
            f"lane_m is {begin_m:g} to {end_m:g}, {end_m - begin_m:g} m, but the acceleration "
            f"lane is {lane.length_m:.1f} m long: write lane_m = [{low:.1f}, {high:.1f}]"
        )
    return lane.begin_m, lane.end_m


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
                f"after edge {common} the mainline continues on {own} and the ramp on {other}; "
                "name the same edges after the merge point"
            )
    if on_main == 0 or on_ramp == 0:
        raise UserError(
            f"mainline or ramp begins with edge {common}, which both paths use: name an edge "
            "before it"
        )
    return (mainline[:on_main], ramp[:on_ramp]), max(tails, key=len)


def _layers(net: SumoNet, edges: _Edges, common: int) -> list[_Layer]:
    """Return the lanes that a path can reach on each of its edges.

    Args:
        net: the net.
        edges: ids of the edges of the path.
        common: number of edges before the first that the paths share. Up to that edge some lane
            must lead on; after it none has to.
    """
    layers: list[_Layer] = [dict.fromkeys(_lanes(net, edges[0]))]
    for number, (edge, following) in enumerate(pairwise(edges), start=1):
        layer: _Layer = {}
        for lane in layers[-1]:
            for link in _links(net, lane, following):
                straightest = layer.get(link.target, link)
                layer[link.target] = min(straightest, link, key=_swerve)
        if not layer and number <= common:
            raise UserError(
                f"edge {edge} does not lead to edge {following}: name the edges in between"
            )
        layers.append(layer)
    return layers


def _meeting(net: SumoNet, tail: _Edges, layers: list[list[_Layer]]) -> _Meeting:
    """Return the meeting of the paths: by connections, or where a lane of one of them ends.

    Args:
        net: the net.
        tail: ids of the edges that follow on both paths.
        layers: the lanes that mainline and ramp can reach, by path and edge.

    Raises:
        UserError: they have no lane in common.
    """
    for index, edge in enumerate(tail, start=-len(tail)):
        main, ramp = layers[MAINLINE][index], layers[RAMP][index]
        for lane in _lanes(net, edge):
            if lane in main and lane in ramp:
                return _Meeting((main[lane], ramp[lane]), None, index)
        if index > -len(tail):
            drop = _lane_drop(net, (layers[MAINLINE][index - 1], layers[RAMP][index - 1]), edge)
            if drop is not None:
                return _Meeting(*drop, index)
    raise UserError(
        f"mainline and ramp have no lane in common up to the end of edge {tail[-1]}: {NAME_LAST}"
    )


def _lane_drop(
    net: SumoNet, layers: tuple[_Layer, _Layer], following: str
) -> tuple[tuple[_Link, _Link], int] | None:
    """Return the links of both paths where a lane of one ends next to a lane of the other.

    Args:
        net: the net.
        layers: the lanes that mainline and ramp can reach on an edge.
        following: id of the next edge.

    Returns:
        The links, and the path whose lane ends; None where no such lane ends.
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
    via = neighbour.via
    if via:
        ends = last.getShape3D()[-1], neighbour.target.getShape3D()[0]
        via = (replace(via[0], length_m=_length_m(via), shape=_corners(ends)),)
    state = "Z" if last.getEdge().getToNode().getType() == "zipper" else "m"
    # A driver on it sees all along the lane next to it.
    return _Link(last, neighbour.target, via, state, visibility_m=last.getLength())


def _swerve(link: _Link) -> tuple[int, int]:
    """Order links: straight ones first, then from the right."""
    index = link.source.getIndex()
    return abs(index - link.target.getIndex()), index


def _lanes_before(layers: list[_Layer], last: _Link) -> list[Piece]:
    """Return the lanes from the first edge to the source of a link."""
    lane = last.source
    pieces = [_piece(lane)]
    for layer in layers[:0:-1]:
        link = layer[lane]
        lane = link.source
        pieces = [_piece(lane), *link.via, *pieces]
    return pieces


def _onward(net: SumoNet, lane: SumoLane, edges: _Edges) -> list[Piece]:
    """Return the longest sequence of lanes along edges that begins with a lane of the first one."""
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
    # As SUMO draws the lane: a metre of it is this long in the plane.
    drawn_m = missing_m * sum(math.dist(a, b) for a, b in pairwise(last.shape)) / last.length_m
    shape = (*last.shape, _ahead(last.shape[-1], last.shape, drawn_m))
    return [*pieces[:-1], replace(last, length_m=last.length_m + missing_m, shape=shape)]


def _ahead(point: Point, shape: tuple[Point, ...], length_m: float) -> Point:
    """Return the point at a distance from another one, in the direction in which a shape ends."""
    begin, end = shape[-2:]
    share = length_m / math.dist(begin, end)
    x, y, z = (at + share * (e - b) for at, b, e in zip(point, begin, end, strict=True))
    return x, y, z


def _length_m(pieces: Iterable[Piece]) -> float:
    return math.fsum(piece.length_m for piece in pieces)


def _placed(pieces: Iterable[Piece], start_m: float, before: Piece | None = None) -> list[Piece]:
    """Return pieces one after the other from a coordinate on.

    Args:
        pieces: lanes of a path.
        start_m: lane coordinate of the first one.
        before: the piece before them. A lane inside of a junction that is drawn as a point gets the
            direction of the piece before it.
    """
    placed = []
    for piece in pieces:
        shape = piece.shape
        if len(shape) == 1 and before is not None:
            shape = (*shape, _ahead(shape[0], before.shape, POINT_M))
        before = replace(piece, start_m=start_m, shape=shape)
        placed.append(before)
        start_m += piece.length_m
    return placed


def _corners(shape: tuple[Point, ...]) -> tuple[Point, ...]:
    """Return a shape without points that repeat the one before."""
    return shape[:1] + tuple(b for a, b in pairwise(shape) if a != b)
