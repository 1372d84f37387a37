"""Finding the merge in a net: where two sequences of edges come to one lane.

Where the ramp ends in an auxiliary lane from which no connection leads on, the driver changes to
the lane next to it where the auxiliary lane ends. The path then crosses the junction next to the
connection of that lane, as if the net had a connection of its own for it, and M is behind the
junction, where it is in a net that has one. The same holds where the lane of the mainline ends.

A scenario with an acceleration lane says where M is along it: the paths become one where the lane
ends, at a coordinate above 0, and before that they run side by side, on lanes of the same edges.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise, permutations, product
from typing import Final, NamedTuple

from merge_sumo.road.corridor import (
    AccelerationLane,
    Approach,
    Corridor,
    LanePath,
    Piece,
    lane_around_m,
)
from merge_sumo.road.netfile import Lane, Link, NetFile, Point
from merge_sumo.scenario.scenario import ROOM_AFTER_M, Bounds

SURROUNDINGS_M: Final = 500.0
"""Distance to M up to which lanes next to the paths are drawn."""
POINT_M: Final = 1e-6
"""Length at which a lane is drawn that the file draws as a point."""
FOLLOWED_EDGES: Final = 5
"""How many edges behind those that a user names are searched for where both paths meet."""


def find_corridor(
    net: NetFile,
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
        net: the net.
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
    meeting, before, onward = _paths(net, tuple(mainline), tuple(ramp), edge_at_m)
    apart, along = _acceleration_lane(meeting, before)
    length_m = _length_m(along[0])
    beside: list[list[Lane]] = [[], []]
    begin_m = end_m = 0.0
    if lane_m is not None:
        begin_m, end_m = _window_m(net, meeting, length_m, lane_m)
        before, beside, onward = apart, along, [*meeting.mainline.via, *onward]
    paths = []
    for own, side in zip(before, beside, strict=True):
        pieces = _placed(net, own, begin_m - _length_m(own))
        pieces += _placed(net, side, begin_m, pieces[-1])
        shared = _placed(net, _continued(onward, room_after_m - end_m), end_m, pieces[-1])
        paths.append(LanePath((*pieces, *shared)))
    junction_id, junction_type = net.junction(meeting.ramp.source)
    mainline_approach, ramp_approach = _approaches(net, meeting, junction_type)
    used = {piece.lane for path in paths for piece in path.pieces}
    near = net.lanes_near(shared[0].shape[0], SURROUNDINGS_M)
    return Corridor(
        path=net.path,
        sha256=net.sha256,
        mainline_edges=tuple(mainline),
        ramp_edges=tuple(ramp),
        mainline=paths[0],
        ramp=paths[1],
        junction_type=junction_type,
        junction_id=junction_id,
        mainline_approach=mainline_approach,
        ramp_approach=ramp_approach,
        lane_drop=meeting.drop is not None,
        drawn_after_m=end_m + _length_m(onward),
        surroundings=tuple(lane.shape for lane in near if lane.id not in used),
        lane_m=lane_m and (begin_m, end_m),
        acceleration_lane=_lane_of_road(net, meeting, along, end_m if lane_m else None),
    )


def _approaches(net: NetFile, meeting: _Meeting, junction_type: str) -> list[Approach]:
    """Return how mainline and ramp come to the junction."""
    approaches = []
    for link, other in permutations((meeting.mainline, meeting.ramp)):
        if meeting.drop is not None:
            yields = link is meeting.drop
        elif junction_type.startswith("traffic_light"):
            yields = link is meeting.ramp
        else:
            yields = net.yields(link, other)
        approaches.append(Approach(link.state, yields, link.visibility_m))
    return approaches


_Edges = tuple[str, ...]
_Layer = dict[str, list[Link]]
"""Lanes of an edge that a path can reach, by their ids, each with the links that lead to it."""


class _Meeting(NamedTuple):
    """The links by which both paths come to their first common lane."""

    mainline: Link
    ramp: Link
    drop: Link | None
    """The one of them that leaves a lane that ends."""
    place: int
    """Of the edge of the common lane, among the edges behind the paths' own."""

    @property
    def target(self) -> Lane:
        """The common lane."""
        return self.ramp.target


