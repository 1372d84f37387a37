"""Episodes as CommonRoad scenarios: lanes, recorded motions, and a planning problem.

CommonRoad (Althoff, Koschi and Manzinger, 2017), version 2020a of its XML: a body is a rectangle
around its centre, states stand at the steps of the record. Written with lxml, because
commonroad-io takes one version of protobuf that few other packages take.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from itertools import chain, pairwise
from pathlib import Path
from typing import Final

import numpy as np
from lxml import etree

from merge_sumo.road.corridor import Approach, Corridor, LanePath, Piece
from merge_sumo.road.drawing import LANE_M
from merge_sumo.values.bodies import WIDTH_M
from merge_sumo.values.case import FloatArray
from merge_sumo.values.merge import merged_rows
from merge_sumo.values.scenario import DT_S, VUT, Scenario
from merge_sumo.values.trajectory import Trajectory

DATE: Final = "2000-01-01"
"""A fixed one: the same case gives the same bytes."""
NOWHERE: Final = {"geoNameId": "-999", "gpsLatitude": "999", "gpsLongitude": "999"}
"""What CommonRoad writes for an unknown place."""
TAGS: Final = ("critical", "merging_lanes", "simulated")
CONNECTED_M: Final = 0.5
"""A lane goes on in the next one of a path where that begins within this of its end."""
TILT_RAD: Final = 1e-4
_Element = etree._Element


def commonroad(
    trajectory: Trajectory, road: Corridor, *, number: int, source: str, free: bool = False
) -> bytes:
    """Return an episode as a scenario of CommonRoad.

    Obstacles have the numbers of `obstacle_ids`. The start of the VUT is that of the planning
    problem; its goal is any state until the timeout, for CommonRoad has no "behind M" that does not
    say in which lane.

    Args:
        trajectory: what happened, of at least two rows.
        road: the road.
        number: of the scenario, 1 or more.
        source: who drives.
        free: leave the VUT out, for a planner in its place.
    """
    root = _scenario(trajectory, road, number, source, free=free)
    content: bytes = etree.tostring(root, encoding="UTF-8", xml_declaration=True)
    return content


def obstacle_ids(road: Corridor, vehicles: int) -> list[int]:
    """Return the numbers of the vehicles of an episode, in the order of their rows."""
    first = len(_pieces(road)) + 1
    return list(range(first, first + vehicles))


def straight_road(scenario: Scenario) -> Corridor:
    """Return a road of one straight lane for both paths, along which lane coordinates run.

    It points `TILT_RAD` away from the x axis: CommonRoad-CriMe 0.4.5 takes a heading that it rounds
    to 0 for an unknown one.
    """
    ends_m = -scenario.reach_m, scenario.room_after_m
    shape = tuple((x_m * math.cos(TILT_RAD), x_m * math.sin(TILT_RAD), 0.0) for x_m in ends_m)
    piece = Piece("lane", ends_m[0], ends_m[1] - ends_m[0], scenario.v_start_max_mps, shape)
    path, approach = LanePath((piece,)), Approach("M", yields=False, visibility_m=None)
    return Corridor(
        path=Path(),
        sha256="",
        mainline_edges=("lane",),
        ramp_edges=("lane",),
        mainline=path,
        ramp=path,
        junction_type="",
        junction_id="",
        mainline_approach=approach,
        ramp_approach=approach,
        lane_drop=False,
        drawn_after_m=ends_m[1],
        surroundings=(),
    )


def _pieces(road: Corridor) -> dict[str, Piece]:
    return {piece.lane: piece for piece in chain(road.mainline.pieces, road.ramp.pieces)}


def _scenario(
    trajectory: Trajectory, road: Corridor, number: int, source: str, *, free: bool
) -> _Element:
    """Return a case as a scenario of CommonRoad, without the VUT where it is `free`."""
    root = etree.Element(
        "commonRoad",
        {
            "timeStepSize": f"{DT_S:g}",
            "commonRoadVersion": "2020a",
            "author": "merge-sumo",
            "affiliation": "",
            "source": source,
            "benchmarkID": f"ZAM_MergeSumo-1_{number}_T-1",
            "date": DATE,
        },
    )
    location, tags = etree.SubElement(root, "location"), etree.SubElement(root, "scenarioTags")
    for name, value in NOWHERE.items():
        etree.SubElement(location, name).text = value
    for tag in TAGS:
        etree.SubElement(tags, tag)
    pieces = _pieces(road)
    ids = {lane: number for number, lane in enumerate(pieces, start=1)}
    for piece in pieces.values():
        root.append(_lanelet(piece, road, ids))
    numbers = obstacle_ids(road, trajectory.motion.shape[1])
    for row, of_row in enumerate(numbers):
        if not (free and row == VUT):
            root.append(_obstacle(trajectory, road, row, of_row))
    root.append(_problem(trajectory, road, numbers[-1] + 1))
    return root


def _lanelet(piece: Piece, road: Corridor, ids: Mapping[str, int]) -> _Element:
    """Return a lane with its bounds, and the lanes before, behind and beside it."""
    lanelet = etree.Element("lanelet", {"id": str(ids[piece.lane])})
    for bound, aside_m in (("leftBound", LANE_M / 2.0), ("rightBound", -LANE_M / 2.0)):
        element = etree.SubElement(lanelet, bound)
        for x_m, y_m in _beside(piece, aside_m).tolist():
            _point(element, x_m, y_m)
    links = list(dict.fromkeys(_links(road)))
    for name, own, other in (("predecessor", 1, 0), ("successor", 0, 1)):
        for link in links:
            if link[own] == piece.lane:
                etree.SubElement(lanelet, name, {"ref": str(ids[link[other]])})
    beside = _neighbour(piece, road, ids)
    if beside is not None:
        side, lane = beside
        etree.SubElement(lanelet, side, {"ref": str(ids[lane]), "drivingDir": "same"})
    on_mainline = any(piece.lane == one.lane for one in road.mainline.pieces)
    kind = "mainCarriageWay" if on_mainline else "accessRamp"
    etree.SubElement(lanelet, "laneletType").text = kind
    etree.SubElement(lanelet, "userOneWay").text = "vehicle"
    return lanelet


def _beside(piece: Piece, aside_m: float) -> FloatArray:
    """Return a bound of a lane, (n, 2), so far to the left of its centre line."""
    points = np.array([point[:2] for point in piece.shape])
    moved = np.ones(len(points), dtype=np.bool_)
    moved[1:] = np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-6
    points = points[moved]
    along = np.diff(points, axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    normal = np.column_stack([-along[:, 1], along[:, 0]])
    # At a corner the bound is as far from both sides.
    both = np.vstack([normal[:1], normal[:-1] + normal[1:], normal[-1:]])
    both /= np.linalg.norm(both, axis=1)[:, None]
    reach = (both * np.vstack([normal[:1], normal])).sum(axis=1)
    bound: FloatArray = points + aside_m * both / np.maximum(reach, 0.5)[:, None]
    return bound


def _links(road: Corridor) -> Iterator[tuple[str, str]]:
    """Yield the lanes of both paths of which one goes on in the other."""
    for path in (road.mainline, road.ramp):
        for one, other in pairwise(path.pieces):
            if math.dist(one.shape[-1][:2], other.shape[0][:2]) <= CONNECTED_M:
                yield one.lane, other.lane


def _neighbour(piece: Piece, road: Corridor, ids: Mapping[str, int]) -> tuple[str, str] | None:
    """Return on which side of a lane the other one of an acceleration lane is, and its id."""
    lane = road.acceleration_lane
    if lane is None:
        return None
    pairs = dict(zip(lane.lanes, lane.beside, strict=True))
    other = pairs.get(piece.lane) or {b: a for a, b in pairs.items()}.get(piece.lane)
    if other is None or other not in ids:
        return None
    (x0, y0, _), (x1, y1, _) = piece.shape[:2]
    x, y, _ = _pieces(road)[other].shape[0]
    is_left = (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) > 0.0
    return ("adjacentLeft" if is_left else "adjacentRight"), other


def _obstacle(trajectory: Trajectory, road: Corridor, row: int, number: int) -> _Element:
    """Return a car with its recorded motion."""
    obstacle = etree.Element("dynamicObstacle", {"id": str(number)})
    etree.SubElement(obstacle, "type").text = "car"
    rectangle = etree.SubElement(etree.SubElement(obstacle, "shape"), "rectangle")
    length_m = _length_m(trajectory.case.scenario, row)
    etree.SubElement(rectangle, "length").text = _decimal(length_m)
    etree.SubElement(rectangle, "width").text = _decimal(WIDTH_M)
    states = _states(trajectory, road, row)
    obstacle.append(_state("initialState", 0, states[0]))
    motion = etree.SubElement(obstacle, "trajectory")
    for step, state in enumerate(states[1:], start=1):
        motion.append(_state("state", step, state))
    return obstacle


def _problem(trajectory: Trajectory, road: Corridor, number: int) -> _Element:
    """Return the planning problem: to drive from the VUT's start until the timeout."""
    problem = etree.Element("planningProblem", {"id": str(number)})
    start = _state("initialState", 0, _states(trajectory, road, VUT)[0])
    start.remove(start[-1])
    for name in ("yawRate", "slipAngle"):
        _exact(start, name, "0")
    problem.append(start)
    time = etree.SubElement(etree.SubElement(problem, "goalState"), "time")
    etree.SubElement(time, "intervalStart").text = "1"
    etree.SubElement(time, "intervalEnd").text = str(trajectory.case.scenario.max_steps)
    return problem


