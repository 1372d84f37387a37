"""The road of a scenario: read from a net file as data, and found once in a process."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from merge_sumo.errors import UserError
from merge_sumo.files import resource
from merge_sumo.metrics.bodies import CentreLines
from merge_sumo.road.finder import find_road, read_net
from merge_sumo.road.road import Road
from merge_sumo.road.xml_input import read_xml
from merge_sumo.scenario.scenario import ROOM_AFTER_M, Bounds, Scenario

MAINLINE_EDGES = ("main_in", "main_out")
RAMP_EDGES = ("ramp", "main_out")
"""Of the shipped net."""

_found: dict[tuple[object, ...], Road] = {}


def default_net_path() -> Path:
    """Return the path of the shipped net."""
    return resource("sumo_net") / "us23.net.xml"


def road_of(
    net: Path | None = None,
    mainline: Sequence[str] = MAINLINE_EDGES,
    ramp: Sequence[str] = RAMP_EDGES,
    room_after_m: float = ROOM_AFTER_M,
    lane_m: Bounds | None = None,
) -> Road:
    """Return the merge of two sequences of edges in a net file, by default the shipped one.

    A road that was found is kept until the file changes.

    Args:
        net: the net file.
        mainline: edges of the mainline in driving order, past M.
        ramp: edges of the ramp in driving order, past M.
        room_after_m: where the file ends nearer after M, the road goes straight on.
        lane_m: begin and end of the acceleration lane of a scenario.

    Returns:
        The road.

    Raises:
        UserError: the file is not a SUMO net, or has no such merge.
    """
    path = net or default_net_path()
    content = read_xml(path, "the net")
    edges = tuple(mainline), tuple(ramp)
    key = (path, hashlib.sha256(content).hexdigest(), *edges, room_after_m, lane_m)
    if key not in _found:
        net_file = read_net(path, content)
        _found[key] = find_road(net_file, *edges, room_after_m=room_after_m, lane_m=lane_m)
    return _found[key]


def road_for(scenario: Scenario) -> Road:
    """Return the road of a scenario.

    Raises:
        UserError: there is no such merge, or a path is shorter before M than its farthest start.
    """
    # A net without a folder is one of the package.
    net = None if scenario.net is None else resource("sumo_net") / scenario.net
    paths = scenario.mainline, scenario.ramp
    road = road_of(net, *paths, scenario.room_after_m, scenario.lane_m)
    for edges, path, needed_m in (
        (scenario.mainline, road.mainline, scenario.farthest_start_m),
        (scenario.ramp, road.ramp, -scenario.x_vut0_m),
    ):
        if path.before_m < needed_m:
            raise UserError(
                f"{' '.join(edges)} begins {path.before_m:.1f} m before the merge point, and a "
                f"vehicle starts {needed_m:g} m before it: begin with an edge further upstream, or "
                "start nearer"
            )
    return road


_centre_lines: dict[tuple[object, ...], CentreLines] = {}


def centre_lines(road: Road) -> CentreLines:
    """Return the centre lines of both paths of a road; they are found once in a process."""
    key = road.sha256, road.mainline_edges, road.ramp_edges, road.lane_m
    if key not in _centre_lines:
        corners = np.array(road.mainline.corners()), np.array(road.ramp.corners())
        _centre_lines[key] = CentreLines.of(*corners)
    return _centre_lines[key]