def _paths(
    net: NetFile, mainline: _Edges, ramp: _Edges, edge_at_m: str | None = None
) -> tuple[_Meeting, list[list[Lane]], list[Lane]]:
    """Return the meeting of the paths, the lanes of both before it, and those behind."""
    own, tail = _split(net, mainline, ramp, edge_at_m)
    layers = [_layers(net, edges + tail, len(edges)) for edges in own]
    meeting = _meeting(net, own, tail, layers)
    before = [
        _lanes_before(path[: len(edges) + meeting.place], link)
        for edges, path, link in zip(own, layers, (meeting.mainline, meeting.ramp), strict=True)
    ]
    return meeting, before, _onward(net, meeting.target, tail[meeting.place :])


def _acceleration_lane(
    meeting: _Meeting, before: list[list[Lane]]
) -> tuple[list[list[Lane]], list[list[Lane]]]:
    """Return the lanes of both paths before an acceleration lane, and those side by side along it.

    There are none of the second kind where the paths come to M without such a lane. The ramp's get
    the length of the mainline's, from which they differ a little inside of junctions and where a
    net says so: both have one coordinate.
    """
    main, ramp = (
        lanes[: len(lanes) - len(link.via)]
        for lanes, link in zip(before, (meeting.mainline, meeting.ramp), strict=True)
    )
    roads = [[n for n, lane in enumerate(lanes) if not lane.is_internal] for lanes in (main, ramp)]
    on_main, on_ramp = len(main), len(ramp)
    for one, other in zip(*map(reversed, roads), strict=False):
        if main[one].edge != ramp[other].edge or abs(main[one].index - ramp[other].index) != 1:
            break
        on_main, on_ramp = one, other
    beside = main[on_main:], ramp[on_ramp:]
    if beside[1]:
        stretch = _length_m(beside[0]) / _length_m(beside[1])
        beside[1][:] = [replace(lane, length_m=lane.length_m * stretch) for lane in beside[1]]
    return [main[:on_main], ramp[:on_ramp]], [*beside]


def _lane_of_road(
    net: NetFile, meeting: _Meeting, along: list[list[Lane]], end_m: float | None
) -> AccelerationLane | None:
    """Return the acceleration lane of a road; by default it ends before the junction at M."""
    main, ramp = along
    if not ramp or meeting.drop is meeting.mainline:
        return None
    if end_m is None:
        end_m = -_length_m(meeting.ramp.via)
    return AccelerationLane(
        begin_m=end_m - _length_m(main),
        end_m=end_m,
        lanes=tuple(lane.id for lane in ramp if not lane.is_internal),
        beside=tuple(lane.id for lane in main if not lane.is_internal),
        is_marked=any(lane.is_marked for lane in ramp),
        exits=tuple(edge for edge in net.edges_from(ramp[-1]) if edge != meeting.target.edge),
    )


def _window_m(net: NetFile, meeting: _Meeting, length_m: float, lane_m: Bounds) -> Bounds:
    """Return begin and end of a lane, if that of a scenario, `lane_m`, is on it."""
    if meeting.drop is meeting.mainline:
        raise net.broken(
            "the lane that ends is that of the mainline, and lane_m is one of the ramp"
        )
    if length_m == 0.0:
        raise net.broken(
            "ramp and mainline meet in one point, without a lane side by side: leave lane_m out"
        )
    begin_m, end_m = lane_m
    if begin_m < end_m - length_m:
        low, high = lane_around_m(length_m)
        raise net.broken(
            f"lane_m is {begin_m:g} to {end_m:g}, {end_m - begin_m:g} m, and the acceleration lane "
            f"is {length_m:.1f} m long: write lane_m = [{low:.1f}, {high:.1f}]"
        )
    return end_m - length_m, end_m


