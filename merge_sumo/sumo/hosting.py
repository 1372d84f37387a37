"""The net that SUMO hosts: copies of a road, each with the two paths of the merge alone.

A copy of a corridor has an edge for every lane of its paths: as long as that lane, with its speed
limit and its shape, and at M with the rules and the right of way of the junction. Lanes next to the
paths, other roads at junctions, and traffic lights are left out: nothing there could interfere.
An acceleration lane and the mainline next to it are two lanes of one edge, whatever their number of
edges in the file; the acceleration lane leads nowhere, so a driver has to change, and may anywhere.
Copies lie on top of each other in the plane; SUMO's drivers see along lanes and links only.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, groupby, pairwise
from typing import NamedTuple

from lxml import etree

from merge_sumo.road.corridor import Approach, Corridor, LanePath, Piece, Point
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
        roads = [lane for lane in self.lanes(copy) if not lane.startswith(":")]
        return [lane.rpartition("_")[0] for lane in roads]


def hosted_paths(road: Corridor) -> tuple[HostedPath, HostedPath]:
    """Return the paths of mainline and ramp."""
    main, ramp = map(_path, _hosted_lanes(road))
    return main, ramp


def _path(lanes: Sequence[_HostedLane]) -> HostedPath:
    return HostedPath(
        tuple(lane.lane for lane in lanes), tuple(lane.piece.start_m for lane in lanes)
    )


def hosted_net(road: Corridor, copies: int, *, lane_goes_on: bool = False) -> bytes:
    """Return the net with `copies` copies of a road.

    Args:
        road: the paths of mainline and ramp.
        copies: number of copies.
        lane_goes_on: whether the acceleration lane leads on, too. In a replay the record changes
            lanes, also in the step that crosses the end of the lane, and SUMO stops a vehicle at a
            dead end.
    """
    text = ['<net version="1.20">\n']
    # SUMO reads edges before the junctions that name their lanes, and connections last.
    elements = _elements(road, lane_goes_on=lane_goes_on)
    for tag in ("edge", "junction", "connection"):
        template = ""
        for element in elements:
            if element.tag == tag:
                template += etree.tostring(element, encoding="unicode") + "\n"
        text += [_numbered(template, k) for k in range(copies)]
    return "".join([*text, "</net>\n"]).encode()


def _numbered(text: str, copy: int) -> str:
    return text.replace(COPY, f".{copy}")


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
    def lane(self) -> str:
        return f"{self.edge}_{self.number}"


class _Hop(NamedTuple):
    """From a lane of a road over a junction to the next."""

    source: _HostedLane
    via: Sequence[_HostedLane]
    target: _HostedLane | None


def _hosted_lanes(road: Corridor) -> tuple[list[_HostedLane], list[_HostedLane]]:
    """Return the lanes of mainline and ramp; where the paths are one they are the same."""
    main = _lanes_of(road.mainline, "main", road.lane_m, number=1)
    ramp = _lanes_of(road.ramp, "main" if road.is_one_path else "ramp", road.lane_m, number=0)
    return main, ramp


def _lanes_of(
    path: LanePath, name: str, lane_m: Bounds | None, *, number: int
) -> list[_HostedLane]:
    """Return the lanes of a path; `number` is that of its lane along an acceleration lane."""
    begin_m, end_m = lane_m or (0.0, 0.0)
    before = [piece for piece in path.pieces if piece.start_m < begin_m]
    along = [piece for piece in path.pieces if begin_m <= piece.start_m < end_m]
    after = [piece for piece in path.pieces if piece.start_m >= end_m]
    lanes = [*_named(name, before, GORE if lane_m else AT_M)]
    if lane_m:
        # In one piece; with the limit that its driver is about to see: a ramp's may rise along it.
        shape = [point for point, _ in groupby(chain(*(piece.shape for piece in along)))]
        piece = Piece(
            along[0].lane, begin_m, end_m - begin_m, along[-1].speed_limit_mps, tuple(shape)
        )
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
    roads = [number for number, lane in enumerate(lanes) if not lane.piece.is_internal]
    for here, following in pairwise([*roads, len(lanes)]):
        if following < len(lanes) and lanes[here].leads_on:
            yield _Hop(lanes[here], lanes[here + 1 : following], lanes[following])
        elif following < len(lanes) and lane_goes_on:
            # From the end of the acceleration lane, next to the lanes of the mainline.
            inner, via, target = lanes[here + 1 : following], [], lanes[following]
            if inner:
                length_m = math.fsum(other.piece.length_m for other in inner)
                shape = (lanes[here].piece.shape[-1], target.piece.shape[0])
                piece = replace(inner[0].piece, length_m=length_m, shape=shape)
                via = [_HostedLane(f":{AT_M}_lane0", AT_M, piece)]
            yield _Hop(lanes[here], via, target)
        else:
            yield _Hop(lanes[here], [], None)


def _elements(road: Corridor, *, lane_goes_on: bool) -> list[etree._Element]:
    """Return the edges, junctions and connections of one copy, in any order."""
    elements: list[etree._Element] = []
    edges: dict[str, etree._Element] = {}
    arriving: dict[str, list[_Hop]] = {}
    main, ramp = _hosted_lanes(road)
    for name, lanes in [("main", main)] if road.is_one_path else [("ramp", ramp), ("main", main)]:
        behind = f"{name}-begin{COPY}"
        elements.append(_junction(behind, "dead_end", lanes[0].piece.shape[0], []))
        for hop in _hops(lanes, lane_goes_on=lane_goes_on):
            source = hop.source
            hops = arriving.setdefault(source.junction, [])
            if any(other.source.lane == source.lane for other in hops):
                break
            hops.append(hop)
            ends = {"from": behind, "to": source.junction}
            edges.setdefault(source.edge, _edge(source, ends)).append(_lane(source))
            for via in hop.via:
                edges[via.edge] = _edge(via, {"function": "internal"})
                edges[via.edge].append(_lane(via))
            behind = source.junction
    for name, hops in arriving.items():
        elements += _crossed(name, hops, road)
    return [*edges.values(), *elements]


def _crossed(name: str, hops: Sequence[_Hop], road: Corridor) -> Iterator[etree._Element]:
    """Yield a junction and its connections."""
    place = hops[0].source.piece.shape[-1]
    links = [hop for hop in hops if hop.target is not None]
    if len({hop.target for hop in links}) == len(links):
        yield _junction(name, "priority" if links else "dead_end", place, hops)
        for hop in links:
            yield from _connections(hop, None)
        return
    # Ramp and mainline lead to one lane: the rules of the road decide.
    approaches = (road.ramp_approach, road.mainline_approach)
    kind = road.junction_type if road.junction_type in KEPT_TYPES else "priority"
    yield _junction(name, kind, place, hops, [approach.yields for approach in approaches])
    for hop, approach in zip(hops, approaches, strict=True):
        yield from _connections(hop, approach)


def _edge(lane: _HostedLane, attributes: dict[str, str]) -> etree._Element:
    return etree.Element("edge", {"id": lane.edge, **attributes})


def _lane(lane: _HostedLane) -> etree._Element:
    piece = lane.piece
    numbers = {"length": f"{piece.length_m!r}", "speed": f"{piece.speed_limit_mps!r}"}
    shape = " ".join(",".join(map(repr, point)) for point in piece.shape)
    attributes = {"id": lane.lane, "index": str(lane.number), **numbers, "shape": shape}
    return etree.Element("lane", attributes | ({} if lane.leads_on else {"acceleration": "1"}))


def _junction(
    name: str, kind: str, place: Point, hops: Sequence[_Hop], yields: Sequence[bool] | None = None
) -> etree._Element:
    """Return a junction for hops; `yields` says of two to one lane which yields to the other."""
    x, y, _ = place
    junction = etree.Element(
        "junction",
        id=name,
        type=kind,
        x=repr(x),
        y=repr(y),
        incLanes=" ".join(hop.source.lane for hop in hops),
        intLanes=" ".join(hop.via[0].lane for hop in hops if hop.via),
        shape=f"{x!r},{y!r}",
    )
    links = sum(hop.target is not None for hop in hops)
    for index in range(links):
        # One character for each link, the first link last.
        foes = "0" * links if yields is None else ("10", "01")[index]
        response = foes if yields is not None and yields[index] else "0" * links
        request = {"index": str(index), "response": response, "foes": foes, "cont": "0"}
        etree.SubElement(junction, "request", request)
    return junction


def _connections(hop: _Hop, approach: Approach | None) -> Iterator[etree._Element]:
    """Yield the connections of a hop: from its road, and from every internal lane."""
    if hop.target is None:
        return
    sources = [hop.source, *hop.via]
    for number, source in enumerate(sources):
        lanes = {"fromLane": str(source.number), "toLane": str(hop.target.number)}
        attributes = {"from": source.edge, "to": hop.target.edge, **lanes}
        if number < len(hop.via):
            attributes["via"] = hop.via[number].lane
        state = "M"
        if approach is not None and number == 0:
            state = approach.state
            if state not in STATES:
                state = "m" if approach.yields else "M"
            if approach.visibility_m is not None:
                attributes["visibility"] = repr(approach.visibility_m)
        yield etree.Element("connection", {**attributes, "dir": "s", "state": state})
