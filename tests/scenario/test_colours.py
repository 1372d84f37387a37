"""A vehicle has one colour in all pictures."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from merge_sumo.reports.pages import source_of
from merge_sumo.scenario.scenario import COLOURS

PICTURES = Path(__file__).resolve().parents[2] / "docs" / "pictures"


@pytest.mark.parametrize(("name", "colour"), COLOURS.items())
def test_a_vehicle_has_its_colour_on_light_pages_and_on_paper(name, colour):
    light, dark, paper = re.findall(rf"--{name}: (#[0-9a-f]{{6}});", source_of("report.css"))
    assert (light, paper) == (colour, colour)
    assert dark != colour, "a dark page has a lighter one"


def test_the_start_page_draws_the_cars_in_the_same_colours():
    drawing = (PICTURES / "scenario.svg").read_text(encoding="utf-8")
    cars = re.findall(r'<rect class="car" [^>]*fill="(#[0-9a-f]{6})"', drawing)
    assert cars == [COLOURS[name] for name in ("pov", "vut", "pov", "vut")]
    marks = re.findall(r'fill="([^"]*)" stroke="(#[0-9a-f]{6})" stroke-width="2"/>\n<text', drawing)
    contact, conflict, harsh, safe = "#a63600", "#e08214", "#8856a7", "#5c6b78"
    full, rings = [(contact, contact), (safe, safe)], [("none", conflict), ("none", harsh)]
    assert marks == [full[0], *rings, full[1]]