def _split(
    net: NetFile, mainline: _Edges, ramp: _Edges, edge_at_m: str | None
) -> tuple[tuple[_Edges, _Edges], _Edges]:
    """Return the edges that each path has for itself, and those that follow on both."""
    for edge in mainline + ramp:
        net.lanes(edge)
    if mainline == ramp and len(ramp) > 1:
        before = ramp.index(edge_at_m or ramp[-1])
        return (ramp[:before], ramp[:before]), ramp[before:]
    common = next((edge for edge in ramp if edge in mainline), None)
    if common is None:
        raise net.broken(
            f"mainline ({' '.join(mainline)}) and ramp ({' '.join(ramp)}) never meet"
            f"{_how_they_meet(net, mainline, ramp)}"
        )
    # A mainline may go round a ring and come by the edge again.
    again = common in mainline[1:]
    at = mainline.index(common, 1) if again else 0, ramp.index(common)
    tails = mainline[at[0] :], ramp[at[1] :]
    for own, other in zip(*tails, strict=False):
        if own != other:
            raise net.broken(
                f"behind edge {common} the mainline goes to {own} and the ramp to {other}; name "
                "the same edges behind the merge point"
            )
    if 0 in at:
        who = "mainline" if at[0] == 0 else "ramp"
        raise net.broken(
            f"the {who} begins with edge {common}, which the other path uses too; "
            f"{_edges_before(net, common, mainline + ramp)}"
        )
    return (mainline[: at[0]], ramp[: at[1]]), max(tails, key=len)


def _how_they_meet(net: NetFile, mainline: _Edges, ramp: _Edges) -> str:
    """Return what to name instead of two paths that never meet: few edges more, if that helps."""
    onward: list[dict[str, _Edges]] = []
    for path in (mainline, ramp):
        reached = dict.fromkeys(path[1:], path)  # the merge is behind the first one
        latest = [path] if path else []
        for _ in range(FOLLOWED_EDGES):
            latest = [(*edges, name) for edges in latest for name in _following(net, edges[-1])]
            latest = [edges for edges in latest if edges[-1] not in reached]
            reached = {edges[-1]: edges for edges in reversed(latest)} | reached
        onward.append(reached)
    mainlines, ramps = onward
    pairs = [(mainlines[edge], ramps[edge]) for edge in mainlines if edge in ramps]
    # A path that begins with the common edge has no lane before the merge.
    both = [pair for pair in pairs if not {path[0] for path in pair} & set(pair[0]) & set(pair[1])]
    if both:
        mainline, ramp = min(both, key=lambda pair: (len(pair[0]) + len(pair[1]), pair))
        edge = next(edge for edge in ramp if edge in mainline)
        return f'; both lead to edge {edge}: name "{" ".join(mainline)}" and "{" ".join(ramp)}"'
    for who, path, other, reached in (
        ("mainline", mainline, "ramp", ramps),
        ("ramp", ramp, "mainline", mainlines),
    ):
        if path and path[0] in reached:
            return (
                f"; the {other} leads to edge {path[0]}, with which the {who} begins: "
                f"{_edges_before(net, path[0], reached[path[0]])}"
            )
    return (
        f", nor do they within {FOLLOWED_EDGES} edges more: name the edge behind the merge point "
        "as the last one of both"
    )


def _edges_before(net: NetFile, edge: str, used: _Edges) -> str:
    """Return which edges to name before one: those that lead to it and are in no path yet."""
    free = [name for name in net.edges_into(edge) if name not in used]
    return f"name an edge before it: {' or '.join(free) or 'the net has no other'}"


def _following(net: NetFile, edge: str) -> list[str]:
    """Return the edges to which lanes of an edge lead that cars may drive on."""
    names = {name for lane in net.lanes(edge) for name in net.edges_from(lane)}
    return sorted(name for name in names if net.is_open_to_cars(name))


