"""The road as OpenDRIVE, for simulators other than SUMO."""

from __future__ import annotations

import hashlib
from typing import Final

from merge_sumo.errors import UserError
from merge_sumo.sumo import received
from merge_sumo.sumo.binding import run_program, scratch_folder
from merge_sumo.sumo.corridor import Corridor
from merge_sumo.sumo.net import Net

NET: Final = "road.net.xml"
ROAD: Final = "road.xodr"
MAX_ELEMENTS: Final = 10**6
"""Of the net of a corridor, which a user chose: that of a city."""


def opendrive(road: Net | Corridor) -> bytes:
    """Return the net of a road as OpenDRIVE in the same coordinates.

    Raises `UserError` when the net file is gone or is another one now, or netconvert refuses it.
    """
    content = road.text if isinstance(road, Net) else _net_of(road)
    with scratch_folder() as stage:
        (stage / NET).write_bytes(content)
        arguments = [
            *("--sumo-net-file", NET, "--opendrive-output", ROAD),
            *("--offset.disable-normalization", "true"),
            # It smooths the corners of a shape by itself, by metres; SUMO drives along them.
            *("--opendrive-output.straight-threshold", "180"),
            *("--precision", "6", "--no-warnings", "true", "--xml-validation", "never"),
        ]
        ended = run_program("netconvert", arguments, stage)
        if ended.code == 0 and (stage / ROAD).is_file():
            return (stage / ROAD).read_bytes()
    raise UserError(f"netconvert cannot write {road.path} as OpenDRIVE: {ended.reason}")


def _net_of(road: Corridor) -> bytes:
    """Return what netconvert may see of the net file of a road."""
    limit = received.MAX_NET_BYTES
    content = received.read_bytes(road.path, "the net", follow_links=True, limit=limit)
    if hashlib.sha256(content).hexdigest() != road.sha256:
        raise UserError(
            f"the net {road.path} is not the one that was driven in: it changed; put that one there"
        )
    root, intact = received.parse(content, received.NET, f"the net {road.path}", MAX_ELEMENTS)
    return content if intact else received.serialize(root)
