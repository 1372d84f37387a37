"""The road as OpenDRIVE, for simulators other than SUMO."""

from __future__ import annotations

import subprocess
from pathlib import Path

from merge_sumo.errors import UserError
from merge_sumo.sumo.binding import sumo_program
from merge_sumo.sumo.net import Net


def write_opendrive(net: Net, path: Path) -> None:
    """Write a net as OpenDRIVE in the same coordinates; `UserError` when netconvert refuses."""
    command = [
        *(sumo_program("netconvert"), "--sumo-net-file", str(net.path)),
        *("--opendrive-output", str(path), "--offset.disable-normalization", "true"),
        *("--precision", "6", "--no-warnings", "true"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 (absolute path, no shell)
    if done.returncode != 0 or not path.is_file():
        reason = (done.stderr.strip() or "no message").splitlines()[0]
        raise UserError(f"netconvert cannot write {net.path} as OpenDRIVE: {reason}")
