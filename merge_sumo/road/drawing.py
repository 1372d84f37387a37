"""A road as an SVG picture, and as lines that the player of a report draws.

The picture shows the lanes, M, the starts of the vehicles, and an acceleration lane with its ends.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from lxml import etree

from merge_sumo.road.road import LanePath, Road
from merge_sumo.road.xml_input import to_bytes
from merge_sumo.scenario.scenario import COLOURS, Scenario

NAMESPACE = "http://www.w3.org/2000/svg"
WIDTH_PX = 1000
LANE_M = 3.2
STEP_M = 5.0
AFTER_M = 120.0
"""Length after M, or the end of the acceleration lane, that is drawn."""
MARGIN_M = 20.0
LANE_COLOUR = "#009e73"
POINT_COLOUR = "#d55e00"
ROAD_COLOUR = "#c9c7c1"
PAPER = "#f7f6f3"

Line = list[tuple[float, float]]


def road_svg(road: Road, scenario: Scenario) -> bytes:
    """Return the picture of a road with the starts of a scenario on it.

    Args:
        road: the road of the scenario.
        scenario: gives the starts and the acceleration lane.

    Returns:
        The SVG file.
    """
    low_m = min(scenario.x_pov0_m[0], scenario.x_vut0_m)
    high_m = AFTER_M if scenario.lane_m is None else scenario.lane_m[1] + AFTER_M
    lines = []
    for path in (road.mainline, road.ramp):
        lines.append(_part(path, max(low_m, -path.before_m), min(high_m, path.after_m)))
    xs, ys = zip(*lines[0], *lines[1], strict=True)
    left, top = min(xs) - MARGIN_M, max(ys) + MARGIN_M
    width, height = max(xs) + MARGIN_M - left, top - min(ys) + MARGIN_M
    box = f"{left:.1f} {-top:.1f} {width:.1f} {height:.1f}"
    root = etree.Element(
        "svg",
        xmlns=NAMESPACE,
        viewBox=box,
        width=f"{WIDTH_PX}",
        style=f"background: {PAPER}",
    )
    for line in lines:
        _draw(root, line, ROAD_COLOUR)
    _draw(root, _part(road.mainline, *scenario.x_pov0_m), COLOURS["pov"], LANE_M / 2.0)
    marks = [
        (scenario.x_vut0_m, road.ramp, COLOURS["vut"], "VUT"),
        (0.0, road.mainline, POINT_COLOUR, "M"),
        (scenario.x_pov0_m[0], road.mainline, COLOURS["pov"], "POV"),
    ]
    if scenario.lane_m is not None:
        # At its very end the path of the ramp is on the mainline.
        begin_m, end_m = scenario.lane_m[0], math.nextafter(scenario.lane_m[1], -math.inf)
        _draw(root, _part(road.ramp, begin_m, end_m), LANE_COLOUR, LANE_M / 2.0)
        marks += [
            (begin_m, road.ramp, LANE_COLOUR, "gore"),
            (end_m, road.ramp, LANE_COLOUR, "end of lane"),
        ]
    for x_m, path, colour, name in marks:
        at = path.point(x_m)
        place = {"cx": f"{at.x_m:.1f}", "cy": f"{-at.y_m:.1f}"}
        etree.SubElement(root, "circle", place, r="3", fill=colour)
        place = {"x": f"{at.x_m + 4.0:.1f}", "y": f"{-at.y_m - 4.0:.1f}", "font-size": "9"}
        etree.SubElement(root, "text", place).text = name
    return to_bytes(root)


def _part(path: LanePath, low_m: float, high_m: float) -> Line:
    """Return points of a path between two lane coordinates, about `STEP_M` apart."""
    steps = max(int((high_m - low_m) / STEP_M), 1)
    line = []
    for x_m in np.linspace(low_m, high_m, steps + 1).tolist():
        at = path.point(x_m)
        line.append((at.x_m, at.y_m))
    return line


def _draw(root: etree._Element, line: Line, colour: str, width_m: float = LANE_M) -> None:
    points = " ".join(f"{x:.2f},{-y:.2f}" for x, y in line)
    style = {"fill": "none", "stroke": colour, "stroke-width": f"{width_m:g}"}
    etree.SubElement(root, "polyline", {"points": points, **style})


def road_data(road: Road) -> dict[str, Any]:
    """Return a road as JSON, with M as the origin of the plane and the x axis along the road.

    Args:
        road: the road, anywhere in its net.

    Returns:
        The paths "main" and "ramp" as points (lane coordinate, x, y), in m.
    """
    at = road.lane_point(0.0, on_ramp=False)
    ahead_x, ahead_y = math.sin(math.radians(at.angle_deg)), math.cos(math.radians(at.angle_deg))

    def turned(x: float, y: float) -> list[float]:
        dx, dy = x - at.x_m, y - at.y_m
        along, left = dx * ahead_x + dy * ahead_y, dy * ahead_x - dx * ahead_y
        return [round(along, 2), round(left, 2)]

    data: dict[str, Any] = {}
    for name, path in (("main", road.mainline), ("ramp", road.ramp)):
        data[name] = [[round(x_m, 2), *turned(x, y)] for x_m, x, y in path.corners()]
    return data
