"""The road of a merge: two paths of lanes, mainline and ramp, that become one at M.

A lane coordinate is a distance along the lanes of a path from the merge point M, in m, negative
before M. Lanes inside of junctions belong to the paths, so it is continuous. M is where the first
common lane of both paths begins. On a road with an acceleration lane M is the expected place of a
merge along it: ramp and mainline have one coordinate there, and become one at the end of the lane.
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
"""SUMO counts a lane that is drawn shorter as drawn this long, and stops at its end."""


class LanePoint(NamedTuple):
    """A point of a path, on its lane and in the plane.

    Attributes:
        lane: id of the lane.
        position_m: distance from the beginning of the lane.
        x_m: eastward coordinate in the net.
        y_m: northward coordinate in the net.
        angle_deg: heading in SUMO's convention: degrees clockwise from north.
    """

    lane: str
    position_m: float
    x_m: float
    y_m: float
    angle_deg: float


@dataclass(frozen=True, slots=True)
class Piece:
    """A lane of a path.

    Attributes:
        lane: id in the net file; that of a lane inside of a junction begins with a colon.
        start_m: lane coordinate of its begin.
        length_m: length that is driven.
        speed_limit_mps: speed limit.
        shape: points (x, y, z) from begin to end, in m; their distance may differ from `length_m`.
    """

    lane: str
    start_m: float
    length_m: float
    speed_limit_mps: float
    shape: tuple[Point, ...]

    @property
    def shares(self) -> list[float]:
        """Shares of `length_m` at which the points of the shape are passed, one for each."""
        reach = list(accumulate((math.dist(a, b) for a, b in pairwise(self.shape)), initial=0.0))
        whole = max(reach[-1], DRAWN_MIN_M)
        return [along / whole for along in reach]

    @property
    def is_internal(self) -> bool:
        """Whether the lane lies inside of a junction."""
        return self.lane.startswith(":")

    def point(self, position_m: float) -> tuple[float, float, float]:
        """Return where SUMO draws a position on the lane.

        Args:
            position_m: distance from the beginning of the lane.

        Returns:
            x and y in m, and the heading in degrees clockwise from north.
        """
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
    """The lanes that a vehicle drives on.

    Attributes:
        pieces: the lanes in driving order, without gaps of the lane coordinate.

    Example:
        >>> path = road_of().ramp
        >>> path.before_m, path.point(-10.0).lane
        (425.0, 'ramp_0')
    """

    pieces: tuple[Piece, ...]

    @property
    def starts_m(self) -> list[float]:
        """Lane coordinates at which the pieces begin."""
        return [piece.start_m for piece in self.pieces]

    @property
    def before_m(self) -> float:
        """Length before M, in m."""
        return -self.pieces[0].start_m

    @property
    def after_m(self) -> float:
        """Length after M, in m."""
        return self.pieces[-1].start_m + self.pieces[-1].length_m

    def piece(self, x_m: float) -> Piece:
        """Return the lane at a coordinate.

        Args:
            x_m: lane coordinate. The first lane is taken for those before the path.
        """
        return self.pieces[max(bisect.bisect_right(self.starts_m, x_m) - 1, 0)]

    def point(self, x_m: float) -> LanePoint:
        """Return the point at a coordinate.

        Args:
            x_m: lane coordinate, in m.
        """
        piece = self.piece(x_m)
        position_m = x_m - piece.start_m
        return LanePoint(piece.lane, position_m, *piece.point(position_m))

    def corners(self) -> list[tuple[float, float, float]]:
        """Return the points at which the lanes are drawn: (lane coordinate, x, y), in m."""
        corners = []
        for piece in self.pieces:
            for share, (x, y, _) in zip(piece.shares, piece.shape, strict=True):
                corners.append((piece.start_m + share * piece.length_m, x, y))
        return corners

    def nearest(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Return the point of the path that is nearest to a point in the plane.

        Args:
            x_m: eastward coordinate in the net.
            y_m: northward coordinate in the net.

        Returns:
            Distance to the path and lane coordinate, in m.
        """
        distances = []
        for (begin_m, x0, y0), (end_m, x1, y1) in pairwise(self.corners()):
            dx, dy = x1 - x0, y1 - y0
            along = ((x_m - x0) * dx + (y_m - y0) * dy) / (dx * dx + dy * dy or 1.0)
            along = min(max(along, 0.0), 1.0)
            away_m = math.hypot(x_m - x0 - along * dx, y_m - y0 - along * dy)
            distances.append((away_m, begin_m + along * (end_m - begin_m)))
        return min(distances)


@dataclass(frozen=True, slots=True)
class Approach:
    """The right of way of a path at the junction at M.

    Attributes:
        state: SUMO's letter for it, such as "M" for a major and "m" for a minor link.
        yields: whether the path yields to the other one.
        visibility_m: distance to the junction from which a driver sees the other path; None where
            the net does not say so.
    """

    state: str
    yields: bool
    visibility_m: float | None


