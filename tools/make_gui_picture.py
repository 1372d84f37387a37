"""Make the picture of sumo-gui: `python tools/make_gui_picture.py FOLDER TIME_S PICTURE`.

Opens a copy of a scenario folder in sumo-gui and takes its picture at a time. Needs a display:
without one, `xvfb-run` in front of it. An older picture is to be removed first. The picture in
README is that of

    xvfb-run -a python tools/make_gui_picture.py scenarios/stalemate 8.7 scenarios/sumo-gui.png
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from pathlib import Path

from lxml import etree

from merge_sumo.files import check_new
from merge_sumo.sumo.binding import run_program
from merge_sumo.sumo.replay_folder import CONFIG, VIEW


def take(scenario: Path, time_s: float, picture: Path) -> None:
    """Take the picture; only the copy tells the window to do so, and to close at the end."""
    parser = etree.XMLParser(resolve_entities=False, no_network=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "scenario"
        shutil.copytree(scenario, folder)
        view = etree.parse(folder / VIEW, parser).getroot()
        etree.SubElement(view, "snapshot", file=str(picture.resolve()), time=str(time_s))
        etree.ElementTree(view).write(folder / VIEW)
        config = etree.parse(folder / CONFIG, parser).getroot()
        only = config.find("gui_only")
        assert only is not None, "a scenario is for sumo-gui"  # noqa: S101
        for option, value in (("delay", "0"), ("quit-on-end", "true")):
            found = only.find(option)
            (etree.SubElement(only, option) if found is None else found).set("value", value)
        for halt in only.findall("breakpoints"):
            only.remove(halt)
        etree.ElementTree(config).write(folder / CONFIG)
        ended = run_program("sumo-gui", ["-c", CONFIG], folder, limit_s=None)
        assert ended.code == 0, "sumo-gui says why"  # noqa: S101


def main() -> None:
    """Take a picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("time_s", type=float)
    parser.add_argument("picture", type=Path)
    arguments = parser.parse_args()
    check_new(arguments.picture, "PICTURE")
    take(arguments.folder, arguments.time_s, arguments.picture)
    print(arguments.picture)


if __name__ == "__main__":
    main()
