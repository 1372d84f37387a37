"""SUMO net files: edges, lanes, lengths, shapes, connections and right of way."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, pairwise
from pathlib import Path
from typing import Final

from lxml import etree

from merge_sumo.errors import UserError
from merge_sumo.printable import meant
from merge_sumo.road.xml_input import NET_TAGS, parse_xml, read_xml

VEHICLE_CLASS: Final = "passenger"
ALIKE_EDGES: Final = 0.5
"""Ratio of matching characters: ids of edges are short."""
SHOWN_EDGES: Final = 12
"""A net with at most as many edges names them all where one is unknown."""
JUNCTION_TYPES: Final = (
    *("priority", "priority_stop", "allway_stop", "zipper", "unregulated", "dead_end", "district"),
    *("right_before_left", "left_before_right", "traffic_light", "traffic_light_unregulated"),
    *("traffic_light_right_on_red", "rail_signal", "rail_crossing"),
)
FARTHEST_M: Final = 2e7
"""Largest coordinate and length in a net: half way round the earth, in metres of UTM."""
MAP_OPTIONS: Final = {"osm": "--osm-files", "OpenDRIVE": "--opendrive-files"}
"""Options by which netconvert reads a map, by the root of its file."""

Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Lane:
    """A lane: `length_m` is what SUMO drives, and `shape`, from begin to end, what it draws."""

    id: str
    edge: str
    index: int
    length_m: float
    speed_limit_mps: float
    shape: tuple[Point, ...]
    open_to_cars: bool
    is_marked: bool
    """Whether the net says that it is an acceleration lane."""

    @property
    def is_internal(self) -> bool:
        """Whether the lane lies inside of a junction."""
        return self.id.startswith(":")

    @property
    def drawn_m(self) -> float:
        """Length of the shape."""
        return sum(math.dist(a, b) for a, b in pairwise(self.shape))


@dataclass(frozen=True, slots=True)
class Link:
    """A connection between lanes of two edges; `via` are the internal lanes in between."""

    source: Lane
    target: Lane
    via: tuple[Lane, ...]
    state: str
    """SUMO's letter for the right of way: "M" goes first, "m" yields, "Z" is a zipper."""
    visibility_m: float | None
    """From how far its driver sees the others, where the net says so."""


