"""Build sumo_net/us23.net.xml from the plain XML beside it: `python tools/build_net.py`.

Runs `netconvert -c us23.netccfg` and drops the header, which holds the time of the build, so that
the same sources give the same bytes.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

from merge_sumo.sumo.binding import sumo_program
from merge_sumo.sumo.corridor import Corridor
from merge_sumo.sumo.road import road_of
from merge_sumo.system.folders import check_new_file, replace_own

SOURCES = Path(__file__).resolve().parent.parent / "sumo_net"
NET = SOURCES / "us23.net.xml"


def build(output: Path) -> Corridor:
    """Build the net into `output`, ours or a new file, and return its corridor."""
    if output != NET:
        check_new_file(output)
    with tempfile.TemporaryDirectory() as folder:
        for source in SOURCES.glob("us23.*"):
            shutil.copy(source, folder)
        command = [sumo_program("netconvert"), "-c", "us23.netccfg"]
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
        text = (Path(folder) / "us23.net.xml").read_text(encoding="utf-8")
    replace_own(output, re.sub(r"<!--.*?-->\n*", "", text, flags=re.DOTALL).encode())
    return road_of(output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=NET)
    road = build(parser.parse_args().out)
    print(f"{road.path.name}: sha256 {road.sha256}")
