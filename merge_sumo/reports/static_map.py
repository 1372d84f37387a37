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
    """A coordinate of a map, with what stands at its two ends."""

    coordinate: Coordinate

    @property
    def name(self) -> str:
        """Name and unit."""
        return f"{self.coordinate.name}, {self.coordinate.unit}"

    @property
    def ends(self) -> tuple[str, str]:
        """Lowest and highest value."""
        at = self.coordinate.dimension
        low, high = (f"{value:.4g}".replace("-", "−") for value in (at.low, at.high))
        return low, high

    def share(self, case: Case) -> float:
        """Return where a case is, as a share of the axis."""
        dimension = self.coordinate.dimension
        value = self.coordinate.of(case)
        # No coordinate of a level's map is missing in a case of that level.
        return ((value or 0.0) - dimension.low) / (dimension.high - dimension.low)


@dataclass(frozen=True, slots=True)
class Mark:
    """A case in a map: its CSS class and its place."""

    kind: str
    x: float
    y: float


@dataclass(frozen=True, slots=True)
class StaticMap:
    """A map of one level; what is last lies on top."""

    across: Axis
    up: Axis
    marks: list[Mark]


def map_of(cases: Sequence[tuple[Case, str]]) -> StaticMap:
    """Return the map of cases of one level, each with the CSS class of its mark; not of none."""
    first = cases[0][0]
    across, up = map(Axis, coordinates(first.scenario, (first.level,))[:2])
    marks = [
        Mark(
            kind,
            round(LEFT + across.share(case) * (RIGHT - LEFT), 1),
            round(BOTTOM - up.share(case) * (BOTTOM - TOP), 1),
        )
        for case, kind in cases
    ]
    return StaticMap(across, up, marks)
