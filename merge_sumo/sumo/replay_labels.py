"""What stands in the picture of a replay: the case, the verdict, and the colours of the cars.

The labels stand at fixed places above the road, as points of interest with a text. Names at the
cars would lie on each other at M, where a reader looks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from lxml import etree

from merge_sumo.values.case import Case
from merge_sumo.values.scenario import VEHICLES, level_name
from merge_sumo.values.score import Outcome

COLOURS: Final = {
    "pov": "0.90,0.62,0",
    "vut": "0,0.45,0.70",
    "ahead": "0,0.62,0.45",
    "behind": "0.65,0.32,0.56",
}
"""Of the cars, as in the report."""
NAMES: Final = {"pov": "POV", "vut": "VUT", "ahead": "car ahead", "behind": "car behind"}
TEXT: Final = "text"
"""Parameter of a point of interest that is shown."""
INK: Final = "0.1,0.1,0.1"
LINES: Final = (0.45, 0.40)
"""Heights of the lines above the middle of the picture, as shares of its height."""
LEGEND: Final = 0.36
"""Height of the dots."""
RAISED: Final = 0.022
"""How much higher than its place a text is drawn, as a share of the picture's height."""
LETTER: Final = 0.0065
"""Width of a letter, as a share of the picture's width."""
DOT: Final = 0.012
"""Diameter of the dots of the legend, as a share of the picture's width."""
APART: Final = 0.13
"""Of two dots, as a share of the picture's width."""


@dataclass(frozen=True, slots=True)
class Picture:
    """What sumo-gui shows at first: its zoom, its middle, and how much of the road that is."""

    exaggeration: str
    zoom: str
    x_m: float
    y_m: float
    width_m: float
    height_m: float


def beside(text: str, *, ahead: bool) -> str:
    """Return the label of a car that moves, pushed ahead of it or behind it by spaces.

    Labels stand over the middle of their cars, and at M these are in one place. A space is half as
    wide as a letter.
    """
    room = " " * (round(2.6 * len(text)) + 8)
    return room + text if ahead else text + room


def labels_of(outcome: Outcome, picture: Picture) -> etree._Element:
    """Return the labels of an episode as an additional file."""
    root = etree.Element("additional")
    lines = (case_line(outcome.case, outcome.index), verdict_line(outcome))
    for number, (line, height) in enumerate(zip(lines, LINES, strict=True)):
        at = picture.x_m, picture.y_m + height * picture.height_m
        _label(root, f"line{number}", at, line)
    cars = VEHICLES[: outcome.case.scenario.vehicles]
    dot_m, apart_m = DOT * picture.width_m, APART * picture.width_m
    y = picture.y_m + LEGEND * picture.height_m
    for place, name in enumerate(cars):
        x = picture.x_m + (place - (len(cars) - 0.5) / 2.0) * apart_m
        _label(root, name, (x, y), "", COLOURS[name], dot_m)
        middle = x + (DOT + 0.5 * LETTER * len(NAMES[name])) * picture.width_m
        _label(root, f"{name}-name", (middle, y - RAISED * picture.height_m), NAMES[name])
    return root


def case_line(case: Case, index: int | None = None) -> str:
    """Return which case it is, with its index where it has one."""
    notation = case.scenario.notation.items()
    values = ((getattr(case, field), written) for field, written in notation)
    parts = [
        f"{written.name} {value:.{written.digits}f} {written.unit}"
        for value, written in values
        if value is not None
    ]
    named = "" if index is None else f"case {index}, "
    return f"{named}POV level {level_name(case.level)}: {', '.join(parts)}"


def verdict_line(outcome: Outcome) -> str:
    """Return what became of it."""
    found = outcome.measures
    severity = "" if found.severity is None else f"{found.severity}, "
    failed = "fails" if outcome.failed else "does not fail"
    end = found.end.value.replace("_", " ").lower()
    return f"{severity}{failed}: {end} at {found.t_end_s:.1f} s"


def _label(
    root: etree._Element,
    name: str,
    at: tuple[float, float],
    text: str,
    colour: str = INK,
    size_m: float = 0.1,
) -> None:
    poi = etree.SubElement(
        root,
        "poi",
        id=name,
        x=f"{at[0]:.2f}",
        y=f"{at[1]:.2f}",
        color=colour,
        layer="200",
        width=f"{size_m:.2f}",
        height=f"{size_m:.2f}",
    )
    if text:
        etree.SubElement(poi, "param", key=TEXT, value=text)
