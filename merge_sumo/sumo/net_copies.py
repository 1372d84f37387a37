"""The net that SUMO hosts: copies of a road, each with the two paths of the merge alone.

Copies lie on top of each other in the plane; SUMO's drivers see along lanes and links only.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import NamedTuple

from merge_sumo.road.road import LanePath, Piece, Point, Road
from merge_sumo.scenario.scenario import Bounds

COPY = "@"
"""Stands in an id for the number of the copy."""
AT_M = f"M{COPY}"
"""Where the paths become one, which is the end of the acceleration lane on a road with one."""
GORE = f"gore{COPY}"
END = f"end{COPY}"
LANE = f"lane{COPY}"
"""The edge of an acceleration lane and of the mainline next to it."""
KEPT_TYPES = (
    *("priority", "priority_stop", "allway_stop", "zipper", "unregulated"),
    *("right_before_left", "left_before_right"),
)
"""Junctions at M that keep their rules; others, as those with traffic lights, are "priority"."""
STATES = "MmZ=sw"
"""Rights of way that a link at M keeps; one with a traffic light yields, or not, without it."""


@dataclass(frozen=True, slots=True)
class HostedPath:
    """The lanes of a path in the hosted net, each of another edge, and where they begin."""

    lane_ids: tuple[str, ...]
    starts_m: tuple[float, ...]

    def lanes(self, copy: int) -> list[str]:
        """Return the ids of the lanes in a copy."""
        return [_numbered(lane, copy) for lane in self.lane_ids]

    def route(self, copy: int) -> list[str]:
        """Return the ids of the edges of a route in a copy."""
        edges = []
        for lane in self.lanes(copy):
            if not lane.startswith(":"):
                edges.append(lane.rpartition("_")[0])
        return edges


class _HostedLane(NamedTuple):
    edge: str
    junction: str
    """After the lane, or around it when it is internal."""
    piece: Piece
    number: int = 0
    """Among the lanes of its edge, from the right."""
    leads_on: bool = True
    """Whether a connection leads from it to the next lane of its path."""

    @property
    def id(self) -> str:
        return f"{self.edge}_{self.number}"

    def xml(self) -> str:
        piece, end = self.piece, "" if self.leads_on else ' acceleration="1"'
        points = [",".join(map(repr, point)) for point in piece.shape]
        shape = " ".join(points)
        return (
            f'<lane id="{self.id}" index="{self.number}" length="{piece.length_m!r}" '
            f'speed="{piece.speed_limit_mps!r}" shape="{shape}"{end}/>'
        )


class _Hop(NamedTuple):
    """From a lane of a road over a junction to the next."""

    source: _HostedLane
    via: Sequence[_HostedLane] = ()
    target: _HostedLane | None = None


def hosted_paths(road: Road) -> tuple[HostedPath, HostedPath]:
    """Return the paths of mainline and ramp."""
    main, ramp = map(_path, _hosted_lanes(road))
    return main, ramp


def _path(lanes: Sequence[_HostedLane]) -> HostedPath:
    starts_m = [lane.piece.start_m for lane in lanes]
    return HostedPath(tuple(lane.id for lane in lanes), tuple(starts_m))


def hosted_net(road: Road, copies: int, *, lane_goes_on: bool = False) -> bytes:
    """Return the net with `copies` copies of a road.

    A copy has an edge for every lane of the paths: as long as that lane, with its speed limit and
    its shape, and at M with the rules and the right of way of the junction. Lanes next to the
    paths, other roads at junctions, and traffic lights are left out: nothing there could interfere.
    An acceleration lane and the mainline next to it are two lanes of one edge, whatever their
    number of edges in the file; the acceleration lane leads nowhere, so a driver has to change, and
    may anywhere.

    Args:
        road: the paths of mainline and ramp.
        copies: number of copies.
        lane_goes_on: whether the acceleration lane leads on, too. In a replay the record changes
            lanes, also in the step that crosses the end of the lane, and SUMO stops a vehicle at a
            dead end.
    """
    edges: dict[str, list[str]] = {}
    junctions: list[str] = []
    arriving: dict[str, list[_Hop]] = {}
    main, ramp = _hosted_lanes(road)
    paths = {"ramp": ramp, "main": main}
    if road.is_one_path:
        del paths["ramp"]
    for name, lanes in paths.items():
        begin = f"{name}-begin{COPY}"
        junctions.append(_junction(begin, "dead_end", lanes[0].piece.shape[0]))
        for hop in _hops(lanes, lane_goes_on=lane_goes_on):
            source = hop.source
            hops = arriving.setdefault(source.junction, [])
            if source.id in [other.source.id for other in hops]:
                break  # from here on the paths are one
            hops.append(hop)
            head = f'<edge id="{source.edge}" from="{begin}" to="{source.junction}">'
            edges.setdefault(source.edge, [head]).append(source.xml())
            for via in hop.via:
                edges[via.edge] = [f'<edge id="{via.edge}" function="internal">', via.xml()]
            begin = source.junction
    connections: list[str] = []
    for name, hops in arriving.items():
        junction, links = _crossing(name, hops, road)
        junctions.append(junction)
        connections += links
    # SUMO reads edges before the junctions that name their lanes, and connections last.
    elements = ["".join((*lanes, "</edge>\n")) for lanes in edges.values()]
    template = "".join((*elements, *junctions, *connections))
    content = '<net version="1.20">\n'
    for copy in range(copies):
        content += _numbered(template, copy)
    return f"{content}</net>\n".encode()


def _numbered(text: str, copy: int) -> str:
    return text.replace(COPY, f".{copy}")


def _hosted_lanes(road: Road) -> tuple[list[_HostedLane], list[_HostedLane]]:
    """Return the lanes of mainline and ramp; where the paths are one they are the same."""
    main = _lanes_of(road.mainline, "main", road.used_lane_m, number=1)
    ramp = _lanes_of(road.ramp, "main" if road.is_one_path else "ramp", road.used_lane_m, number=0)
    return main, ramp


def _lanes_of(
    path: LanePath, name: str, lane_m: Bounds | None, *, number: int
) -> list[_HostedLane]:
    """Return the lanes of a path; `number` is that of its lane along an acceleration lane."""
    begin_m, end_m = lane_m or (0.0, 0.0)
    before, along, after = [], [], []
    for piece in path.pieces:
        if piece.start_m < begin_m:
            before.append(piece)
        elif piece.start_m < end_m:
            along.append(piece)
        else:
            after.append(piece)
    lanes = [*_named(name, before, GORE if lane_m else AT_M)]
    if lane_m:
        points: list[Point] = []
        for piece in along:
            points += piece.shape
        shape = tuple(point for point, _ in groupby(points))
        # In one piece; with the limit that its driver is about to see: a ramp's may rise along it.
        limit_mps = along[-1].speed_limit_mps
        piece = Piece(along[0].lane, begin_m, end_m - begin_m, limit_mps, shape)
        lanes.append(_HostedLane(LANE, AT_M, piece, number, leads_on=number > 0))
    return [*lanes, *_named("out", after, END, AT_M)]


def _named(
    name: str, pieces: Sequence[Piece], last: str, before: str = ""
) -> Iterator[_HostedLane]:
    """Yield lanes with ids, between the junctions `before` and `last`."""
    roads = sum(not piece.is_internal for piece in pieces)
    junction, road = before, 0
    for number, piece in enumerate(pieces):
        if piece.is_internal:
            # SUMO finds the junction between the colon and the last underscore.
            yield _HostedLane(f":{junction}_{name}{number}", junction, piece)
        else:
            road += 1
            junction = last if road == roads else f"{name}{road}-end{COPY}"
            yield _HostedLane(f"{name}{road}{COPY}", junction, piece)


def _hops(lanes: Sequence[_HostedLane], *, lane_goes_on: bool) -> Iterator[_Hop]:
    source, *others = lanes
    via: list[_HostedLane] = []
    for lane in others:
        if lane.piece.is_internal:
            via.append(lane)
            continue
        if not source.leads_on and via:
            # From the end of the acceleration lane, next to the lanes of the mainline.
            length_m = math.fsum(inner.piece.length_m for inner in via)
            shape = source.piece.shape[-1], lane.piece.shape[0]
            piece = replace(via[0].piece, length_m=length_m, shape=shape)
            via = [_HostedLane(f":{AT_M}_lane0", AT_M, piece)]
        if source.leads_on or lane_goes_on:
            yield _Hop(source, via, lane)
        else:
            yield _Hop(source)
        source, via = lane, []
    yield _Hop(source)


def _crossing(name: str, hops: Sequence[_Hop], road: Road) -> tuple[str, list[str]]:
    """Return a junction and its connections."""
    links: list[_Hop] = []
    targets: dict[str, _HostedLane] = {}
    for hop in hops:
        if hop.target is not None:
            links.append(hop)
            targets[hop.target.id] = hop.target
    kind = "priority" if links else "dead_end"
    is_merge = len(targets) < len(links)
    if is_merge and road.junction_type in KEPT_TYPES:
        kind = road.junction_type
    requests, connections = "", []
    for index, (source, inner, target) in enumerate(links):
        foes = response = "0" * len(links)
        state, sight = "M", ""
        if is_merge:
            # Ramp and mainline lead to one lane: the rules of the road decide.
            approach = (road.ramp_approach, road.mainline_approach)[index]
            # One character for each link, the first link last.
            foes = ("10", "01")[index]
            response = foes if approach.yields else response
            state = approach.state
            if state not in STATES:
                state = "m" if approach.yields else "M"
            if approach.visibility_m is not None:
                sight = f' visibility="{approach.visibility_m!r}"'
        requests += f'<request index="{index}" response="{response}" foes="{foes}" cont="0"/>'
        assert target is not None, "of each link"  # noqa: S101
        to = f'to="{target.edge}" toLane="{target.number}"'
        vias = [*(f' via="{lane.id}"' for lane in inner), ""]
        for lane, via in zip((source, *inner), vias, strict=True):
            connections.append(
                f'<connection from="{lane.edge}" fromLane="{lane.number}" {to}{via}{sight} dir="s" '
                f'state="{state}"/>\n'
            )
            state, sight = "M", ""  # inside the junction
    return _junction(name, kind, hops[0].source.piece.shape[-1], hops, requests), connections


def _junction(
    name: str, kind: str, place: Point, hops: Sequence[_Hop] = (), requests: str = ""
) -> str:
    ends = " ".join(hop.source.id for hop in hops)
    inner = " ".join(hop.via[0].id for hop in hops if hop.via)
    x, y, _ = place
    return (
        f'<junction id="{name}" type="{kind}" x="{x!r}" y="{y!r}" incLanes="{ends}" '
        f'intLanes="{inner}" shape="{x!r},{y!r}">{requests}</junction>\n'
    )
