"""The net that SUMO hosts: copies of a road, each with the two paths of the merge alone.

A copy of a corridor has an edge for every lane of its paths: as long as that lane, with its speed
limit and its shape, and at M with the rules and the right of way of the junction. Lanes beside the
paths, other roads at junctions, and traffic lights are left out: nothing there could interfere.
Copies lie on top of each other in the plane; SUMO's drivers see along lanes and links only.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, NamedTuple

from lxml import etree

from merge_sumo.road.corridor import Approach, Corridor, Piece
from merge_sumo.road.netfile import Point

COPY: Final = "@"
"""Stands in an id for the number of the copy."""
AT_M: Final = f"M{COPY}"
END: Final = f"end{COPY}"
KEPT_TYPES: Final = (
    *("priority", "priority_stop", "allway_stop", "zipper", "unregulated"),
    *("right_before_left", "left_before_right"),
)
"""Junctions at M that keep their rules; others, as those with traffic lights, are "priority"."""
STATES: Final = "MmZ=sw"
"""Rights of way that a link at M keeps; one with a traffic light yields, or not, without it."""


@dataclass(frozen=True, slots=True)
class HostedPath:
    """The edges of a path in the hosted net, one for each lane, and where they begin."""

    edges: tuple[str, ...]
    starts_m: tuple[float, ...]

    def lanes(self, copy: int) -> list[str]:
        """Return the ids of the lanes in a copy."""
        return [_numbered(f"{edge}_0", copy) for edge in self.edges]

    def route(self, copy: int) -> list[str]:
        """Return the ids of the edges of a route in a copy."""
        return [_numbered(edge, copy) for edge in self.edges if not edge.startswith(":")]


def hosted_paths(road: Corridor) -> tuple[HostedPath, HostedPath]:
    """Return the paths of mainline and ramp."""
    main, ramp = (
        HostedPath(tuple(at.edge for at in lanes), tuple(at.piece.start_m for at in lanes))
        for lanes in _hosted_lanes(road)
    )
    return main, ramp


def hosted_net(road: Corridor, copies: int) -> bytes:
    """Return the net with `copies` copies of a road."""
    text = ['<net version="1.20">\n']
    # SUMO reads edges before the junctions that name their lanes, and connections last.
    elements = _elements(road)
    for tag in ("edge", "junction", "connection"):
        template = "".join(
            f"{etree.tostring(element, encoding='unicode')}\n"
            for element in elements
            if element.tag == tag
        )
        text += [_numbered(template, k) for k in range(copies)]
    return "".join([*text, "</net>\n"]).encode()


def _numbered(text: str, copy: int) -> str:
    return text.replace(COPY, f".{copy}")


class _HostedLane(NamedTuple):
    edge: str
    junction: str
    """Behind the lane, or around it when it is internal."""
    piece: Piece

    @property
    def lane(self) -> str:
        return f"{self.edge}_0"


class _Hop(NamedTuple):
    """From a lane of a road over a junction to the next."""

    source: _HostedLane
    via: Sequence[_HostedLane]
    target: _HostedLane | None


def _hosted_lanes(road: Corridor) -> tuple[list[_HostedLane], list[_HostedLane]]:
    """Return the lanes of mainline and ramp; those behind M are the same, or all of them."""
    ramp_name = "main" if road.is_one_path else "ramp"
    main, ramp = (
        [
            *_named(name, [piece for piece in path.pieces if piece.start_m < 0.0], AT_M),
            *_named("out", [piece for piece in path.pieces if piece.start_m >= 0.0], END),
        ]
        for name, path in (("main", road.mainline), (ramp_name, road.ramp))
    )
    return main, ramp


def _named(name: str, pieces: Sequence[Piece], last: str) -> Iterator[_HostedLane]:
    """Yield lanes with ids; `last` is the junction behind the last road."""
    roads = sum(not piece.is_internal for piece in pieces)
    junction, road = "", 0
    for number, piece in enumerate(pieces):
        if piece.is_internal:
            # SUMO finds the junction between the colon and the last underscore.
            yield _HostedLane(f":{junction}_{name}{number}", junction, piece)
        else:
            road += 1
            junction = last if road == roads else f"{name}{road}-end{COPY}"
            yield _HostedLane(f"{name}{road}{COPY}", junction, piece)


def _hops(lanes: Sequence[_HostedLane]) -> Iterator[_Hop]:
    roads = [number for number, lane in enumerate(lanes) if not lane.piece.is_internal]
    for here, following in pairwise([*roads, len(lanes)]):
        target = lanes[following] if following < len(lanes) else None
        yield _Hop(lanes[here], lanes[here + 1 : following], target)


def _elements(road: Corridor) -> list[etree._Element]:
    """Return the edges, junctions and connections of one copy, in any order."""
    elements: list[etree._Element] = []
    at_m: list[_Hop] = []
    main, ramp = _hosted_lanes(road)
    paths: list[tuple[str, list[_HostedLane], Approach | None]] = [("main", main, None)]
    if not road.is_one_path:
        paths = [("ramp", ramp, road.ramp_approach), ("main", main, road.mainline_approach)]
    seen: set[str] = set()
    for name, lanes, approach in paths:
        begin = behind = f"{name}-begin{COPY}"
        elements.append(_junction(begin, "dead_end", lanes[0].piece.shape[0], []))
        for hop in _hops(lanes):
            source = hop.source
            if source.edge in seen:
                break
            seen.add(source.edge)
            elements.append(_edge(source, {"from": behind, "to": source.junction}))
            elements += [_edge(via, {"function": "internal"}) for via in hop.via]
            behind = source.junction
            if source.junction == AT_M:
                at_m.append(hop)
            else:
                kind = "priority" if hop.target else "dead_end"
                elements.append(_junction(source.junction, kind, source.piece.shape[-1], [hop]))
            elements += _connections(hop, approach if source.junction == AT_M else None)
    kept = road.junction_type in KEPT_TYPES and not road.is_one_path
    kind = road.junction_type if kept else "priority"
    yields = [approach is not None and approach.yields for _, _, approach in paths]
    elements.append(_junction(AT_M, kind, at_m[0].source.piece.shape[-1], at_m, yields))
    return elements


def _edge(lane: _HostedLane, attributes: dict[str, str]) -> etree._Element:
    edge = etree.Element("edge", {"id": lane.edge, **attributes})
    piece = lane.piece
    numbers = {"length": f"{piece.length_m!r}", "speed": f"{piece.speed_limit_mps!r}"}
    shape = " ".join(",".join(map(repr, point)) for point in piece.shape)
    etree.SubElement(edge, "lane", {"id": lane.lane, "index": "0", **numbers, "shape": shape})
    return edge


def _junction(
    name: str, kind: str, place: Point, hops: Sequence[_Hop], yields: Sequence[bool] = (False,)
) -> etree._Element:
    """Return a junction for hops; `yields` says which of two yields to the other."""
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
    for index, must_yield in enumerate(yields if kind != "dead_end" else ()):
        # One character for each link, the first link last.
        foes = "0" if len(hops) == 1 else ("10", "01")[index]
        response = foes if must_yield else "0" * len(hops)
        request = {"index": str(index), "response": response, "foes": foes, "cont": "0"}
        etree.SubElement(junction, "request", request)
    return junction


def _connections(hop: _Hop, approach: Approach | None) -> Iterator[etree._Element]:
    """Yield the connections of a hop: from its road, and from every internal lane."""
    if hop.target is None:
        return
    sources = [hop.source, *hop.via]
    for number, source in enumerate(sources):
        attributes = {"from": source.edge, "to": hop.target.edge, "fromLane": "0", "toLane": "0"}
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
