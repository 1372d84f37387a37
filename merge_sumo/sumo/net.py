"""The road: one corridor of US-23 with its ramp, and many of them side by side in one net."""

from __future__ import annotations

import copy
import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from lxml import etree

from merge_sumo.errors import UserError
from merge_sumo.sumo import allowed, received
from merge_sumo.system.resources import resource

MAIN_IN: Final = "main_in"
MAIN_OUT: Final = "main_out"
RAMP: Final = "ramp"

CORRIDOR_SPACING_M: Final = 400.0
"""Far enough that no driver model of SUMO sees a vehicle of the next corridor."""
MIN_LENGTH_M: Final = {MAIN_IN: 900.0, RAMP: 183.0, MAIN_OUT: 1900.0}
"""Room for the farthest start, and for a POV that accelerates at 2 m/s2 until the timeout."""


def default_net_path() -> Path:
    """Return the path of the shipped net."""
    return resource("sumo_net") / "us23.net.xml"


@dataclass(frozen=True, slots=True)
class LaneLine:
    """A straight lane: its ends in the plane, metres, and its length."""

    x0_m: float
    y0_m: float
    x1_m: float
    y1_m: float
    length_m: float

    def point(self, position_m: float) -> tuple[float, float]:
        """Return the plane coordinates at a position along the lane."""
        share = position_m / self.length_m
        return (
            self.x0_m + share * (self.x1_m - self.x0_m),
            self.y0_m + share * (self.y1_m - self.y0_m),
        )

    @property
    def angle_deg(self) -> float:
        """Heading in SUMO's convention: degrees clockwise from north."""
        return math.degrees(math.atan2(self.x1_m - self.x0_m, self.y1_m - self.y0_m)) % 360.0


