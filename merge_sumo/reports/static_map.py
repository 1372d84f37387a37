"""Maps of cases as SVG without a script: where they are in the first two coordinates of a level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from merge_sumo.analysis.coordinates import Coordinate, coordinates
from merge_sumo.values.case import Case

LEFT: Final = 52.0
RIGHT: Final = 386.0
TOP: Final = 8.0
BOTTOM: Final = 294.0
"""Edges of the plot in a picture of 400 by 340 (`templates/static_map.jinja`)."""


@dataclass(frozen=True, slots=True)
class Axis:
    """Name and unit of a coordinate of a map, and what stands at its two ends."""

    name: str
    ends: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class StaticMap:
    """A map of one level: CSS class and place (x, y) of each case; what is last lies on top."""

    across: Axis
    up: Axis
    marks: list[tuple[str, float, float]]


def map_of(cases: Sequence[tuple[Case, str]]) -> StaticMap:
    """Return the map of cases of one level, each with the CSS class of its mark; not of none."""
    first = cases[0][0]
    across, up = coordinates(first.scenario, (first.level,))[:2]
    marks = [
        (
            kind,
            round(LEFT + _share(across, case) * (RIGHT - LEFT), 1),
            round(BOTTOM - _share(up, case) * (BOTTOM - TOP), 1),
        )
        for case, kind in cases
    ]
    return StaticMap(_axis(across), _axis(up), marks)


def _axis(c: Coordinate) -> Axis:
    ends = (c.dimension.low, c.dimension.high)
    texts = (f"{value:.4g}".replace("-", "−") for value in ends)
    return Axis(f"{c.name}, {c.unit}", tuple(texts))


def _share(c: Coordinate, case: Case) -> float:
    """Return where a case is, as a share of the axis."""
    # No coordinate of a level's map is missing in a case of that level.
    return ((c.of(case) or 0.0) - c.dimension.low) / (c.dimension.high - c.dimension.low)