def _states(trajectory: Trajectory, road: Corridor, row: int) -> list[tuple[float, ...]]:
    """Return (x, y, orientation, speed, acceleration) of the centre of a car at all steps."""
    length_m = _length_m(trajectory.case.scenario, row)
    states: list[tuple[float, ...]] = []
    for (x_m, v_mps, a_mps2), merged in zip(
        trajectory.motion[:, row].tolist(), merged_rows(trajectory).tolist(), strict=True
    ):
        on_ramp = row == VUT and not merged
        front, rear = (road.lane_point(at, on_ramp=on_ramp) for at in (x_m, x_m - length_m))
        heading = math.atan2(front.y_m - rear.y_m, front.x_m - rear.x_m)
        x = front.x_m - 0.5 * length_m * math.cos(heading)
        y = front.y_m - 0.5 * length_m * math.sin(heading)
        states.append((x, y, heading, v_mps, a_mps2))
    return states


def _length_m(scenario: Scenario, row: int) -> float:
    return scenario.vut_length_m if row == VUT else scenario.pov_length_m


def _state(name: str, step: int, state: tuple[float, ...]) -> _Element:
    """Return a state; its last element is the acceleration."""
    element = etree.Element(name)
    x_m, y_m, *others = state
    _point(etree.SubElement(element, "position"), x_m, y_m)
    names = "orientation", "velocity", "acceleration"
    values = dict(zip(names, map(_decimal, others), strict=True))
    _exact(element, "orientation", values["orientation"])
    _exact(element, "time", str(step))
    for other in names[1:]:
        _exact(element, other, values[other])
    return element


def _exact(parent: _Element, name: str, value: str) -> None:
    etree.SubElement(etree.SubElement(parent, name), "exact").text = value


def _point(parent: _Element, x_m: float, y_m: float) -> None:
    point = etree.SubElement(parent, "point")
    for name, value in (("x", x_m), ("y", y_m)):
        etree.SubElement(point, name).text = _decimal(value)


def _decimal(value: float) -> str:
    """Return a number as the schema has it: without an exponent, to a billionth."""
    return f"{value:.9f}"
