"""Load the road of a net file or of a scenario, once in a process."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from merge_sumo.errors import UserError
from merge_sumo.files import resource
from merge_sumo.metrics.bodies import CentreLines
from merge_sumo.road.finder import find_road, read_net
from merge_sumo.road.road import Road
from merge_sumo.road.xml_input import read_xml
from merge_sumo.scenario.scenario import ROOM_AFTER_M, US23, Bounds, Scenario

_found: dict[tuple[object, ...], Road] = {}


def default_net_path() -> Path:
    """Return the path of the net of the paper's scenario, which the package brings."""
    return resource("sumo_net") / "us23.net.xml"


def road_of(
    net: Path | None = None,
    mainline: Sequence[str] = US23.mainline,
    ramp: Sequence[str] = US23.ramp,
    room_after_m: float = ROOM_AFTER_M,
    lane_m: Bounds | None = None,
) -> Road:
    """Return the merge of two sequences of edges in a net file.

    The road is kept in memory until the file changes.

    Args:
        net: the net file; None for that of the paper's scenario.
        mainline: ids of the edges of the mainline in driving order, past M.
        ramp: ids of the edges of the ramp in driving order, past M.
        room_after_m: minimum length after M, in m. Where the file ends before, the road continues
            straight on.
        lane_m: begin and end of the acceleration lane of a scenario, in m; None for a merge at M.

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


def road_or_shipped(scenario: Scenario) -> Road:
    """Return the road of a scenario to draw; the shipped one where its net is gone.

    Args:
        scenario: names the net and the edges of both paths.
    """
    try:
        return road_for(scenario)
    except UserError:
        return road_of()


def road_for(scenario: Scenario) -> Road:
    """Return the road of a scenario.

    Args:
        scenario: names the net and the edges of both paths.

    Returns:
        The road, with the acceleration lane of the scenario.

    Raises:
        UserError: the net has no such merge, or a path is shorter before M than its farthest start.

    Example:
        >>> road_for(US23).ramp.before_m
        425.0
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
                f"{' '.join(edges)} begins {path.before_m:.1f} m before the merge point, but a "
                f"vehicle starts {needed_m:g} m before it: add an edge upstream, or start nearer"
            )
    return road


@cache
def centre_lines(road: Road) -> CentreLines:
    """Return the centre lines of both paths of a road, for bodies of vehicles in the plane.

    Args:
        road: the road.

    Returns:
        The lines; the same object for the same road.
    """
    return CentreLines.of(np.array(road.mainline.corners()), np.array(road.ramp.corners()))
