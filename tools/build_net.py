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
from merge_sumo.sumo.net import Net

SOURCES = Path(__file__).resolve().parent.parent / "sumo_net"


def build(output: Path) -> Net:
    """Build the net into `output` and return it, checked."""
    with tempfile.TemporaryDirectory() as folder:
        for source in SOURCES.glob("us23.*"):
            shutil.copy(source, folder)
        command = [sumo_program("netconvert"), "-c", "us23.netccfg"]
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
        text = (Path(folder) / "us23.net.xml").read_text(encoding="utf-8")
    output.write_text(re.sub(r"<!--.*?-->\n*", "", text, flags=re.DOTALL), encoding="utf-8")
    return Net(output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=SOURCES / "us23.net.xml")
    net = build(parser.parse_args().out)
    print(f"{net.path.name}: sha256 {net.sha256}")
