"""A merge in any SUMO net, as a value: two paths of lanes that become one at M.

Where both vehicles drive on the same lanes all the way, the paths are equal.

Each path has its own coordinate: the distance of the front bumper along its lanes from the merge
point M, in metres, negative before M. The lanes inside of junctions belong to the paths, so the
coordinate is continuous, and M is where the first lane begins that both paths have. On a ramp with
an acceleration lane M is where a merge is expected along it: both lanes have one coordinate there,
and the paths become one where the acceleration lane ends.
"""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass
from itertools import accumulate, pairwise
from pathlib import Path
from typing import NamedTuple

from merge_sumo.scenario.scenario import Bounds

Point = tuple[float, float, float]

DRAWN_MIN_M = 0.1
"""SUMO takes a lane for drawn as long as this when it is drawn shorter, and stops at its end."""


class LanePoint(NamedTuple):
    """The place of a lane coordinate in the net (lane, position on it) and in the plane."""

    lane: str
    position_m: float
    x_m: float
    y_m: float
    angle_deg: float
    """Heading in SUMO's convention: degrees clockwise from north."""


@dataclass(frozen=True, slots=True)
class Piece:
    """A lane of a path, with the coordinate at which it begins."""

    lane: str
    """Its id in the net file; an internal lane's begins with a colon."""
    start_m: float
    length_m: float
    speed_limit_mps: float
    shape: tuple[Point, ...]
    """Points in the plane from its begin to its end; drawn length and `length_m` may differ."""

    @property
    def shares(self) -> list[float]:
        """Shares of `length_m` at which the points of the shape are driven over."""
        reach = list(accumulate((math.dist(a, b) for a, b in pairwise(self.shape)), initial=0.0))
        whole = max(reach[-1], DRAWN_MIN_M)
        return [along / whole for along in reach]

    @property
    def is_internal(self) -> bool:
        """Whether the lane lies inside of a junction."""
        return self.lane.startswith(":")

    def point(self, position_m: float) -> tuple[float, float, float]:
        """Return (x, y, angle) of a position on the lane, where SUMO draws it."""
        # Where the lane is straight this is the share of its length, and nothing is rounded.
        shares = self.shares
        along = min(position_m / self.length_m, shares[-1])
        segment = min(max(bisect.bisect_left(shares, along), 1), len(shares) - 1) - 1
        begin, end = shares[segment : segment + 2]
        (x0, y0, _), (x1, y1, _) = self.shape[segment : segment + 2]
        share = (along - begin) / (end - begin)
        angle_deg = math.degrees(math.atan2(x1 - x0, y1 - y0)) % 360.0
        return x0 + share * (x1 - x0), y0 + share * (y1 - y0), angle_deg


