"""A vehicle has one colour in all pictures."""

from __future__ import annotations

import re

import pytest

from merge_sumo.reports.pages import source_of
from merge_sumo.scenario.scenario import COLOURS


@pytest.mark.parametrize(("name", "colour"), COLOURS.items())
def test_a_vehicle_has_its_colour_on_light_pages_and_on_paper(name, colour):
    light, dark, paper = re.findall(rf"--{name}: (#[0-9a-f]{{6}});", source_of("report.css"))
    assert (light, paper) == (colour, colour)
    assert dark != colour, "a dark page has a lighter one"