def _layers(net: NetFile, edges: _Edges, common: int) -> list[_Layer]:
    """Return the lanes that a path can reach on each of its edges.

    A lane of its own must lead to edge number `common`; behind that its lanes may end.
    """
    lanes = {lane.id: lane for lane in net.lanes(edges[0])}
    layers: list[_Layer] = [{name: [] for name in lanes}]
    for number, (edge, following) in enumerate(pairwise(edges), start=1):
        layer: _Layer = {}
        for lane in lanes.values():
            for link in net.links(lane, following):
                layer.setdefault(link.target.id, []).append(link)
        if not layer and number <= common:
            into = [name for name in net.edges_into(following) if name != edge]
            does = "does" if len(into) == 1 else "do"
            hint = f"; {' and '.join(into)} {does}" if into else ""
            raise net.broken(f"edge {edge} does not lead to edge {following}{hint}")
        lanes = {links[0].target.id: links[0].target for links in layer.values()}
        layers.append(layer)
    return layers


def _meeting(
    net: NetFile, own: tuple[_Edges, _Edges], tail: _Edges, layers: list[list[_Layer]]
) -> _Meeting:
    """Return the meeting of the paths; where they have none, say what follows on them."""
    if (found := _met(net, own, tail, layers)) is not None:
        return found
    last, reason = tail[-1], "mainline and ramp have no lane in common up to the end of edge"
    ends = {lane.id: lane for lane in net.lanes(last)}
    main_to, ramp_to = (
        " or ".join(sorted({name for id_ in path[-1] for name in net.edges_from(ends[id_])}))
        for path in layers
    )
    leads = (
        f"the ramp's lane leads to {ramp_to or 'no edge'} and the mainline's to "
        f"{main_to or 'no edge'}"
    )
    onward: list[_Edges] = [()]
    for _ in range(FOLLOWED_EDGES):
        onward = [
            (*edges, name) for edges in onward for name in _following(net, (last, *edges)[-1])
        ]
        for edges in onward:
            whole = [_layers(net, one + tail + edges, len(one)) for one in own]
            found = _met(net, own, tail + edges, whole)
            if found is not None and not (
                # Where the mainline leads elsewhere, its lane does not end.
                found.drop is found.mainline and net.edges_from(found.mainline.source)
            ):
                what = "the edge that follows" if len(edges) == 1 else "the edges that follow"
                raise net.broken(
                    f"{reason} {last}: {leads}; name {what} on both: {' '.join(edges)}"
                )
    raise net.broken(
        f"{reason} {last}: {leads}, and up to {FOLLOWED_EDGES} edges on they come to no common "
        "lane, so no merge is needed there"
    )


def _met(
    net: NetFile, own: tuple[_Edges, _Edges], tail: _Edges, layers: list[list[_Layer]]
) -> _Meeting | None:
    """Return the meeting of the paths: by connections, or where a lane of one of them ends."""
    mainline, ramp = (path[len(edges) :] for path, edges in zip(layers, own, strict=True))
    for place, edge in enumerate(tail):
        common = mainline[place].keys() & ramp[place].keys()
        both = [lane.id for lane in net.lanes(edge) if lane.id in common]
        if both:
            to_both = [min(path[place][both[0]], key=_swerve) for path in (mainline, ramp)]
            return _Meeting(to_both[0], to_both[1], drop=None, place=place)
        if place + 1 == len(tail) or mainline[place + 1].keys() & ramp[place + 1].keys():
            continue
        links = _lane_drop(net, mainline[place], ramp[place], tail[place : place + 2])
        if links is not None:
            return _Meeting(*links, place=place + 1)
    return None


def _lane_drop(
    net: NetFile, mainline: _Layer, ramp: _Layer, edges: _Edges
) -> tuple[Link, Link, Link] | None:
    """Return the links of both paths where a lane of one ends next to a lane of the other.

    The third one is the link, of these two, of the path whose lane ends. `edges` are the edge on
    which it ends and the one that follows; None where no such lane ends.
    """
    lanes = {lane.id: lane for lane in net.lanes(edges[0])}
    for ending, going in ((ramp, mainline), (mainline, ramp)):
        for last, beside in product([lanes[id_] for id_ in ending], [lanes[id_] for id_ in going]):
            onward = net.links(beside, edges[1])
            if onward and not net.links(last, edges[1]) and abs(last.index - beside.index) == 1:
                drop = _drop(net, last, onward[0])
                return (onward[0], drop, drop) if ending is ramp else (drop, onward[0], drop)
    return None


