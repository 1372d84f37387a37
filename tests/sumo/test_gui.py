"""An exported folder opens in a real sumo-gui, and shows the road and two cars."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from lxml import etree
from PIL import Image, ImageColor

from merge_sumo.campaigns.campaign import export_case
from merge_sumo.campaigns.recorded import failures
from merge_sumo.metrics.merge import Conflict
from merge_sumo.reports.text import timelines
from merge_sumo.road.loader import centre_lines, road_for
from merge_sumo.scenario.scenario import COLOURS, DT_S, US23
from merge_sumo.sumo.replay_folder import LABELS, VIEW

PICTURE_TIMES_S = (2.0, 7.0)
LABELS_SHARE = 0.2
"""Of the height of a picture, from the top: there are the labels."""
NEAR = 40
"""Distance in each channel of 255 below which a pixel has a colour."""

SHOW = """
from lxml import etree
from merge_sumo.cli import main
from merge_sumo.sumo import replay_folder

view, config = replay_folder.view_settings, replay_folder._config

def with_pictures(*arguments, **options):
    root = view(*arguments, **options)
    root.find("delay").set("value", "0")
    for file, time in {times}.items():
        etree.SubElement(root, "snapshot", file=file, time=time)
    return root

def that_ends(*arguments):
    root = config(*arguments)
    root.find("delay").set("value", "0")
    etree.SubElement(root, "quit-on-end", value="true")
    root.remove(root.find("breakpoints"))
    return root

replay_folder.view_settings, replay_folder._config = with_pictures, that_ends
main()
"""


@pytest.fixture(scope="module")
def pictures(run, display, tmp_path_factory) -> list[np.ndarray]:
    """Return pictures of an exported failure at two times as arrays.

    The folder asks for a picture, too: it must not be taken.
    """
    scratch = tmp_path_factory.mktemp("gui")
    folder, hostile = scratch / "case", scratch / "hostile.png"
    export_case(run, failures(run.outcomes)[0].index, folder)
    view = etree.parse(folder / VIEW)
    etree.SubElement(view.getroot(), "snapshot", file=str(hostile), time="1")
    view.write(folder / VIEW)
    taken = taken_of(folder, display, scratch)
    assert not hostile.exists()
    return taken


def taken_of(folder: Path, display: str, scratch: Path, *options: str) -> list[np.ndarray]:
    """Open a folder with `replay --gui` and return its pictures at two times as arrays.

    The view and the configuration that merge-sumo writes are made to take pictures and to end by
    themselves. There is no picture of a time that is not shown.
    """
    files = [scratch / f"at-{time_s:g}-s.png" for time_s in PICTURE_TIMES_S]
    times = {str(file): str(time_s) for file, time_s in zip(files, PICTURE_TIMES_S, strict=True)}
    (scratch / "show.py").write_text(SHOW.format(times=times))
    window = subprocess.Popen(
        [sys.executable, scratch / "show.py", "replay", str(folder), "--gui", *options],
        env={**os.environ, "DISPLAY": display},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        said, _ = window.communicate(timeout=120)
    finally:
        if window.poll() is None:
            os.killpg(window.pid, signal.SIGKILL)
    assert window.returncode == 0, said
    return [picture(file) for file in files if file.exists()]


def picture(file: Path) -> np.ndarray:
    with Image.open(file) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def places(image: np.ndarray, colour: tuple[float, ...]) -> np.ndarray:
    """Return the pixels near a colour as rows of (y, x)."""
    return np.argwhere((np.abs(image - np.array(colour)) < NEAR).all(axis=2))


def car(image: np.ndarray, who: str) -> np.ndarray:
    """Return the pixels of a car, which is below the labels."""
    labels = round(LABELS_SHARE * image.shape[0])
    return np.array([labels, 0]) + places(image[labels:], ImageColor.getrgb(COLOURS[who]))


def test_the_cars_meet(pictures):
    apart = []
    for image in pictures:
        apart.append(math.dist(car(image, "pov").mean(axis=0), car(image, "vut").mean(axis=0)))
    assert apart[1] < apart[0]


def test_a_car_is_to_scale_on_a_grey_road_with_its_speed_above_it(pictures):
    last = pictures[1]
    car_px = car(last, "pov")
    (top, left), (bottom, right) = car_px.min(axis=0), car_px.max(axis=0)
    assert len(places(last, (201.0, 199.0, 194.0))) > 5000, "a road as in the report"
    assert 2.0 < (right - left) / (bottom - top) < 3.2, "5 m and 1.8 m"
    assert right - left >= 18
    above = last[top - 30 : top - 8, left:right]
    assert len(places(above, (26.0, 26.0, 26.0))) > 20, "a speed"


def test_it_begins_before_the_conflict_and_looks_the_same_from_there_on(
    run, pictures, display, tmp_path
):
    index = failures(run.outcomes)[0].index
    export_case(run, index, tmp_path / "case")
    begin_s = Conflict.of(run.trajectory(index), centre_lines(road_for(US23))).row * DT_S - 3.0
    assert PICTURE_TIMES_S[0] < begin_s - 0.2 < begin_s < PICTURE_TIMES_S[1]
    (taken,) = taken_of(tmp_path / "case", display, tmp_path, "--from", "-3")
    assert (taken == pictures[1]).all()


def test_the_window_has_the_case_its_result_and_the_colours_of_the_report(run, pictures, tmp_path):
    outcome = failures(run.outcomes)[0]
    export_case(run, outcome.index, tmp_path / "case")
    labels = etree.parse(tmp_path / "case" / LABELS).getroot()
    case, result, *legend = (str(param.get("value")) for param in labels.iter("param"))
    assert case.startswith(f"case {outcome.index}, POV level {outcome.case.level}: x_POV0 ")
    assert result == timelines(run, [outcome])[outcome.index].result
    assert legend == ["POV", "VUT", "speeds in m/s"]
    for image in pictures:
        top = image[: round(LABELS_SHARE * image.shape[0])]
        assert len(places(top, (26.0, 26.0, 26.0))) > 100, "a text"
        for who in ("pov", "vut"):
            assert len(places(top, ImageColor.getrgb(COLOURS[who]))) > 20, "a dot of the legend"
