"""Make the pictures of a report: `python tools/make_screenshot.py RUN [PICTURE]`.

Needs Chromium (`apt-get install chromium`). An older picture is to be removed first. The picture
in README is that of

    merge-sumo campaign --vut design2 --seed 1 --out runs/picture
    python tools/make_screenshot.py runs/picture scenarios/report.png
"""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright

from merge_sumo.campaigns.run import Run
from merge_sumo.files import check_new
from merge_sumo.reports.report import write_report

WIDTH_PX, HEIGHT_PX = 1280, 1880
"""Of the window, at whose foot the case is that was clicked last."""


def take(report: Path, picture: Path) -> None:
    """Open a report in Chromium without a window and take its picture."""
    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None:
        sys.exit("chromium is not on the PATH: run `apt-get install chromium`")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": WIDTH_PX, "height": HEIGHT_PX})
        page.goto(report.resolve().as_uri())
        page.locator(".map .mark.fail").last.click(force=True)
        page.screenshot(path=picture)
        browser.close()


def main() -> None:
    """Write the report of a run again and take its picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("picture", type=Path, nargs="?", default=Path("scenarios/report.png"))
    arguments = parser.parse_args()
    check_new(arguments.picture, "PICTURE")
    take(write_report(Run(arguments.run)), arguments.picture)
    print(arguments.picture)


if __name__ == "__main__":
    main()
