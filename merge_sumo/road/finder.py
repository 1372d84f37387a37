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
from merge_sumo.road.corridor import (
    AccelerationLane,
    Approach,
    Corridor,
    LanePath,
    Piece,
    Point,
    lane_around_m,
)
from merge_sumo.road.xml_input import NET_TAGS, parse_xml, read_xml
from merge_sumo.scenario.scenario import ROOM_AFTER_M, Bounds

SumoLane = Any
SumoConnection = Any
SumoEdge = Any
"""Classes of sumolib, which has no types."""

FARTHEST_M = 2e7
"""Largest coordinate and length in a net: half way round the earth, in metres of UTM."""
SURROUNDINGS_M = 500.0
"""Distance to M up to which lanes next to the paths are drawn."""
VISIBILITY = "visibility"
"""Attribute of a connection: from how far its driver sees the others, in m."""
POINT_M = 1e-6
"""Length at which a lane is drawn that the file draws as a point."""
FOLLOWED_EDGES = 5
"""How many edges after those that a user names are searched for the merge."""
SHOWN_EDGES = 12
"""A net with at most as many edges names them all where one is unknown."""
MAP_OPTIONS = {"osm": "--osm-files", "OpenDRIVE": "--opendrive-files"}
"""Options by which netconvert reads a map, by the root of its file."""


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
    net: Any

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

    Raises:
        UserError: the file cannot be read, is not a SUMO net, or has a missing or wrong value.
    """
    from sumolib.net import NetReader  # late: other commands do not need it

    if content is None:
        content = read_xml(path, "the net")
    root = parse_xml(content, f"the net {path}", NET_TAGS)
    if root.tag != "net":
        option = MAP_OPTIONS.get(root.tag)
        how = f"; make one of it: `netconvert {option} {path} -o NAME.net.xml`"
        raise UserError(
            f"{path} is not a SUMO net: it does not begin with <net>{how if option else ''}"
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


class _NeverMeetError(UserError):
    """Two sequences of edges that do not come to one lane."""


def find_corridor(
    road_net: RoadNet,
    mainline: Sequence[str],
    ramp: Sequence[str],
    *,
    room_after_m: float = ROOM_AFTER_M,
    edge_at_m: str | None = None,
    lane_m: Bounds | None = None,
) -> Corridor:
    """Find the merge of two sequences of edges in a net.

    Both name the edge on which the paths become one, and may go on after it. Equal sequences are
    one path.

    Args:
        road_net: the net.
        mainline: edges of the mainline.
        ramp: edges of the ramp.
        room_after_m: where the file ends nearer after M, the last lane is continued straight on.
        edge_at_m: the edge of a single path that begins at M, by default its last one.
        lane_m: where a scenario has its acceleration lane: that of the road ends with it, and may
            begin before it.

    Raises:
        UserError: an edge is unknown, a sequence is not connected, the paths never meet, or the
            road has no such lane.
    """
    edges = tuple(mainline), tuple(ramp)
    try:
        try:
            paths = _paths(road_net, *edges, edge_at_m)
        except _NeverMeetError as error:
            raise UserError(f"{error}{_suggestion(road_net, *edges)}") from error
        return _corridor(road_net, edges, paths, room_after_m, lane_m)
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


class _Meeting(NamedTuple):
    """The links by which both paths come to their first common lane."""

    mainline: _Link
    ramp: _Link
    drop: _Link | None
    """The one of them that leaves a lane that ends."""
    place: int
    """Of the edge of the common lane, among the edges that follow on both paths."""


class _Paths(NamedTuple):
    """The lanes of mainline and ramp up to the junction at M, and those of both after it."""

    meeting: _Meeting
    before: tuple[list[Piece], list[Piece]]
    onward: list[Piece]


def _corridor(
    road_net: RoadNet,
    edges: tuple[_Edges, _Edges],
    paths: _Paths,
    room_after_m: float,
    lane_m: Bounds | None,
) -> Corridor:
    """Return the corridor of two paths."""
    meeting, before, onward = paths
    links = meeting.mainline, meeting.ramp
    junction = _junction(meeting.ramp.source)
    apart, along = _acceleration_lane(before)
    if lane_m is None:
        begin_m = end_m = 0.0
        apart = before[0] + [*links[0].via], before[1] + [*links[1].via]
        side_by_side: tuple[list[Piece], list[Piece]] = [], []
    else:
        begin_m, end_m = _window_m(meeting, _length_m(along[0]), lane_m)
        side_by_side = along
        onward = [*meeting.mainline.via, *onward]
    placed = []
    for own, side in zip(apart, side_by_side, strict=True):
        pieces = _placed(own, begin_m - _length_m(own))
        pieces += _placed(side, begin_m, pieces[-1])
        shared = _placed(_continued(onward, room_after_m - end_m), end_m, pieces[-1])
        placed.append(LanePath((*pieces, *shared)))
    used = {piece.lane for path in placed for piece in path.pieces}
    return Corridor(
        path=road_net.path,
        sha256=road_net.sha256,
        mainline_edges=edges[0],
        ramp_edges=edges[1],
        mainline=placed[0],
        ramp=placed[1],
        junction_type=junction.getType(),
        junction_id=junction.getID(),
        mainline_approach=_approach(meeting, links[0], links[1]),
        ramp_approach=_approach(meeting, links[1], links[0]),
        lane_drop=meeting.drop is not None,
        drawn_after_m=end_m + _length_m(onward),
        surroundings=_surroundings(road_net.net, shared[0].shape[0], used),
        lane_m=lane_m and (begin_m, end_m),
        acceleration_lane=_lane_of_road(road_net.net, meeting, along, end_m if lane_m else None),
    )


def _surroundings(net: Any, place: Point, used: set[str]) -> tuple[tuple[Point, ...], ...]:
    """Return the shapes of other lanes for vehicles that begin or end near a point."""
    roads: list[tuple[Point, ...]] = []
    internal: list[tuple[Point, ...]] = []
    for edge in net.getEdges(withInternal=True):
        if edge.getFunction() in ("crossing", "walkingarea"):
            continue
        for index, lane in enumerate(edge.getLanes()):
            ends = lane.getShape3D()[:1] + lane.getShape3D()[-1:]
            is_near = any(math.dist(end, place) <= SURROUNDINGS_M for end in ends)
            if is_near and f"{edge.getID()}_{index}" not in used:
                (internal if edge.isSpecial() else roads).append(_shape(lane))
    return (*roads, *internal)


def _junction(lane: SumoLane) -> Any:
    """Return the junction at the end of a lane."""
    junction = lane.getEdge().getToNode()
    if junction is None or junction.getType() is None:
        raise UserError(f"there is no junction at the end of lane {lane.getID()}")
    return junction


def _approach(meeting: _Meeting, link: _Link, other: _Link) -> Approach:
    """Return how the path of a link comes to the junction, where it meets the other one."""
    junction = _junction(meeting.ramp.source)
    if meeting.drop is not None:
        yields = link is meeting.drop
    elif junction.getType().startswith("traffic_light"):
        yields = link is meeting.ramp
    else:
        try:
            yields = junction.forbids(other.connection, link.connection)
        except (IndexError, KeyError) as error:
            raise UserError(f"junction {junction.getID()} has no right of way") from error
    return Approach(link.state, yields, link.visibility_m)


def _paths(
    road_net: RoadNet, mainline: _Edges, ramp: _Edges, edge_at_m: str | None = None
) -> _Paths:
    """Return the lanes of two sequences of edges, up to where they meet and from there on."""
    for edge in mainline + ramp:
        _check_edge(road_net, edge)
    net = road_net.net
    (own_main, own_ramp), tail = _split(net, mainline, ramp, edge_at_m)
    main_layers = _layers(net, own_main + tail, len(own_main))
    ramp_layers = _layers(net, own_ramp + tail, len(own_ramp))
    meeting = _meeting(net, tail, main_layers[len(own_main) :], ramp_layers[len(own_ramp) :])
    before = (
        _lanes_before(main_layers[: len(own_main) + meeting.place], meeting.mainline),
        _lanes_before(ramp_layers[: len(own_ramp) + meeting.place], meeting.ramp),
    )
    return _Paths(meeting, before, _onward(net, meeting.ramp.target, tail[meeting.place :]))


def _check_edge(road_net: RoadNet, name: str) -> None:
    """Raise `UserError` where a net has no such edge, or cars may not drive there."""
    net = road_net.net
    if not net.hasEdge(name) or net.getEdge(name).isSpecial():
        edges = road_net.edges
        few = f"it has {', '.join(edges)}" if 0 < len(edges) <= SHOWN_EDGES else ""
        hint = f"{meant(name, edges, 0.5)}{few}".strip()  # ids of edges are short
        raise UserError(f"it has no edge {name}{': ' if hint else ''}{hint}")
    lanes = _lanes(net.getEdge(name))
    if not lanes:
        raise UserError(f"no lane of edge {name} is open to cars")
    for lane in lanes:
        if len(_corners(_piece(lane).shape)) == 1:
            raise UserError(f"lane {lane.getID()} has no length")


def _allows_cars(found: SumoLane | SumoConnection) -> bool:
    # To sumolib "all" is one more class.
    return bool(found.allows("passenger") or found.allows("all"))


def _lanes(edge: SumoEdge) -> list[SumoLane]:
    """Return the lanes of an edge on which cars may drive."""
    return [lane for lane in edge.getLanes() if _allows_cars(lane)]


def _shape(lane: SumoLane) -> tuple[Point, ...]:
    """Return the shape of a lane, whose numbers are checked."""
    shape = tuple(lane.getShape3D())
    for number in chain((lane.getLength(), lane.getSpeed()), *shape):
        if not abs(number) <= FARTHEST_M:
            raise UserError(f"lane {lane.getID()} has {number}, not within {FARTHEST_M:g}")
    return shape


def _piece(lane: SumoLane) -> Piece:
    """Return a lane as a piece of a path, which begins at 0 until it is placed."""
    shape = _shape(lane)
    if lane.getLength() <= 0.0 or not shape:
        raise UserError(f"lane {lane.getID()} has no length")
    return Piece(lane.getID(), 0.0, lane.getLength(), lane.getSpeed(), shape)


def _links(net: Any, source: SumoLane, to_edge: str) -> list[_Link]:
    """Return the links of a lane to the lanes of an edge, as far as cars may drive there."""
    links = []
    for found in source.getOutgoing():
        target = found.getToLane()
        if found.getTo().getID() == to_edge and _allows_cars(target) and _allows_cars(found):
            via, visibility_m = _via(net, found), found.getParam(VISIBILITY)
            links.append(_Link(source, target, via, found.getState(), visibility_m, found))
    return links


def _via(net: Any, connection: SumoConnection) -> tuple[Piece, ...]:
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


def _edges_after(lane: SumoLane) -> list[str]:
    """Return the edges to which cars may drive from a lane, other than by turning back."""
    names = set()
    for found in lane.getOutgoing():
        is_open = _allows_cars(found) and _allows_cars(found.getToLane())
        turns_back = found.getDirection() in ("t", "T")
        if is_open and not turns_back and not found.getTo().isSpecial():
            names.add(found.getTo().getID())
    return sorted(names)


def _edges_before(net: Any, edge: str) -> list[str]:
    """Return the edges from which cars may drive to an edge, other than by turning back."""
    names = []
    for source in net.getEdge(edge).getIncoming():
        if not source.isSpecial() and any(edge in _edges_after(lane) for lane in _lanes(source)):
            names.append(source.getID())
    return sorted(names)


def _acceleration_lane(
    before: tuple[list[Piece], list[Piece]],
) -> tuple[tuple[list[Piece], list[Piece]], tuple[list[Piece], list[Piece]]]:
    """Return the lanes of both paths before an acceleration lane, and those side by side along it.

    There are none of the second kind where the paths come to M without such a lane. The ramp's get
    the length of the mainline's, from which they differ a little inside of junctions and where a
    net says so: both have one coordinate.
    """
    main, ramp = before
    on_main, on_ramp = len(main), len(ramp)
    for one, other in zip(_roads(main), _roads(ramp), strict=False):
        main_edge, _, main_index = main[one].lane.rpartition("_")
        ramp_edge, _, ramp_index = ramp[other].lane.rpartition("_")
        if main_edge != ramp_edge or abs(int(main_index) - int(ramp_index)) != 1:
            break
        on_main, on_ramp = one, other
    along_main, along_ramp = main[on_main:], ramp[on_ramp:]
    if along_ramp:
        stretch = _length_m(along_main) / _length_m(along_ramp)
        along_ramp = [replace(lane, length_m=lane.length_m * stretch) for lane in along_ramp]
    return (main[:on_main], ramp[:on_ramp]), (along_main, along_ramp)


def _roads(pieces: list[Piece]) -> list[int]:
    """Return the numbers of the pieces outside of junctions, the last one first."""
    return [number for number, piece in reversed([*enumerate(pieces)]) if not piece.is_internal]


def _lane_of_road(
    net: Any, meeting: _Meeting, along: tuple[list[Piece], list[Piece]], end_m: float | None
) -> AccelerationLane | None:
    """Return the acceleration lane of a road; by default it ends before the junction at M."""
    main, ramp = along
    if not ramp or meeting.drop is meeting.mainline:
        return None
    if end_m is None:
        end_m = -_length_m(meeting.ramp.via)
    lanes = [net.getLane(piece.lane) for piece in ramp]
    after = _edges_after(lanes[-1])
    return AccelerationLane(
        begin_m=end_m - _length_m(main),
        end_m=end_m,
        lanes=tuple(piece.lane for piece in ramp if not piece.is_internal),
        beside=tuple(piece.lane for piece in main if not piece.is_internal),
        is_marked=any(lane.isAccelerationLane() for lane in lanes),
        exits=tuple(edge for edge in after if edge != meeting.ramp.target.getEdge().getID()),
    )


def _window_m(meeting: _Meeting, length_m: float, lane_m: Bounds) -> Bounds:
    """Return begin and end of a lane, if that of a scenario, `lane_m`, is on it."""
    if meeting.drop is meeting.mainline:
        raise UserError("the lane that ends is that of the mainline, and lane_m is one of the ramp")
    if length_m == 0.0:
        raise UserError(
            "ramp and mainline meet in one point, without a lane side by side: leave lane_m out"
        )
    begin_m, end_m = lane_m
    if begin_m < end_m - length_m:
        low, high = lane_around_m(length_m)
        raise UserError(
            f"lane_m is {begin_m:g} to {end_m:g}, {end_m - begin_m:g} m, and the acceleration lane "
            f"is {length_m:.1f} m long: write lane_m = [{low:.1f}, {high:.1f}]"
        )
    return end_m - length_m, end_m


def _split(
    net: Any, mainline: _Edges, ramp: _Edges, edge_at_m: str | None
) -> tuple[tuple[_Edges, _Edges], _Edges]:
    """Return the edges that each path has for itself, and those that follow on both."""
    if mainline == ramp and len(ramp) > 1:
        before = ramp.index(edge_at_m or ramp[-1])
        return (ramp[:before], ramp[:before]), ramp[before:]
    common = next((edge for edge in ramp if edge in mainline), None)
    if common is None:
        raise _NeverMeetError(
            f"mainline ({' '.join(mainline)}) and ramp ({' '.join(ramp)}) never meet"
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
        free = [name for name in _edges_before(net, common) if name not in mainline + ramp]
        raise UserError(
            f"the {'mainline' if on_main == 0 else 'ramp'} begins with edge {common}, which the "
            f"other path uses too; name an edge before it: {' or '.join(free) or 'there is none'}"
        )
    return (mainline[:on_main], ramp[:on_ramp]), max(tails, key=len)


def _suggestion(road_net: RoadNet, mainline: _Edges, ramp: _Edges) -> str:
    """Return what to name instead of two paths that never meet: a few edges more, if that helps."""
    mainlines, ramps = _lengthened(road_net.net, mainline), _lengthened(road_net.net, ramp)
    pairs = [(mainlines[edge], ramps[edge]) for edge in mainlines if edge in ramps]
    for longer in sorted(pairs, key=lambda pair: (len(pair[0]) + len(pair[1]), pair)):
        try:
            meeting = _paths(road_net, *longer).meeting
        except _NeverMeetError:
            continue
        except UserError as error:
            return f"; {error}"
        # A lane of the mainline that leads elsewhere does not end.
        if meeting.drop is not meeting.mainline or not _edges_after(meeting.mainline.source):
            return f'; name "{" ".join(longer[0])}" and "{" ".join(longer[1])}"'
    return (
        f", nor do they within {FOLLOWED_EDGES} edges more: name the edge after the merge point as "
        "the last one of both"
    )


def _lengthened(net: Any, path: _Edges) -> dict[str, _Edges]:
    """Return the edges that a path comes to, each with the path that leads there."""
    reached = dict.fromkeys(path, path)
    latest = [path] if path else []
    for _ in range(FOLLOWED_EDGES):
        longer = []
        for edges in latest:
            for lane in _lanes(net.getEdge(edges[-1])):
                for name in _edges_after(lane):
                    if name not in reached:
                        reached[name] = (*edges, name)
                        longer.append(reached[name])
        latest = longer
    return reached


def _layers(net: Any, edges: _Edges, common: int) -> list[_Layer]:
    """Return the lanes that a path can reach on each of its edges.

    A lane of its own must lead to edge number `common`; after that its lanes may end.
    """
    layers: list[_Layer] = [{lane: [] for lane in _lanes(net.getEdge(edges[0]))}]
    for number, (edge, following) in enumerate(pairwise(edges), start=1):
        layer: _Layer = {}
        for lane in layers[-1]:
            for link in _links(net, lane, following):
                layer.setdefault(link.target, []).append(link)
        if not layer and number <= common:
            into = [name for name in _edges_before(net, following) if name != edge]
            hint = f"; name {' or '.join(into)} before it" if into else ""
            raise UserError(f"edge {edge} does not lead to edge {following}{hint}")
        layers.append(layer)
    return layers


def _meeting(net: Any, tail: _Edges, mainline: list[_Layer], ramp: list[_Layer]) -> _Meeting:
    """Return the meeting of the paths: by connections, or where a lane of one of them ends.

    Args:
        net: the net.
        tail: the edges that follow on both paths.
        mainline: for each of these the lanes that the mainline can reach.
        ramp: those that the ramp can reach.

    Raises:
        UserError: they have no lane in common.
    """
    for place, edge in enumerate(tail):
        for lane in _lanes(net.getEdge(edge)):
            if lane in mainline[place] and lane in ramp[place]:
                to_both = [
                    min(layer[lane], key=_swerve) for layer in (mainline[place], ramp[place])
                ]
                return _Meeting(to_both[0], to_both[1], drop=None, place=place)
        if place + 1 < len(tail) and not mainline[place + 1].keys() & ramp[place + 1].keys():
            found = _lane_drop(net, mainline[place], ramp[place], tail[place + 1])
            if found is not None:
                return _Meeting(*found, place=place + 1)
    raise _NeverMeetError(
        f"mainline and ramp have no lane in common up to the end of edge {tail[-1]}"
    )


def _lane_drop(
    net: Any, mainline: _Layer, ramp: _Layer, following: str
) -> tuple[_Link, _Link, _Link] | None:
    """Return the links of both paths where a lane of one ends next to a lane of the other.

    The third one is the link, of these two, of the path whose lane ends. `following` is the edge
    after that on which it ends; None where no such lane ends.
    """
    for ending, going in ((ramp, mainline), (mainline, ramp)):
        for last, neighbour in product(ending, going):
            onward = _links(net, neighbour, following)
            is_next = abs(last.getIndex() - neighbour.getIndex()) == 1
            if is_next and onward and not _links(net, last, following):
                drop = _drop(last, onward[0])
                return (onward[0], drop, drop) if ending is ramp else (drop, onward[0], drop)
    return None


def _drop(last: SumoLane, neighbour: _Link) -> _Link:
    """Return the link from a lane that ends to the target of a link of the lane next to it."""
    via: tuple[Piece, ...] = ()
    if neighbour.via:
        ends = last.getShape3D()[-1], neighbour.target.getShape3D()[0]
        via = (replace(neighbour.via[0], length_m=_length_m(neighbour.via), shape=ends),)
    state = "Z" if _junction(last).getType() == "zipper" else "m"
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
        link = min(layer[lane], key=_swerve)
        lane = link.source
        pieces = [_piece(lane), *link.via, *pieces]
    return pieces


def _onward(net: Any, lane: SumoLane, edges: _Edges) -> list[Piece]:
    """Return the lanes from one on along edges, the first of which it is on, as far as they go."""
    longest: list[Piece] = []
    links = _links(net, lane, edges[1]) if len(edges) > 1 else []
    for link in sorted(links, key=lambda link: _swerve(link)[0]):
        pieces = [*link.via, *_onward(net, link.target, edges[1:])]
        longest = max(longest, pieces, key=len)
    return [_piece(lane), *longest]


def _continued(pieces: list[Piece], length_m: float) -> list[Piece]:
    """Return lanes with the last one continued straight on to a length of all of them."""
    missing_m = length_m - _length_m(pieces)
    if missing_m <= 0.0:
        return pieces
    last = pieces[-1]
    before, end = _corners(last.shape)[-2:]
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
        shape = _corners(piece.shape)
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