@dataclass(frozen=True, slots=True)
class LanePath:
    """The lanes that a vehicle drives on, one after the other."""

    pieces: tuple[Piece, ...]

    @property
    def starts_m(self) -> list[float]:
        """Lane coordinates at which the pieces begin."""
        return [piece.start_m for piece in self.pieces]

    @property
    def before_m(self) -> float:
        """Length before M."""
        return -self.pieces[0].start_m

    @property
    def after_m(self) -> float:
        """Length after M."""
        return self.pieces[-1].start_m + self.pieces[-1].length_m

    def piece(self, x_m: float) -> Piece:
        """Return the lane at a coordinate."""
        return self.pieces[max(bisect.bisect_right(self.starts_m, x_m) - 1, 0)]

    def point(self, x_m: float) -> LanePoint:
        """Return the place of a lane coordinate."""
        piece = self.piece(x_m)
        position_m = x_m - piece.start_m
        return LanePoint(piece.lane, position_m, *piece.point(position_m))

    def corners(self) -> list[tuple[float, float, float]]:
        """Return the points of the lanes, each with its coordinate: (x_m, x, y)."""
        corners = []
        for piece in self.pieces:
            for share, (x, y, _) in zip(piece.shares, piece.shape, strict=True):
                corners.append((piece.start_m + share * piece.length_m, x, y))
        return corners

    def nearest(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Return the distance of a point in the plane to the lanes, in m, and the coordinate."""
        found = []
        for (begin_m, x0, y0), (end_m, x1, y1) in pairwise(self.corners()):
            dx, dy = x1 - x0, y1 - y0
            along = ((x_m - x0) * dx + (y_m - y0) * dy) / (dx * dx + dy * dy or 1.0)
            along = min(max(along, 0.0), 1.0)
            away_m = math.hypot(x_m - x0 - along * dx, y_m - y0 - along * dy)
            found.append((away_m, begin_m + along * (end_m - begin_m)))
        return min(found)

    def speed_limits_mps(self) -> list[tuple[float, float]]:
        """Return (x_m from where on, limit) wherever the limit of the lanes changes."""
        limits: list[tuple[float, float]] = []
        for piece in self.pieces:
            if not limits or limits[-1][1] != piece.speed_limit_mps:
                limits.append((piece.start_m, piece.speed_limit_mps))
        return limits


@dataclass(frozen=True, slots=True)
class Approach:
    """The right of way of a path over the junction at M."""

    state: str
    """SUMO's letter for its right of way."""
    yields: bool
    """Whether the junction's rules make it yield to the other path."""
    visibility_m: float | None


EXPECTED_SHARE = 0.35
"""Of an acceleration lane, up to M: on three German ramps with lanes of 186 to 199 m cars merge
after a mean share of .32, .46 and .33 (Li et al. 2023, arXiv 2303.11531, 3,430 merges)."""
MIN_LANE_M = 50.0
"""A shorter lane that the net does not mark leaves no choice: 2 s at 25 m/s."""
MAX_LANE_M = 2000.0
"""A longer lane is one of the mainline that ends somewhere."""


@dataclass(frozen=True, slots=True)
class AccelerationLane:
    """A lane of the ramp that runs next to one of the mainline up to where the paths become one.

    Attributes:
        begin_m: lane coordinate of its begin, the gore.
        end_m: lane coordinate of its end.
        lanes: its ids in the net file, one for each edge.
        mainline_lanes: ids of the lanes next to it.
        is_marked: whether the net marks it, as netconvert does.
        exits: edges after it, other than that of the mainline: weaving traffic leaves there.
    """

    begin_m: float
    end_m: float
    lanes: tuple[str, ...]
    mainline_lanes: tuple[str, ...]
    is_marked: bool
    exits: tuple[str, ...]

    @property
    def length_m(self) -> float:
        """Length next to the mainline."""
        return self.end_m - self.begin_m

    @property
    def gives_a_choice(self) -> bool:
        """Whether a driver chooses on it where to merge."""
        long_enough = self.is_marked or self.length_m >= MIN_LANE_M
        return long_enough and self.length_m <= MAX_LANE_M


def lane_around_m(length_m: float) -> Bounds:
    """Return begin and end of a lane of a length around the expected merge, at 0.

    In tenths of a metre, so it is up to 0.1 m shorter than the lane.
    """
    end_m = math.floor((1.0 - EXPECTED_SHARE) * length_m * 10.0) / 10.0
    return math.ceil((end_m - length_m) * 10.0) / 10.0, end_m


@dataclass(frozen=True, slots=True, kw_only=True)
class Road:
    """A merge in a net: the road for the simulation, replays and exports.

    Example:
        >>> road = road_of()
        >>> road.ramp.point(-10.0).lane
        'ramp_0'
    """

    path: Path
    sha256: str
    """Hash of the net, unpacked."""
    mainline_edges: tuple[str, ...]
    ramp_edges: tuple[str, ...]
    mainline: LanePath
    ramp: LanePath
    junction_type: str
    """Of the junction at M."""
    mainline_approach: Approach
    ramp_approach: Approach
    lane_drop: bool
    """Whether one path comes to M from a lane that ends."""
    drawn_after_m: float
    """Length after M in the file; from there on the last lane is continued straight on."""
    surroundings: tuple[tuple[Point, ...], ...]
    """Shapes of the other lanes near M, for drawings."""
    lane_m: Bounds | None = None
    """Where the acceleration lane begins and ends that a scenario has on this road; None where both
    paths meet in one point, M."""
    acceleration_lane: AccelerationLane | None = None
    """That of the road, also where a scenario does not use it."""

    @property
    def is_one_path(self) -> bool:
        """Whether both vehicles drive on one lane all the way."""
        return self.mainline_edges == self.ramp_edges

    def lane_point(self, x_m: float, *, on_ramp: bool) -> LanePoint:
        """Return the place of a lane coordinate of one of the paths."""
        return (self.ramp if on_ramp else self.mainline).point(x_m)

    @property
    def speed_limit_mps(self) -> float:
        """Highest speed limit of both paths."""
        pieces = self.mainline.pieces + self.ramp.pieces
        return max(piece.speed_limit_mps for piece in pieces)
