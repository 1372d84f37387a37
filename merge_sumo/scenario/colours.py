"""The colours of the vehicles, the same in every picture (Okabe and Ito, 2008)."""

from __future__ import annotations

from typing import Final

COLOURS: Final = {"pov": "#e69f00", "vut": "#0072b2", "ahead": "#009e73", "behind": "#a6518b"}
"""By the name of the vehicle; `report.css` has lighter ones for dark pages."""


def rgb(vehicle: str) -> tuple[int, int, int]:
    """Return the colour of a vehicle as red, green and blue, of 255."""
    red, green, blue = bytes.fromhex(COLOURS[vehicle][1:])
    return red, green, blue