class NetFile:
    """The lanes and connections of a net.

    Raises `UserError` when the file cannot be read, is no SUMO net, or has a wrong value.
    """

    def __init__(self, path: Path, content: bytes | None = None) -> None:
        """Read the file at `path`, or take its unpacked content."""
        self.path = path
        self.content = read_xml(path, "the net") if content is None else content
        self._root = parse_xml(self.content, f"the net {path}", NET_TAGS)
        if self._root.tag != "net":
            option = MAP_OPTIONS.get(self._root.tag)
            how = f"; make one of it: `netconvert {option} {path} -o NAME.net.xml`"
            raise UserError(
                f"{path} is no SUMO net: it does not begin with <net>{how if option else ''}"
            )
        self._edges = {str(edge.get("id")): edge for edge in self._root.iterfind("edge")}
        self._known: dict[str, Lane] = {}

    @property
    def sha256(self) -> str:
        """Hash of the unpacked bytes: a packed net is the same road."""
        return hashlib.sha256(self.content).hexdigest()

    @property
    def edges(self) -> list[str]:
        """Ids of the edges, those inside of junctions left out, in order."""
        return sorted(name for name in self._edges if not name.startswith(":"))

    def lanes(self, edge: str) -> tuple[Lane, ...]:
        """Return the lanes of an edge on which cars may drive; `UserError` when there is none."""
        if edge not in self._edges or edge.startswith(":"):
            named = self.edges
            few = f"it has {', '.join(named)}" if named and len(named) <= SHOWN_EDGES else ""
            hint = f"{meant(edge, named, ALIKE_EDGES)}{few}".strip()
            hint = f": {hint}" if hint else ""
            raise self.broken(f"it has no edge {edge}{hint}")
        of_edge = (self._lane(str(lane.get("id"))) for lane in self._edges[edge].iterfind("lane"))
        lanes = tuple(lane for lane in of_edge if lane.open_to_cars)
        if not lanes:
            raise self.broken(f"no lane of edge {edge} is open to cars")
        for lane in lanes:
            if lane.length_m <= 0.0 or lane.drawn_m <= 0.0:
                raise self.broken(f"lane {lane.id} has no length")
        return lanes

    def links(self, source: Lane, to_edge: str) -> list[Link]:
        """Return the links of a lane to the lanes of an edge, as far as cars may drive there."""
        return [
            link
            for element, link in self._links(source)
            if link.target.edge == to_edge and link.target.open_to_cars and _open_to_cars(element)
        ]

    def edges_into(self, edge: str) -> list[str]:
        """Return the edges from which a connection leads into an edge, turning back left out."""
        sources = {
            str(connection.get("from"))
            for connection in self._root.iterfind("connection")
            if connection.get("to") == edge and not _turns_back(connection)
        }
        return sorted(name for name in sources if not name.startswith(":"))

    def edges_from(self, lane: Lane) -> list[str]:
        """Return the edges to which a connection leads from a lane, turning back left out."""
        elements = self._connections.get((lane.edge, str(lane.index)), ())
        names = {
            str(element.get("to"))
            for element in elements
            if _open_to_cars(element) and not _turns_back(element)
        }
        return sorted(name for name in names if not name.startswith(":"))

    def is_open_to_cars(self, edge: str) -> bool:
        """Return whether cars may drive on a lane of an edge."""
        lanes = self._edges[edge].iterfind("lane") if edge in self._edges else ()
        return any(map(_open_to_cars, lanes))

    def junction(self, source: Lane) -> tuple[str, str]:
        """Return id and type of the junction at the end of a lane; `UserError` without one."""
        junction = self._junctions.get(source.id)
        if junction is None:
            raise self.broken(f"there is no junction at the end of lane {source.id}")
        kind = str(junction.get("type"))
        if kind not in JUNCTION_TYPES:
            raise self.broken(f"SUMO has no junctions of type {kind}")
        return str(junction.get("id")), kind

    def yields(self, link: Link, to: Link) -> bool:
        """Return whether the junction's rules make a link yield to another one of it."""
        junction = self._junctions.get(link.source.id)
        if junction is None:
            return False
        links = [
            found
            for lane in junction.get("incLanes", "").split()
            if lane in self._lane_elements
            for _, found in self._links(self._lane(lane))
        ]
        rows = {row.get("index"): row.get("response", "") for row in junction.iterfind("request")}
        if link not in links or to not in links:
            return False
        # The last character is about the first link.
        response = rows.get(str(links.index(link)), "")[::-1]
        return response[links.index(to) :][:1] == "1"

    def broken(self, what: str) -> UserError:
        """Return the error for a net that cannot be used."""
        return UserError(f"the net {self.path} cannot host a merge: {what}")

    @contextmanager
    def _numbers(self, what: str) -> Iterator[None]:
        """Raise the error for a value in a block that is not a number."""
        try:
            yield
        except ValueError as error:
            raise self.broken(f"{what} is no number ({error!s:.200})") from error

    def lanes_near(self, place: Point, distance_m: float) -> list[Lane]:
        """Return the lanes that begin or end within a distance of a point, those of roads first.

        Where people walk is none of them.
        """
        edges = sorted(self._edges.items(), key=lambda item: item[0].startswith(":"))
        lanes = [
            (str(lane.get("id")), lane)
            for _, edge in edges
            if edge.get("function") not in ("crossing", "walkingarea")
            for lane in edge.iterfind("lane")
        ]
        near = []
        for name, lane in lanes:
            points = lane.get("shape", "").split()
            with self._numbers(f"shape of lane {name}"):
                ends = [_point(text) for text in points[:1] + points[-1:]]
            if any(math.dist(end, place) <= distance_m for end in ends):
                near.append(self._lane(name))
        return near

    def _lane(self, name: str) -> Lane:
        # A net may have 100,000 lanes, of which a merge needs ten.
        if name not in self._known:
            with self._numbers(f"index, length, speed or shape of lane {name}"):
                self._known[name] = _lane(self._lane_elements[name])
        return self._known[name]

    @cached_property
    def _lane_elements(self) -> dict[str, etree._Element]:
        """Elements by their ids."""
        return {str(lane.get("id")): lane for lane in self._root.iterfind("edge/lane")}

    @cached_property
    def _connections(self) -> dict[tuple[str, str], list[etree._Element]]:
        """Elements by the edge and lane index that they leave, in the order of the file."""
        elements: dict[tuple[str, str], list[etree._Element]] = {}
        for element in self._root.iterfind("connection"):
            source = str(element.get("from")), str(element.get("fromLane"))
            elements.setdefault(source, []).append(element)
        return elements

    @cached_property
    def _junctions(self) -> dict[str, etree._Element]:
        """Elements by the lanes that end there."""
        found: dict[str, etree._Element] = {}
        for element in self._root.iterfind("junction"):
            with self._numbers(f"a coordinate of junction {element.get('id')}"):
                float(element.get("x", "")), float(element.get("y", ""))
            if element.get("type") != "internal":
                found |= dict.fromkeys(element.get("incLanes", "").split(), element)
        return found

    def _links(self, source: Lane) -> Iterator[tuple[etree._Element, Link]]:
        for element in self._connections.get((source.edge, str(source.index)), ()):
            target = f"{element.get('to')}_{element.get('toLane')}"
            # Ways of pedestrians lead to edges inside of junctions, and have no right of way here.
            if target.startswith(":") or target not in self._lane_elements:
                continue
            visibility = element.get("visibility")
            with self._numbers("the visibility of a connection"):
                visibility_m = None if visibility is None else float(visibility)
            via, state = tuple(self._via(element)), element.get("state", "M")
            yield element, Link(source, self._lane(target), via, state, visibility_m)

    def _via(self, element: etree._Element) -> Iterator[Lane]:
        """Yield the internal lanes of a connection; there are two where drivers wait inside."""
        seen = set()
        while (name := element.get("via")) and name not in seen:
            seen.add(name)
            if name not in self._lane_elements:
                raise self.broken(f"a connection leads over lane {name}, which is not there")
            lane = self._lane(name)
            yield lane
            followers = self._connections.get((lane.edge, str(lane.index)))
            if not followers:
                return
            element = followers[0]


