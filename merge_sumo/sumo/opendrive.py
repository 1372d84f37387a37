"""The road as OpenDRIVE, for simulators other than SUMO."""

from __future__ import annotations

from typing import Final

from merge_sumo.errors import UserError
from merge_sumo.sumo.binding import run_program, scratch_folder
from merge_sumo.sumo.net import Net

NET: Final = "road.net.xml"
ROAD: Final = "road.xodr"


def opendrive(net: Net) -> bytes:
    """Return a net as OpenDRIVE in the same coordinates; `UserError` when netconvert refuses."""
    with scratch_folder() as stage:
        (stage / NET).write_bytes(net.text)
        arguments = [
            *("--sumo-net-file", NET, "--opendrive-output", ROAD),
            *("--offset.disable-normalization", "true"),
            *("--precision", "6", "--no-warnings", "true", "--xml-validation", "never"),
        ]
        ended = run_program("netconvert", arguments, stage)
        if ended.code == 0 and (stage / ROAD).is_file():
            return (stage / ROAD).read_bytes()
    raise UserError(f"netconvert cannot write {net.path} as OpenDRIVE: {ended.reason}")
