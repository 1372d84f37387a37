"""Make the pictures of README and the site, the notebook and scenarios/ with the present tool.

    xvfb-run -a python tools/make_pictures.py            pictures whose text has changed
    xvfb-run -a python tools/make_pictures.py NAME ...   the named pictures
    python tools/make_pictures.py --check                print those whose text has changed; end
                                                         with 1 if there are any

A PNG contains the text that it shows as its "Description". The script compares these texts, not
pixels. It compares a drawing as a whole; its template is in `tools/drawings/`. It compares the
notebook by the texts of its cells. The report needs Chromium (`apt-get install chromium`). Pictures
of sumo-gui need a display, which `xvfb-run` provides.
"""

from __future__ import annotations

import argparse
import difflib
import hashlib
import io
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Final

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from lxml import etree
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image, PngImagePlugin
from playwright.sync_api import Page, ViewportSize, sync_playwright
from run_notebook import executed, shown, write, written
from scenario_examples import EXAMPLES, motion_figure, play

from merge_sumo import config
from merge_sumo.analysis.reproduction import PAPER_SAMPLERS, TABLE_II, ColumnResult
from merge_sumo.analysis.sampler_study import Study
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.metrics.merge import meanings
from merge_sumo.reports.figures import figures_of, save
from merge_sumo.reports.pages import source_of
from merge_sumo.reports.report import REPORT
from merge_sumo.scenario.scenario import US23
from merge_sumo.sumo.binding import run_program
from merge_sumo.sumo.replay_folder import CONFIG, LABELS, VIEW, write_replay_folder
from merge_sumo.workers import Workers

ROOT = Path(__file__).resolve().parent.parent
CAMPAIGN = ("--vut", "design2", "--seed", "1", "--out", "design2")
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
WINDOW_PX: Final[ViewportSize] = {"width": 1400, "height": 900}
"""The first screen of a report."""
TEXT_OF_THE_FIRST_SCREEN = """() => [...document.body.children]
  .filter(part => part.checkVisibility() && part.getBoundingClientRect().top < innerHeight / 2)
  .map(part => part.innerText).join("\\n")"""
"""Parts of the page that begin in the upper half, whole: where lines end depends on the fonts."""
CLIPPED_TEXTS = """() => {
  const inside = (text, box) => text.left >= box.left && text.right <= box.right
    && text.top >= box.top && text.bottom <= box.bottom;
  const clipped = [];
  for (const text of document.querySelectorAll("text")) {
    const own = text.getBoundingClientRect();
    const x = own.left + own.width / 2, y = own.top + own.height / 2;
    for (const rect of document.querySelectorAll("rect")) {
      const box = rect.getBoundingClientRect();
      const around = box.left < x && x < box.right && box.top < y && y < box.bottom;
      if (around && !inside(own, box)) clipped.push(text.textContent);
    }
  }
  return clipped;
}"""
"""Texts whose middle is in a box that they leave."""
SLOWNESS_MS = "300"
"""Delay of sumo-gui for each simulated second, so that its window is open before the picture."""
LEAST_WIDTH_PX = 600
DESCRIPTION = "Description"
"""Name of the text in a PNG."""
LINES_SHOWN = 20
"""Lines of a difference that are printed."""

Maker = Callable[[Path | None], str]
"""Return the text of the present picture; with a new file, also write the picture there."""


@cache
def campaign() -> tempfile.TemporaryDirectory[str]:
    """Run a campaign, once, and return its working folder, which lasts as long as this process."""
    folder = tempfile.TemporaryDirectory()
    command = [sys.executable, "-m", "merge_sumo.cli", "campaign", *CAMPAIGN]
    subprocess.run(command, cwd=folder.name, check=True, capture_output=True)
    return folder


@contextmanager
def browser_page() -> Iterator[Page]:
    """Yield a page of Chromium without a window."""
    if CHROMIUM is None:
        sys.exit("chromium is not on the PATH: run `apt-get install chromium`")
    with sync_playwright() as playwright:
        # No sandbox: CI runs as root, and the page is our own.
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser.new_page(viewport=WINDOW_PX)
        browser.close()


def report_picture(new: Path | None) -> str:
    """Show the first screen of the report of a campaign.

    Args:
        new: new file; None for the text alone.
    """
    with browser_page() as page:
        page.goto((Path(campaign().name) / "design2" / REPORT).as_uri())
        text = str(page.evaluate(TEXT_OF_THE_FIRST_SCREEN))
        if new:
            page.screenshot(path=new)
    return text


