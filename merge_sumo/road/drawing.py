"""A road as an SVG picture, and as the lines that a player draws.

The picture has its lanes, the two paths, M, and where vehicles start. An acceleration lane is drawn
in a colour, with its gore and its end.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from lxml import etree

from merge_sumo.road.corridor import Corridor, LanePath
from merge_sumo.scenario.scenario import COLOURS, Scenario

WIDTH_PX = 1000
LANE_M = 3.2
STEP_M = 5.0
AFTER_M = 120.0
"""Length after M, or the end of the lane, that is drawn."""
LANE_COLOUR = "#009e73"


def road_svg(road: Corridor, scenario: Scenario) -> bytes:
    """Return the picture of a road with the starts of a scenario on it."""
    low_m = min(scenario.x_pov0_m[0], scenario.x_vut0_m)
    lane_m = scenario.lane_m or (0.0, 0.0)
    paths = {
        on_ramp: _line_of(
            road,
            max(low_m, path.pieces[0].start_m),
            min(lane_m[1] + AFTER_M, path.after_m),
            on_ramp,
        )
        for on_ramp, path in ((False, road.mainline), (True, road.ramp))
    }
    window = _line_of(road, *scenario.x_pov0_m, on_ramp=False)
    points = [*paths[False], *paths[True]]
    left, right = min(x for x, _ in points) - 20.0, max(x for x, _ in points) + 20.0
    bottom, top = min(y for _, y in points) - 20.0, max(y for _, y in points) + 20.0
    root = etree.Element(
        "svg",
        xmlns="http://www.w3.org/2000/svg",
        viewBox=f"{left:.1f} {-top:.1f} {right - left:.1f} {top - bottom:.1f}",
        width=str(WIDTH_PX),
    )
    etree.SubElement(
        root, "rect", x=f"{left:.1f}", y=f"{-top:.1f}", width="100%", height="100%", fill="#f7f6f3"
    )
    for shape in road.surroundings:
        _line(root, [point[:2] for point in shape], "#dfdcd5", LANE_M)
    _line(root, paths[False], "#c9c7c1", LANE_M)
    _line(root, paths[True], "#c9c7c1", LANE_M)
    _line(root, window, COLOURS["pov"], LANE_M / 2.0)
    marks = [
        (scenario.x_vut0_m, True, COLOURS["vut"], "VUT"),
        (0.0, scenario.lane_m is None, "#d55e00", "M"),
        (scenario.x_pov0_m[0], False, COLOURS["pov"], "POV"),
    ]
    if scenario.lane_m is not None:
        # At its very end the path of the ramp is on the mainline.
        begin_m, end_m = scenario.lane_m[0], math.nextafter(scenario.lane_m[1], -math.inf)
        _line(root, _line_of(road, begin_m, end_m, on_ramp=True), LANE_COLOUR, LANE_M / 2.0)
        marks += [(begin_m, True, LANE_COLOUR, "gore"), (end_m, True, LANE_COLOUR, "end of lane")]
    for x_m, on_ramp, colour, name in marks:
        x, y = road.lane_point(x_m, on_ramp=on_ramp)[2:4]
        etree.SubElement(root, "circle", cx=f"{x:.1f}", cy=f"{-y:.1f}", r="3", fill=colour)
        text = etree.SubElement(
            root, "text", {"x": f"{x + 4.0:.1f}", "y": f"{-y - 4.0:.1f}", "font-size": "9"}
        )
        text.text = name
    return etree.tostring(root, xml_declaration=True, encoding="UTF-8", pretty_print=True)


def road_data(road: Corridor) -> dict[str, Any]:
    """Return both paths as points (lane coordinate, x, y), and the lines of all lanes near M.

    M is the origin of the plane, and the road goes on to the right: a net may lie anywhere.
    """
    at = road.lane_point(0.0, on_ramp=False)
    ahead_x, ahead_y = math.sin(math.radians(at.angle_deg)), math.cos(math.radians(at.angle_deg))

    def place(x: float, y: float) -> list[float]:
        dx, dy = x - at.x_m, y - at.y_m
        along, left = dx * ahead_x + dy * ahead_y, dy * ahead_x - dx * ahead_y
        return [round(along, 2), round(left, 2)]

    def points(path: LanePath) -> list[list[float]]:
        return [
            [round(piece.start_m + share * piece.length_m, 2), *place(x, y)]
            for piece in path.pieces
            for share, (x, y, _) in zip(piece.shares, piece.shape, strict=True)
        ]

    shapes = [piece.shape for path in (road.mainline, road.ramp) for piece in path.pieces]
    lanes = [*road.surroundings, *dict.fromkeys(shapes)]
    return {
        "main": points(road.mainline),
        "ramp": points(road.ramp),
        "lanes": [[place(x, y) for x, y, _ in shape] for shape in lanes],
    }


def _line_of(
    road: Corridor, low_m: float, high_m: float, on_ramp: bool
) -> list[tuple[float, float]]:
    """Return the points of a part of a path."""
    count = max(int((high_m - low_m) / STEP_M), 1)
    places_m = (low_m + (high_m - low_m) * step / count for step in range(count + 1))
    points = (road.lane_point(x_m, on_ramp=on_ramp) for x_m in places_m)
    return [(point.x_m, point.y_m) for point in points]


def _line(
    root: etree._Element, points: Sequence[tuple[float, ...]], colour: str, width_m: float
) -> None:
    text = " ".join(f"{x:.2f},{-y:.2f}" for x, y, *_ in points)
    style = {"fill": "none", "stroke": colour, "stroke-width": f"{width_m:g}"}
    etree.SubElement(root, "polyline", {"points": text, **style})
