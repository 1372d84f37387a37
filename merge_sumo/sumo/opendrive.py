"""The road as OpenDRIVE, for simulators other than SUMO."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Final

from merge_sumo.errors import UserError
from merge_sumo.sumo.binding import run_program
from merge_sumo.sumo.net import Net

NET: Final = "road.net.xml"
ROAD: Final = "road.xodr"


def write_opendrive(net: Net, path: Path) -> None:
    """Write a net as OpenDRIVE in the same coordinates.

    Raises `UserError` when netconvert refuses, or when the file exists or cannot be written.
    """
    with tempfile.TemporaryDirectory(prefix="merge-sumo-") as name:
        stage = Path(name)
        (stage / NET).write_bytes(net.text)
        arguments = [
            *("--sumo-net-file", NET, "--opendrive-output", ROAD),
            *("--offset.disable-normalization", "true"),
            *("--precision", "6", "--no-warnings", "true", "--xml-validation", "never"),
        ]
        ended = run_program("netconvert", arguments, stage)
        if ended.code != 0 or not (stage / ROAD).is_file():
            raise UserError(f"netconvert cannot write {net.path} as OpenDRIVE: {ended.reason}")
        road = (stage / ROAD).read_bytes()
    try:
        with path.open("xb") as file:
            file.write(road)
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error