def gui_picture(name: str, time_s: float, new: Path | None) -> str:
    """Show an example in sumo-gui, which takes the picture and closes.

    Args:
        name: name of the example.
        time_s: time of the picture in the episode.
        new: new file; None for the text alone.

    Returns:
        What sumo-gui is told to show: texts, colours and the view, and a hash of road and motion.
    """
    parser = etree.XMLParser(resolve_entities=False, no_network=True)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / name
        digest = hashlib.sha256(scenario_folder(name, folder).encode()).hexdigest()
        text = "".join((folder / file).read_text(encoding="utf-8") for file in (LABELS, VIEW))
        text += f"SHA-256 of the folder: {digest}"
        if new:
            view = etree.parse(folder / VIEW, parser).getroot()
            etree.SubElement(view, "snapshot", file=str(new), time=str(time_s))
            etree.ElementTree(view).write(folder / VIEW)
            settings = etree.parse(folder / CONFIG, parser).getroot()
            etree.strip_elements(settings, "delay", "quit-on-end", "breakpoints")
            etree.SubElement(settings, "delay", value=SLOWNESS_MS)
            etree.SubElement(settings, "quit-on-end", value="true")
            etree.ElementTree(settings).write(folder / CONFIG)
            reason = run_program("sumo-gui", ["-c", CONFIG], folder, limit_s=None)
            if reason or not new.exists():
                sys.exit(f"sumo-gui took no picture: {reason}")
            with Image.open(new) as image:
                if image.width < LEAST_WIDTH_PX:
                    sys.exit("sumo-gui had not opened its window: make this picture again")
    return text


def motion_picture(name: str, new: Path | None) -> str:
    """Draw the motion of an example.

    Args:
        name: name of the example.
        new: new file; None for the text alone.
    """
    figure = motion_figure(play(name))
    text = text_of(figure)
    if new:
        figure.savefig(new, dpi=110)
    return text


def curves_picture(new: Path | None) -> str:
    """Draw the coverage of the samplers against a level-1 POV, as `reproduce` does.

    Args:
        new: new file; None for the text alone, which is the text of a smaller study.
    """
    column = TABLE_II[1]
    options = config.Benchmark(column.vut, seeds=10, cases=400, truth_cases=10_000)
    if new is None:
        options = config.Benchmark(column.vut, seeds=1, cases=40, truth_cases=200)
    settings = CampaignSettings(vut=column.vut, levels=(column.level,), scenario=US23)
    study = Study(settings.load_plan(), Workers(), on_part=lambda *_: None)
    found = study.compare((column.level,), PAPER_SAMPLERS, options)
    _, figure = next(figures_of(ColumnResult(column, found)))
    text = text_of(figure)
    if new:
        save(figure, new)
    return text


def text_of(figure: Figure) -> str:
    """Return titles, labels and legend of a figure that is not drawn yet, without numbers of axes.

    Args:
        figure: the figure.
    """
    texts = [text.get_text() for text in figure.findobj(Text) if isinstance(text, Text)]
    return "\n".join(filter(None, texts))


def drawing(name: str, new: Path | None) -> str:
    """Draw a template with the colours of the report and the numbers of the scenario.

    Args:
        name: name of the template.
        new: new file; None for the text alone.
    """
    found = re.findall(r"--(\w+): (#[0-9a-f]{6});", source_of("report.css"))
    templates = Environment(  # noqa: S701 (a drawing of our own)
        loader=FileSystemLoader(Path(__file__).with_name("drawings")),
        trim_blocks=True,
        undefined=StrictUndefined,
    )
    text = templates.get_template(f"{name}.svg.jinja").render(
        colours=dict(reversed(found)),  # the first one of each is that of light pages
        scenario=US23,
        meanings=meanings(US23),
        room=room,
    )
    if new:
        new.write_text(text, encoding="utf-8")
    return text


def room(name: str) -> str:
    """Return the name of a file or folder of the package as a drawing shows it.

    Args:
        name: the name.
    """
    path = ROOT / "merge_sumo" / name
    if not path.exists():
        sys.exit(f"tools/drawings/ names {path}, which is not there")
    return f"{name}/" if path.is_dir() else name


def notebook(new: Path | None) -> str:
    """Execute the notebook of the documentation.

    Args:
        new: new file; None for the text alone.
    """
    cells = executed()
    if new:
        write(cells, new)
    return shown(cells)


def scenario_folder(name: str, new: Path | None) -> str:
    """Write an example as a replay folder.

    Args:
        name: name of the example.
        new: new folder; None for the text alone.

    Returns:
        The text of all its files.
    """
    with tempfile.TemporaryDirectory() as scratch:
        folder = new or Path(scratch) / name
        played = play(name)
        write_replay_folder(folder, played.road, played.outcome, played.trajectory)
        return stored_text(folder)