def _lane(lane: etree._Element) -> Lane:
    name = str(lane.get("id"))
    numbers = float(lane.get("length", "")), float(lane.get("speed", ""))
    shape = tuple(_point(text) for text in lane.get("shape", "").split())
    if not all(abs(number) <= FARTHEST_M for number in chain(numbers, *shape)):
        raise ValueError(f"not within {FARTHEST_M:g}")
    return Lane(
        id=name,
        edge=name.rpartition("_")[0],
        index=int(lane.get("index", "")),
        length_m=numbers[0],
        speed_limit_mps=numbers[1],
        shape=shape,
        open_to_cars=_open_to_cars(lane),
        is_marked=lane.get("acceleration") in ("1", "true"),
    )


def _point(text: str) -> Point:
    x, y, *z = map(float, text.split(","))
    return x, y, z[0] if z else 0.0


def _turns_back(connection: etree._Element) -> bool:
    """Whether a connection leads to the opposite direction of its road."""
    return connection.get("dir") in ("t", "T")


def _open_to_cars(element: etree._Element) -> bool:
    """Whether "allow" and "disallow" of a lane or a connection let cars drive, as without them."""
    allowed, refused = element.get("allow"), element.get("disallow", "")
    if allowed is not None:
        return not {"all", VEHICLE_CLASS}.isdisjoint(allowed.split())
    return {"all", VEHICLE_CLASS}.isdisjoint(refused.split())
