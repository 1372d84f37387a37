"""Make the pictures in README: `python tools/make_pictures.py report|gui SOURCE PICTURE`.

A report needs Chromium (`apt-get install chromium`), sumo-gui a display: without one, `xvfb-run` in
front of the command. An older picture is to be removed first. The pictures in README are

    merge-sumo campaign --vut design2 --seed 1 --out runs/picture
    python tools/make_pictures.py report runs/picture scenarios/report.png
    xvfb-run -a python tools/make_pictures.py gui scenarios/stalemate scenarios/sumo-gui.png
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

from lxml import etree
from playwright.sync_api import sync_playwright

from merge_sumo.campaigns.recorded import RecordedCampaign
from merge_sumo.files import check_new
from merge_sumo.reports.report import write_report
from merge_sumo.sumo.binding import run_program
from merge_sumo.sumo.replay_folder import CONFIG, VIEW

WINDOW_PX = {"width": 1280, "height": 1880}
"""At its foot is the case that was clicked last."""


def picture_of_report(run: Path, picture: Path, _: float) -> None:
    """Write the report of a run again, open it in Chromium without a window, and click a case."""
    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None:
        sys.exit("chromium is not on the PATH: run `apt-get install chromium`")
    report = write_report(RecordedCampaign(run))
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        page = browser.new_page(viewport=WINDOW_PX)  # type: ignore[arg-type]
        page.goto(report.resolve().as_uri())
        page.locator(".map .mark.fail").last.click(force=True)
        page.screenshot(path=picture)
        browser.close()


def picture_of_gui(scenario: Path, picture: Path, time_s: float) -> None:
    """Open a copy of a scenario folder in sumo-gui; only the copy takes the picture, and closes.

    Args:
        scenario: folder of the scenario.
        picture: new file.
        time_s: time of the picture in the episode.
    """
    parser = etree.XMLParser(resolve_entities=False, no_network=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "scenario"
        shutil.copytree(scenario, folder)
        view = etree.parse(folder / VIEW, parser).getroot()
        etree.SubElement(view, "snapshot", file=str(picture.resolve()), time=str(time_s))
        etree.ElementTree(view).write(folder / VIEW)
        config = etree.parse(folder / CONFIG, parser).getroot()
        etree.strip_elements(config, "delay", "quit-on-end", "breakpoints")
        etree.SubElement(config, "delay", value="0")
        etree.SubElement(config, "quit-on-end", value="true")
        etree.ElementTree(config).write(folder / CONFIG)
        reason = run_program("sumo-gui", ["-c", CONFIG], folder, limit_s=None)
        assert not reason, reason  # noqa: S101


KINDS = {"report": picture_of_report, "gui": picture_of_gui}


def main() -> None:
    """Make a picture."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("source", type=Path, help="folder of a run, or of a scenario")
    parser.add_argument("picture", type=Path, help="new file")
    parser.add_argument("--time", type=float, default=8.7, help="s of the episode in sumo-gui")
    options = parser.parse_args()
    check_new(options.picture, "PICTURE")
    KINDS[options.kind](options.source, options.picture, options.time)
    print(options.picture)


if __name__ == "__main__":
    main()