EXPECTED_SHARE = 0.35
"""Share of an acceleration lane before M. On three German ramps with lanes of 186 to 199 m cars
merge after a mean share of .32, .46 and .33 (Li et al. 2023, arXiv 2303.11531, 3,430 merges)."""
MIN_LANE_M = 50.0
"""Minimum length of a lane that the net does not mark: 2 s at 25 m/s are no choice."""
MAX_LANE_M = 2000.0
"""Maximum length: a longer lane is one of the mainline that ends somewhere."""


@dataclass(frozen=True, slots=True)
class AccelerationLane:
    """A lane of the ramp next to one of the mainline, up to where the paths become one.

    Attributes:
        begin_m: lane coordinate of its begin, the gore.
        end_m: lane coordinate of its end.
        lanes: ids of its lanes in the net file, one for each edge.
        is_marked: whether the net has the mark of netconvert for acceleration lanes.
    """

    begin_m: float
    end_m: float
    lanes: tuple[str, ...]
    is_marked: bool

    @property
    def length_m(self) -> float:
        """Length next to the mainline, in m."""
        return self.end_m - self.begin_m

    @property
    def gives_a_choice(self) -> bool:
        """Whether a driver chooses on it where to merge."""
        long_enough = self.is_marked or self.length_m >= MIN_LANE_M
        return long_enough and self.length_m <= MAX_LANE_M


def lane_around_m(length_m: float) -> Bounds:
    """Return begin and end of an acceleration lane around the expected merge, at 0.

    Args:
        length_m: length of the lane.

    Returns:
        Lane coordinates in tenths of a metre, up to 0.1 m nearer to each other than `length_m`.
    """
    end_m = math.floor((1.0 - EXPECTED_SHARE) * length_m * 10.0) / 10.0
    return math.ceil((end_m - length_m) * 10.0) / 10.0, end_m


@dataclass(frozen=True, slots=True, kw_only=True)
class Road:
    """A merge in a net, for simulations, replays and exports.

    Example:
        >>> road = road_of()
        >>> road.ramp.point(-10.0).lane
        'ramp_0'

    Attributes:
        path: the net file.
        sha256: hash of its unpacked bytes.
        mainline_edges: ids of the edges of the mainline, in driving order.
        ramp_edges: ids of the edges of the ramp, in driving order.
        mainline: lanes of the mainline.
        ramp: lanes of the ramp, and those after M.
        junction_type: SUMO's type of the junction at M.
        mainline_approach: right of way of the mainline at M.
        ramp_approach: right of way of the ramp at M.
        lane_drop: whether one path comes to M from a lane that ends.
        drawn_after_m: length after M in the file; from there the last lane continues straight on.
        used_lane_m: begin and end of `acceleration_lane`, as lane coordinates, where a scenario
            uses it; None where both paths meet in one point, M.
        acceleration_lane: that of the road, also where a scenario does not use it.
    """

    path: Path
    sha256: str
    mainline_edges: tuple[str, ...]
    ramp_edges: tuple[str, ...]
    mainline: LanePath
    ramp: LanePath
    junction_type: str
    mainline_approach: Approach
    ramp_approach: Approach
    lane_drop: bool
    drawn_after_m: float
    used_lane_m: Bounds | None = None
    acceleration_lane: AccelerationLane | None = None

    @property
    def is_one_path(self) -> bool:
        """Whether mainline and ramp are the same lanes."""
        return self.mainline_edges == self.ramp_edges

    def lane_point(self, x_m: float, *, on_ramp: bool) -> LanePoint:
        """Return the point at a coordinate of one of the paths.

        Args:
            x_m: lane coordinate, in m.
            on_ramp: whether the path is the ramp.
        """
        path = self.ramp if on_ramp else self.mainline
        return path.point(x_m)

    def front_bumper(self, x_m: float, length_m: float, *, on_ramp: bool) -> LanePoint:
        """Return the front bumper of a car, with the heading that puts both bumpers on the lane.

        Args:
            x_m: lane coordinate of the front bumper, in m.
            length_m: length of the car, in m.
            on_ramp: whether the path is the ramp.
        """
        at, rear = (self.lane_point(x, on_ramp=on_ramp) for x in (x_m, x_m - length_m))
        angle = math.atan2(at.x_m - rear.x_m, at.y_m - rear.y_m)
        return at._replace(angle_deg=math.degrees(angle) % 360.0)

    @property
    def speed_limit_mps(self) -> float:
        """Highest speed limit of both paths."""
        pieces = self.mainline.pieces + self.ramp.pieces
        return max(piece.speed_limit_mps for piece in pieces)
