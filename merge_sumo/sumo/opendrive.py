"""Convert the road of a merge to OpenDRIVE, for other simulators."""

from __future__ import annotations

from lxml import etree

from merge_sumo.errors import UserError
from merge_sumo.road.road import Road
from merge_sumo.road.xml_input import harmless_net, to_bytes
from merge_sumo.sumo.binding import run_program, scratch_folder

NET = "road.net.xml"
ROAD = "road.xodr"
ENTRY = "entry"
"""OpenDRIVE's type of an acceleration lane."""
CONVERSION_LIMIT_S = 180.0
"""Maximum time of netconvert, which takes 10 s for the net of a city."""


def opendrive(road: Road) -> bytes:
    """Return the net of a road as OpenDRIVE, in the same coordinates.

    netconvert draws its own ways over junctions, up to a metre from SUMO's.

    Args:
        road: a road of a net file.

    Returns:
        The content of the OpenDRIVE file. An acceleration lane has the type "entry".

    Raises:
        UserError: the net file is missing, or netconvert refuses it.
    """
    net = harmless_net(road.path)
    etree.strip_elements(net, "tlLogic", "roundabout", with_tail=False)
    for connection in net.iterfind("connection"):
        for name in ("tl", "linkIndex", "via"):
            connection.attrib.pop(name, "")
    if road.used_lane_m is not None and road.acceleration_lane is not None:
        for lane in net.iter("lane"):
            if lane.get("id") in road.acceleration_lane.lanes:
                lane.set("type", ENTRY)
    with scratch_folder() as stage:
        (stage / NET).write_bytes(to_bytes(net))
        arguments = [
            *("--sumo-net-file", NET, "--opendrive-output", ROAD),
            *("--offset.disable-normalization", "true"),
            # By default it smooths the corners of a shape by metres; SUMO drives along them.
            *("--opendrive-output.straight-threshold", "180"),
            *("--precision", "6", "--no-warnings", "true", "--xml-validation", "never"),
        ]
        reason = run_program("netconvert", arguments, stage, limit_s=CONVERSION_LIMIT_S)
        if reason or not (stage / ROAD).is_file():
            raise UserError(f"netconvert cannot write {road.path} as OpenDRIVE: {reason}")
        return (stage / ROAD).read_bytes()