def _drop(net: NetFile, last: Lane, beside: Link) -> Link:
    """Return the link from a lane that ends to the target of a link of the lane next to it."""
    via: tuple[Lane, ...] = ()
    if beside.via:
        crossing = replace(
            beside.via[0],
            length_m=_length_m(beside.via),
            shape=(last.shape[-1], beside.target.shape[0]),
        )
        via = (crossing,)
    state = "Z" if net.junction(last)[1] == "zipper" else "m"
    # A driver on it sees all along the lane next to it.
    return Link(last, beside.target, via, state, visibility_m=last.length_m)


def _swerve(link: Link) -> tuple[int, int]:
    """Order links: straight ones first, then from the right."""
    return abs(link.source.index - link.target.index), link.source.index


def _lanes_before(layers: list[_Layer], last: Link) -> list[Lane]:
    """Return the lanes that lead over a link, from the first edge to before its target."""
    lanes = [*reversed(last.via), last.source]
    for layer in layers[:0:-1]:
        link = min(layer[lanes[-1].id], key=_swerve)
        lanes += [*reversed(link.via), link.source]
    return lanes[::-1]


def _onward(net: NetFile, first: Lane, edges: _Edges) -> list[Lane]:
    """Return the lanes from one on along edges, the first of which it is on, as far as they go."""

    @cache
    def longest(lane: Lane, place: int) -> tuple[Lane, ...]:
        following: tuple[Lane, ...] = ()
        links = net.links(lane, edges[place + 1]) if place + 1 < len(edges) else []
        for link in sorted(links, key=lambda link: abs(link.source.index - link.target.index)):
            lanes = (*link.via, *longest(link.target, place + 1))
            following = max(following, lanes, key=len)
        return (lane, *following)

    return list(longest(first, 0))


def _continued(lanes: list[Lane], length_m: float) -> list[Lane]:
    """Return lanes with the last one continued straight on to a length of all of them."""
    missing_m = length_m - _length_m(lanes)
    if missing_m <= 0.0:
        return lanes
    last = lanes[-1]
    before, end = _corners(last.shape)[-2:]
    # As SUMO draws the lane: a metre of it is this long in the plane.
    drawn_m = missing_m * last.drawn_m / last.length_m
    share = drawn_m / math.dist(before, end)
    x, y, z = (e + share * (e - b) for b, e in zip(before, end, strict=True))
    longer = replace(last, length_m=last.length_m + missing_m, shape=(*last.shape, (x, y, z)))
    return [*lanes[:-1], longer]


def _length_m(lanes: Iterable[Lane]) -> float:
    return math.fsum(lane.length_m for lane in lanes)


def _placed(
    net: NetFile, lanes: Iterable[Lane], start_m: float, behind: Piece | None = None
) -> list[Piece]:
    """Return lanes as pieces of a path that begins at a coordinate, behind another piece."""
    pieces = [] if behind is None else [behind]
    for lane in lanes:
        shape = _corners(lane.shape)
        if lane.length_m <= 0.0 or not shape:
            raise net.broken(f"lane {lane.id} has no length")
        if len(shape) == 1:
            # Drawn as a point, as some lanes inside of junctions: it points where the last one did.
            before, end = pieces[-1].shape[-2:]
            ahead = POINT_M / math.dist(before, end)
            (x, y, z), (dx, dy) = shape[0], (end[0] - before[0], end[1] - before[1])
            shape = (*shape, (x + ahead * dx, y + ahead * dy, z))
        pieces.append(Piece(lane.id, start_m, lane.length_m, lane.speed_limit_mps, shape))
        start_m += lane.length_m
    return pieces if behind is None else pieces[1:]


def _corners(shape: tuple[Point, ...]) -> tuple[Point, ...]:
    """Return a shape without points that repeat the one before."""
    return shape[:1] + tuple(b for a, b in pairwise(shape) if a != b)