MAKERS: dict[str, Maker] = {
    "docs/pictures/scenario.svg": partial(drawing, "scenario"),
    "docs/pictures/architecture.svg": partial(drawing, "architecture"),
    **{f"scenarios/{name}": partial(scenario_folder, name) for name in EXAMPLES},
    "scenarios/queue/motion.png": partial(motion_picture, "queue"),
    "scenarios/stalemate/motion.png": partial(motion_picture, "stalemate"),
    "scenarios/roundabout-stalemate/motion.png": partial(motion_picture, "roundabout-stalemate"),
    "scenarios/sumo-gui.png": partial(gui_picture, "stalemate", 8.7),
    "scenarios/roundabout.png": partial(gui_picture, "roundabout-stalemate", 8.5),
    "scenarios/curves-level1.png": curves_picture,
    "scenarios/report.png": report_picture,
    "docs/tutorials/notebook.ipynb": notebook,
}
"""How each picture is made, by its path in the checkout."""


def pictures_on_pages() -> set[str]:
    """Return the pictures that README and the site show, by their paths in the checkout."""
    shown = set()
    for page in (ROOT / "README.md", *ROOT.glob("docs/**/*.md")):
        for link in re.findall(r"\]\(([^):]+\.(?:png|svg))\)", page.read_text(encoding="utf-8")):
            shown.add((page.parent / link).resolve().relative_to(ROOT).as_posix())
    return shown


def clipped_texts(name: str) -> list[str]:
    """Return the texts of a drawing that leave their box, in Chromium.

    Args:
        name: path of the drawing in the checkout.
    """
    with browser_page() as page:
        page.goto((ROOT / name).as_uri())
        return list(page.evaluate(CLIPPED_TEXTS))


def stored_text(path: Path) -> str:
    """Return the text of a picture of the checkout, "" where there is none.

    Args:
        path: a PNG, a drawing, a notebook, or a folder of a scenario.
    """
    if path.is_dir():
        files = [file for file in sorted(path.iterdir()) if file.suffix != ".png"]
        return "\n".join(f"{file.name}\n{file.read_text(encoding='utf-8')}" for file in files)
    if not path.exists():
        return ""
    if path.suffix == ".ipynb":
        return shown(written(path))
    if path.suffix == ".svg":
        return path.read_text(encoding="utf-8")
    with Image.open(path) as image:
        return str(image.info.get(DESCRIPTION, ""))


def difference(name: str) -> list[str]:
    """Return the lines in which a stored text differs from the tool's; none where they are equal.

    Args:
        name: path of the picture in the checkout.
    """
    stored, today = stored_text(ROOT / name).splitlines(), MAKERS[name](None).splitlines()
    return list(difflib.unified_diff(stored, today, "stored", "today", n=0, lineterm=""))


def make(name: str) -> None:
    """Make a picture in place of the stored one.

    Args:
        name: path of the picture in the checkout.
    """
    with tempfile.TemporaryDirectory() as scratch:
        new = Path(scratch) / Path(name).name
        text = MAKERS[name](new)
        if new.is_dir():
            shutil.copytree(new, ROOT / name, dirs_exist_ok=True)
        elif new.suffix != ".png":
            shutil.copyfile(new, ROOT / name)
        else:
            (ROOT / name).write_bytes(described_png(new, text))


def described_png(path: Path, text: str) -> bytes:
    """Return a PNG in at most 256 colours, with its text.

    Args:
        path: the picture.
        text: the text that it shows.
    """
    description = PngImagePlugin.PngInfo()
    description.add_itxt(DESCRIPTION, text, zip=True)
    with Image.open(path) as image, io.BytesIO() as content:
        few = image.convert("RGB").quantize(256, kmeans=2, dither=Image.Dither.NONE)
        few.save(content, "PNG", optimize=True, pnginfo=description)
        return content.getvalue()


def main() -> None:
    """Make pictures, or print the names of outdated pictures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="path in the checkout")
    parser.add_argument("--check", action="store_true", help="make no picture")
    options = parser.parse_args()
    if unknown := set(options.names) - set(MAKERS):
        parser.error(f"{min(unknown)} is none of {', '.join(MAKERS)}")
    stale = False
    for name in options.names or MAKERS:
        if options.names and not options.check:
            make(name)
        elif lines := difference(name):
            stale = True
            if options.check:
                print(f"{name} is out of date:", *lines[:LINES_SHOWN], sep="\n", flush=True)
            else:
                make(name)
                print(f"{name} is made", flush=True)
    sys.exit(int(options.check and stale))


if __name__ == "__main__":
    main()
