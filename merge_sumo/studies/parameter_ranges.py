"""Ranges of the parameters of a controller, and specs with other values of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from merge_sumo.errors import UserError
from merge_sumo.system.printable import quoted
from merge_sumo.system.suggestions import meant
from merge_sumo.vuts.base import with_options
from merge_sumo.vuts.registry import VutFactory, is_built_in, parameters_of

DIGITS: Final = 3
"""A value is rounded to so many digits of its range: 0.5..3 to thousandths."""
FACTOR: Final = 2.0
"""A range that nobody names is from today's value over this to today's value times this."""


@dataclass(frozen=True, slots=True)
class Range:
    """The values that a parameter may take.

    Attributes:
        name: the parameter.
        low: its least value.
        high: its largest value.
    """

    name: str
    low: float
    high: float

    @classmethod
    def parsed(cls, text: str) -> Range:
        """Return the range of NAME=LOW..HIGH; `UserError` for what is none."""
        name, _, bounds = text.partition("=")
        try:
            low, high = map(float, bounds.split("..", 1))
        except ValueError:
            low = high = math.nan
        if not name.strip() or not (math.isfinite(low) and math.isfinite(high)):
            raise UserError(f"--param {text}: write NAME=LOW..HIGH, as headway_s=0.5..3")
        if not low < high:
            raise UserError(f"--param {text}: the range is empty: give the lower end first")
        return cls(name.strip(), low, high)

    @property
    def digits(self) -> int:
        """Digits behind the point of a rounded value; below 0 for tens, hundreds, ..."""
        return DIGITS - math.floor(math.log10(self.high - self.low))

    def rounded(self, value: float) -> float:
        """Return a value of the range with few digits."""
        return min(max(round(value, self.digits), self.low), self.high)


def check_names(ranges: Sequence[Range]) -> None:
    """Raise `UserError` for a parameter that is named twice."""
    names = [one.name for one in ranges]
    for name in names:
        if names.count(name) > 1:
            raise UserError(f"--param {name} is given twice: give each parameter once")


def default_ranges(vut: VutFactory) -> tuple[Range, ...]:
    """Return a range around each parameter of a VUT of this package, from half to double.

    One that is 0 has none. Controllers of other people have none: which of their attributes are
    parameters, and how far these may change, is not known.
    """
    known = parameters_of(vut) if is_built_in(vut.spec) else {}
    return tuple(
        Range(name, min(ends), max(ends))
        for name, value in known.items()
        if value and (ends := (value / FACTOR, value * FACTOR))
    )


def spec_with(
    vut: str, values: Mapping[str, float], today: Mapping[str, float] | None = None
) -> str:
    """Return the spec of a controller with values of its parameters, but not with `today`'s."""
    known = today or {}
    changed = {name: f"{v:.12g}" for name, v in values.items() if known.get(name) != v}
    return with_options(vut, changed) if changed else vut


def todays_values(vut: VutFactory, ranges: Sequence[Range]) -> dict[str, float]:
    """Return today's values of the parameters; `UserError` where one is unknown or out of range."""
    known = parameters_of(vut)
    is_sumo = vut.vut.vut_type is not None
    for one in ranges:
        if one.name not in known and is_sumo:
            raise UserError(
                f"--param {one.name}: its value today is not known; name it, as in "
                f"--vut {quoted(spec_with(vut.spec, {one.name: one.low}))}"
            )
        if one.name not in known:
            hint = meant(one.name, known)
            names = f"{hint}choose from {', '.join(sorted(known))}" if known else "it has none"
            raise UserError(f"--param {one.name}: {vut.spec} has no such parameter: {names}")
        if not one.low <= known[one.name] <= one.high:
            raise UserError(
                f"--param {one.name}={one.low:g}..{one.high:g}: it is {known[one.name]:g} today, "
                "which is not in that range: give a range around it"
            )
    return {one.name: float(known[one.name]) for one in ranges}