class Net:
    """A validated net file with the edges main_in, main_out and ramp that meet at M.

    Lane coordinates are exact only when edges have no internal links between them and are as
    long as they are drawn; a net where that does not hold is refused.

    Raises `UserError` when the file is missing, is not a SUMO net, or is not such a corridor.
    """

    def __init__(self, path: Path | None = None) -> None:
        """Read and check the net at `path`, or the shipped one."""
        self.path = path or default_net_path()
        self._parse(received.read_bytes(self.path, "the net", follow_links=True))

    @classmethod
    def of_bytes(cls, content: bytes, path: Path) -> Net:
        """Return the net in the bytes of a file; `path` is what sentences call it."""
        net = cls.__new__(cls)
        net.path = path
        net._parse(content)
        return net

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel to another process or machine as path and bytes: no file is read there."""
        return Net.of_bytes, (self._bytes, self.path)

    def _parse(self, content: bytes) -> None:
        self._bytes = content
        self._root, intact = received.parse(content, allowed.NET, f"the net {self.path}")
        self._text = content if intact else received.serialize(self._root)
        self.main_in = self._lane(MAIN_IN)
        self.main_out = self._lane(MAIN_OUT)
        self.ramp = self._lane(RAMP)
        for lane, x, y in (
            (self.main_in, self.main_in.x1_m, self.main_in.y1_m),
            (self.ramp, self.ramp.x1_m, self.ramp.y1_m),
            (self.main_out, self.main_out.x0_m, self.main_out.y0_m),
        ):
            drawn = math.hypot(lane.x1_m - lane.x0_m, lane.y1_m - lane.y0_m)
            if not (math.hypot(x, y) <= 1e-6 and abs(drawn - lane.length_m) <= 1e-6):
                raise self._broken("lanes must meet at M = (0, 0) and be as long as they are drawn")
        if any(edge.get("function") == "internal" for edge in self._root.iterfind("edge")):
            raise self._broken("it has internal links; build it with --no-internal-links")
        joined = {
            (link.get("from"), link.get("fromLane"), link.get("to"), link.get("toLane"))
            for link in self._root.iterfind("connection")
        }
        for source in (MAIN_IN, RAMP):
            if (source, "0", MAIN_OUT, "0") not in joined:
                raise self._broken(f"lane 0 of {source} does not lead to lane 0 of {MAIN_OUT}")

    @property
    def speed_limit_mps(self) -> float:
        """Speed limit of the lanes, above every speed of the scenario."""
        return float(self._lane_element(MAIN_IN).get("speed", ""))

    @property
    def sha256(self) -> str:
        """Hash of the file's bytes, recorded with every campaign."""
        return hashlib.sha256(self._bytes).hexdigest()

    @property
    def text(self) -> bytes:
        """The net for SUMO and for exports: the file's bytes, or what is allowed of them."""
        return self._text

    def lane_point(self, x_m: float, *, on_ramp: bool) -> tuple[str, float, float, float, float]:
        """Return (lane id, position, x, y, angle) of a lane coordinate, M = 0, metres, degrees."""
        if x_m >= 0.0:
            lane, name, position = self.main_out, MAIN_OUT, x_m
        else:
            lane, name = (self.ramp, RAMP) if on_ramp else (self.main_in, MAIN_IN)
            position = lane.length_m + x_m
        return f"{name}_0", position, *lane.point(position), lane.angle_deg

    def replicate(self, corridors: int) -> bytes:
        """Return a net of `corridors` copies, `CORRIDOR_SPACING_M` apart, ids suffixed ".k"."""
        root = copy.deepcopy(self._root)
        # SUMO reads edges before the junctions that name their lanes, and connections last.
        for tag in ("edge", "junction", "connection"):
            parts = list(root.iterfind(tag))
            for part in parts:
                root.remove(part)
            for k in range(corridors):
                root.extend(_replica(part, k) for part in parts)
        return etree.tostring(root, xml_declaration=True, encoding="UTF-8")

    def _lane_element(self, edge: str) -> etree._Element:
        for element in self._root.iterfind("edge"):
            if element.get("id") == edge:
                for lane in element.iterfind("lane"):
                    if lane.get("index") == "0":
                        return lane
        raise self._broken(f"it has no edge {edge} with a lane 0")

    def _lane(self, edge: str) -> LaneLine:
        lane = self._lane_element(edge)
        try:
            shape = [tuple(map(float, p.split(","))) for p in lane.get("shape", "").split()]
            ((x0, y0), (x1, y1)) = shape
            length = float(lane.get("length", ""))
            float(lane.get("speed", ""))
        except ValueError as error:
            reason = f"lane 0 of {edge} is not a straight line with a length and a speed"
            raise self._broken(reason) from error
        if length < MIN_LENGTH_M[edge]:
            raise self._broken(f"{edge} is shorter than {MIN_LENGTH_M[edge]:g} m")
        return LaneLine(x0, y0, x1, y1, length)

    def _broken(self, what: str) -> UserError:
        return UserError(f"the net {self.path} cannot host the scenario: {what}")


def _replica(part: etree._Element, k: int) -> etree._Element:
    clone = copy.deepcopy(part)
    for element in clone.iter():
        for name, value in _attributes(element):
            if name in ("id", "from", "to") and element.tag != "request":
                element.set(name, _suffixed(value, k, lane=element.tag == "lane"))
            elif name in ("incLanes", "intLanes"):
                lanes = (_suffixed(lane, k, lane=True) for lane in value.split())
                element.set(name, " ".join(lanes))
            elif name == "y":
                element.set(name, f"{float(value) - k * CORRIDOR_SPACING_M:.6f}")
            elif name == "shape":
                element.set(name, _shifted(value, -k * CORRIDOR_SPACING_M))
    return clone


def _attributes(element: etree._Element) -> list[tuple[str, str]]:
    return [(str(name), str(value)) for name, value in element.attrib.items()]


def _suffixed(name: str, k: int, *, lane: bool) -> str:
    if not lane:
        return f"{name}.{k}"
    edge, _, index = name.rpartition("_")
    return f"{edge}.{k}_{index}"


def _shifted(shape: str, dy_m: float) -> str:
    points = (point.split(",") for point in shape.split())
    return " ".join(f"{x},{float(y) + dy_m:.6f}" for x, y, *_ in points)
