"""A road as an SVG picture, and as the lines that a player draws.

The picture has its lanes, the two paths, M, and where vehicles start. An acceleration lane is drawn
in a colour, with its gore and its end.
"""

from __future__ import annotations

import math
from typing import Any

from lxml import etree

from merge_sumo.road.road import Road
from merge_sumo.scenario.scenario import COLOURS, Bounds, Scenario

NAMESPACE = "http://www.w3.org/2000/svg"
WIDTH_PX = 1000
LANE_M = 3.2
STEP_M = 5.0
AFTER_M = 120.0
"""Length after M, or the end of the lane, that is drawn."""
MARGIN_M = 20.0
LANE_COLOUR = "#009e73"
POINT_COLOUR = "#d55e00"
ROAD_COLOUR = "#c9c7c1"
OTHERS_COLOUR = "#dfdcd5"
PAPER = "#f7f6f3"

Line = list[tuple[float, float]]


def road_svg(road: Road, scenario: Scenario) -> bytes:
    """Return the picture of a road with the starts of a scenario on it."""
    low_m = min(scenario.x_pov0_m[0], scenario.x_vut0_m)
    high_m = AFTER_M if scenario.lane_m is None else scenario.lane_m[1] + AFTER_M
    paths = []
    for on_ramp, path in enumerate((road.mainline, road.ramp)):
        part_m = max(low_m, -path.before_m), min(high_m, path.after_m)
        paths.append(_part(road, part_m, on_ramp=bool(on_ramp)))
    xs, ys = zip(*paths[0], *paths[1], strict=True)
    left, top = min(xs) - MARGIN_M, max(ys) + MARGIN_M
    width, height = max(xs) + MARGIN_M - left, top - min(ys) + MARGIN_M
    box = f"{left:.1f} {-top:.1f} {width:.1f} {height:.1f}"
    root = etree.Element(
        "svg", xmlns="http://www.w3.org/2000/svg", viewBox=box, width=f"{WIDTH_PX}"
    )
    corner = {"x": f"{left:.1f}", "y": f"{-top:.1f}"}
    etree.SubElement(root, "rect", corner, width="100%", height="100%", fill=PAPER)
    for shape in road.surroundings:
        _draw(root, [(x, y) for x, y, _ in shape], OTHERS_COLOUR)
    for line in paths:
        _draw(root, line, ROAD_COLOUR)
    _draw(root, _part(road, scenario.x_pov0_m, on_ramp=False), COLOURS["pov"], LANE_M / 2.0)
    marks = [
        (scenario.x_vut0_m, True, COLOURS["vut"], "VUT"),
        (0.0, scenario.lane_m is None, POINT_COLOUR, "M"),
        (scenario.x_pov0_m[0], False, COLOURS["pov"], "POV"),
    ]
    if scenario.lane_m is not None:
        # At its very end the path of the ramp is on the mainline.
        begin_m, end_m = scenario.lane_m[0], math.nextafter(scenario.lane_m[1], -math.inf)
        _draw(root, _part(road, (begin_m, end_m), on_ramp=True), LANE_COLOUR, LANE_M / 2.0)
        marks += [(begin_m, True, LANE_COLOUR, "gore"), (end_m, True, LANE_COLOUR, "end of lane")]
    for x_m, on_ramp, colour, name in marks:
        at = road.lane_point(x_m, on_ramp=on_ramp)
        place = {"cx": f"{at.x_m:.1f}", "cy": f"{-at.y_m:.1f}"}
        etree.SubElement(root, "circle", place, r="3", fill=colour)
        place = {"x": f"{at.x_m + 4.0:.1f}", "y": f"{-at.y_m - 4.0:.1f}", "font-size": "9"}
        etree.SubElement(root, "text", place).text = name
    return etree.tostring(root, xml_declaration=True, encoding="UTF-8", pretty_print=True)


def _part(road: Road, part_m: Bounds, *, on_ramp: bool) -> Line:
    """Return the points of a part of a path."""
    low_m, high_m = part_m
    steps = max(int((high_m - low_m) / STEP_M), 1)
    line = []
    for step in range(steps + 1):
        at = road.lane_point(low_m + (high_m - low_m) * step / steps, on_ramp=on_ramp)
        line.append((at.x_m, at.y_m))
    return line


def _draw(root: etree._Element, line: Line, colour: str, width_m: float = LANE_M) -> None:
    points = " ".join(f"{x:.2f},{-y:.2f}" for x, y in line)
    style = {"fill": "none", "stroke": colour, "stroke-width": f"{width_m:g}"}
    etree.SubElement(root, "polyline", {"points": points, **style})


def road_data(road: Road) -> dict[str, Any]:
    """Return both paths as points (lane coordinate, x, y), and the lines of all lanes near M.

    M is the origin of the plane, and the road continues to the right: a net may lie anywhere.
    """
    at = road.lane_point(0.0, on_ramp=False)
    ahead_x, ahead_y = math.sin(math.radians(at.angle_deg)), math.cos(math.radians(at.angle_deg))

    def turned(x: float, y: float) -> list[float]:
        dx, dy = x - at.x_m, y - at.y_m
        along, left = dx * ahead_x + dy * ahead_y, dy * ahead_x - dx * ahead_y
        return [round(along, 2), round(left, 2)]

    paths = []
    shapes = list(road.surroundings)
    for path in (road.mainline, road.ramp):
        paths.append([[round(x_m, 2), *turned(x, y)] for x_m, x, y in path.corners()])
        shapes += [piece.shape for piece in path.pieces]
    lanes = []
    for shape in dict.fromkeys(shapes):
        lanes.append([turned(x, y) for x, y, _ in shape])
    return {"main": paths[0], "ramp": paths[1], "lanes": lanes}
