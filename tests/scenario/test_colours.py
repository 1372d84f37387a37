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
    cars = re.findall(r'<rect [^>]*height="1[26]" rx="[34]" fill="(#[0-9a-f]{6})"', drawing)
    assert cars == [COLOURS[name] for name in ("pov", "vut", "vut", "pov")]
