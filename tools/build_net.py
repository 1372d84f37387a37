"""Build the nets of sumo_net/ from the plain XML next to them: `python tools/build_net.py`.

Runs `netconvert -c` on every .netccfg. It drops the header, which contains the time of the build,
so that the same sources give the same bytes.
"""

from __future__ import annotations

import argparse
import hashlib
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

from merge_sumo.files import check_new, replace_own
from merge_sumo.sumo.binding import sumo_program

SOURCES = Path(__file__).resolve().parent.parent / "sumo_net"


def build(configuration: Path, output: Path) -> bytes:
    """Build the net of a configuration.

    Args:
        configuration: configuration of netconvert.
        output: the net: the file in sumo_net/, or a new file.

    Returns:
        The bytes of the net.
    """
    if output.parent != SOURCES:
        check_new(output)
    with tempfile.TemporaryDirectory() as folder:
        for source in SOURCES.glob(f"{configuration.stem}.*"):
            shutil.copy(source, folder)
        command = [sumo_program("netconvert"), "-c", configuration.name]
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
        text = (Path(folder) / output.name).read_text(encoding="utf-8")
    content = re.sub(r"<!--.*?-->\n*", "", text, flags=re.DOTALL).encode()
    replace_own(output, content)
    return content


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=SOURCES, help="output folder")
    out = parser.parse_args().out
    for configuration in sorted(SOURCES.glob("*.netccfg")):
        net = out / f"{configuration.stem}.net.xml"
        print(f"{net.name}: sha256 {hashlib.sha256(build(configuration, net)).hexdigest()}")
