"""The road as OpenDRIVE, for simulators other than SUMO."""

from __future__ import annotations

import subprocess

from merge_sumo.errors import UserError
from merge_sumo.sumo.binding import scratch_folder, sumo_program
from merge_sumo.sumo.net import Net


def opendrive(net: Net) -> bytes:
    """Return a net as OpenDRIVE in the same coordinates; `UserError` when netconvert refuses."""
    # A copy of the net, and not where the road is to go: SUMO takes few names as they are.
    with scratch_folder() as scratch:
        source, road = scratch / "road.net.xml", scratch / "road.xodr"
        source.write_bytes(net.text)
        command = [
            *(sumo_program("netconvert"), "--sumo-net-file", str(source)),
            *("--opendrive-output", str(road), "--offset.disable-normalization", "true"),
            *("--precision", "6", "--no-warnings", "true"),
        ]
        done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 (absolute path, no shell)
        if done.returncode == 0 and road.is_file():
            return road.read_bytes()
    reason = (done.stderr.strip() or "no message").splitlines()[0]
    raise UserError(f"netconvert cannot write {net.path} as OpenDRIVE: {reason}")
