"""The coordinates of a case as people read them: names, units and digits, in one place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass

from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import LEVELS, Dimension, Scenario


@dataclass(frozen=True, slots=True)
class Coordinate:
    """A coordinate of a pool: its bounds, and how a value of it is written."""

    dimension: Dimension
    name: str
    unit: str
    digits: int

    @property
    def field(self) -> str:
        """Name of the field of a case."""
        return self.dimension.field

    def of(self, case: Case) -> float | None:
        """Return the value of a case; None where its level has no such coordinate."""
        value: float | None = getattr(case, self.field)
        return value

    def share(self, case: Case) -> float:
        """Return where a case is between the bounds, from 0 to 1; 0 where it has no value."""
        low, high = self.dimension.low, self.dimension.high
        return ((self.of(case) or low) - low) / (high - low)

    def text(self, case: Case) -> str:
        """Return the value as it stands in a table; empty where there is none."""
        value = self.of(case)
        return "" if value is None else f"{value:.{self.digits}f}"


def coordinates(scenario: Scenario, levels: Sequence[int] = LEVELS) -> tuple[Coordinate, ...]:
    """Return the coordinates that a scenario has at any of some levels, in the pool's order."""
    most = max((scenario.dimensions(level) for level in levels), key=len)
    notation = scenario.notation
    return tuple(Coordinate(d, *astuple(notation[d.field])[:3]) for d in most)


def described(case: Case) -> str:
    """Return the coordinates of a case in one line."""
    return ", ".join(
        f"{c.name} {c.text(case)} {c.unit}" for c in coordinates(case.scenario, (case.level,))
    )


def outside_of_the_pool(case: Case) -> list[str]:
    """Return in sentences which coordinates of a case are outside of the pool."""
    return [
        f"{c.name} {c.text(case)} {c.unit} is outside of the pool, {c.dimension.low:g} to "
        f"{c.dimension.high:g} {c.unit}: no campaign runs such a case"
        for c in coordinates(case.scenario, (case.level,))
        if (value := c.of(case)) is not None and not c.dimension.low <= value <= c.dimension.high
    ]
