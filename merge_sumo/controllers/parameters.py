"""Ranges of the parameters of a controller, as `explain` varies them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from merge_sumo.controllers.spec import ControllerKind
from merge_sumo.errors import UserError

DIGITS = 3
"""Digits of a rounded value relative to its range: 0.5..3 is rounded to thousandths."""


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
        """Return the range of a text.

        Args:
            text: NAME=LOW..HIGH.

        Raises:
            UserError: for another text, or an empty range.
        """
        name, _, bounds = text.partition("=")
        try:
            low, high = map(float, bounds.split("..", 1))
        except ValueError:
            low = high = math.nan
        if not (name.strip() and -math.inf < low < high < math.inf):
            raise UserError(f"`params` {text}: write NAME=LOW..HIGH, such as headway_s=0.5..3")
        return cls(name.strip(), low, high)

    @property
    def digits(self) -> int:
        """Digits after the decimal point of a rounded value."""
        return min(max(0, DIGITS - math.floor(math.log10(self.high - self.low))), 100)


def values_of(controller: ControllerKind, ranges: Sequence[Range]) -> dict[str, float]:
    """Return the present values of the parameters of some ranges, by name.

    Args:
        controller: the controller.
        ranges: a range for each parameter.

    Raises:
        UserError: for a parameter that is unknown, or out of its range.
    """
    known = controller.parameters() if ranges else {}
    values: dict[str, float] = {}
    for each in ranges:
        name = each.name
        if name not in known and controller.vut_type is not None:
            raise UserError(
                f"`params` {name}: its present value is unknown: set it in `vut` with {name}=VALUE"
            )
        if name not in known:
            raise controller.spec.unknown_parameter(name, known)
        if not each.low <= known[name] <= each.high:
            raise UserError(
                f"`params` {name}={each.low:g}..{each.high:g}: the present value is "
                f"{known[name]:g}: choose a range that contains it"
            )
        values[name] = float(known[name])
    return values
