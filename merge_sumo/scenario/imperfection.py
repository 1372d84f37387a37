"""What lies between a controller and the road: how the VUT senses other cars, and how it obeys.

Both are values of a scenario. Zero, which is the default, is perfect: the VUT knows the state of
every car in the step in which it is asked, and its acceleration acts at once. A range makes a
number a coordinate of the pool: a case calls it `sense_...` or `act_...`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, Self, TypeVar

from merge_sumo.errors import UserError
from merge_sumo.printable import either, meant

Bounds = tuple[float, float]
Amount = float | Bounds
"""A number, or a range: then it is a coordinate of the pool."""


class Imperfection:
    """What `Sensing` and `Actuation` have in common: numbers in their ranges, by name."""

    __slots__ = ()

    def __post_init__(self) -> None:
        """Check the numbers; raises `UserError`."""
        for field, value in self._given():
            low, high = RANGES[type(self)][field]
            numbers = value if isinstance(value, tuple) else (value,)
            if not all(math.isfinite(x) and low <= x <= high for x in numbers):
                raise UserError(f"{field} is {_in_words(value)}: choose {low:g} to {high:g}")
            if isinstance(value, tuple) and not value[0] < value[1]:
                raise UserError(
                    f"{field} is {_in_words(value)}: the first number of a range must be the lower"
                )

    def _given(self) -> Iterator[tuple[str, Amount]]:
        """Yield (field, value) of what is not left out."""
        for field in fields(self):  # type: ignore[arg-type]
            if (value := getattr(self, field.name)) is not None:
                yield field.name, value

    def to_record(self) -> dict[str, Any]:
        """Return what is imperfect, as JSON keeps it."""
        default = type(self)()
        return {name: v for name, v in self._given() if v != getattr(default, name)}

    @property
    def is_perfect(self) -> bool:
        """Whether it changes nothing, in any case."""
        return not self.to_record()

    @property
    def text(self) -> str:
        """What is imperfect, as it is written after an option; empty where nothing is."""
        return ",".join(f"{name}={_in_words(value)}" for name, value in self.to_record().items())

    @property
    def ranged(self) -> tuple[str, ...]:
        """Fields that are coordinates of the pool."""
        return tuple(name for name, value in self._given() if isinstance(value, tuple))

    def at_most(self, name: str, default: float = math.inf) -> float:
        """Return the largest value of a number that may be a range; the default without one."""
        value: Amount | None = getattr(self, name)
        largest = value[1] if isinstance(value, tuple) else value
        return default if largest is None else largest

    @classmethod
    def parsed(cls, text: str, option: str) -> Self:
        """Return the text of an option: "delay_s=0.3,noise_x_m=0..0.5".

        Raises `UserError`, with the option's name, for what it does not have.
        """
        known = [field.name for field in fields(cls)]  # type: ignore[arg-type]
        parts = [part for part in map(str.strip, text.split(",")) if part]
        if not parts:
            raise UserError(f"{option} is empty: give NAME=NUMBER, with a name of {either(known)}")
        values: dict[str, Amount] = {}
        for part in parts:
            name, equals, number = part.partition("=")
            if name not in known:
                hint = meant(name, known) or f"choose from {', '.join(known)}"
                raise UserError(f"{option}: {name!r:.60} is unknown: {hint.strip()}")
            if name in values:
                raise UserError(f"{option}: {name} is given twice")
            if not equals:
                raise UserError(f"{option}: {name} has no number: give {name}=NUMBER")
            low, dots, high = number.partition("..")
            try:
                values[name] = (float(low), float(high)) if dots else float(low)
            except ValueError:
                raise UserError(
                    f"{option}: {name} is {number!r:.60}: give a number, or a range as 0..0.5"
                ) from None
        try:
            return cls(**values)
        except UserError as error:
            raise UserError(f"{option}: {error}") from error


def _in_words(value: Amount) -> str:
    """Return a number or a range as it is written after an option."""
    return "..".join(f"{x:g}" for x in (value if isinstance(value, tuple) else (value,)))


Kind = TypeVar("Kind", bound=Imperfection)


@dataclass(frozen=True, kw_only=True, slots=True)
class Sensing(Imperfection):
    """How the VUT senses the other cars; its own state it knows.

    Attributes:
        delay_s: age of what it sees.
        noise_x_m: standard deviation of the error of a position, drawn again in each step.
        noise_v_mps: standard deviation of the error of a speed.
        dropout: share of the steps in which nothing new arrives of a car; the last state is kept.
        range_m: a car farther away than this, between front bumpers, is not seen.
        occluded_until_m: no car is seen while the VUT is before this place.
    """

    delay_s: Amount = 0.0
    noise_x_m: Amount = 0.0
    noise_v_mps: Amount = 0.0
    dropout: Amount = 0.0
    range_m: Amount | None = None
    occluded_until_m: Amount | None = None

    @property
    def is_random(self) -> bool:
        """Whether something of it is drawn at random."""
        names = ("noise_x_m", "noise_v_mps", "dropout")
        return any(self.at_most(name) > 0.0 for name in names)


@dataclass(frozen=True, kw_only=True, slots=True)
class Actuation(Imperfection):
    """How the VUT obeys the accelerations that its controller commands.

    Attributes:
        lag_s: time constant of a first-order lag of the acceleration.
        delay_s: dead time: a command acts so much later.
        power_w_per_kg: power over mass; above the speed P / (m a) it limits the acceleration.
    """

    lag_s: Amount = 0.0
    delay_s: Amount = 0.0
    power_w_per_kg: Amount | None = None


RANGES: dict[type, dict[str, Bounds]] = {
    Sensing: {
        "delay_s": (0.0, 5.0),
        "noise_x_m": (0.0, 100.0),
        "noise_v_mps": (0.0, 100.0),
        "dropout": (0.0, 1.0),
        "range_m": (1.0, 5000.0),
        "occluded_until_m": (-5000.0, 2000.0),
    },
    Actuation: {"lag_s": (0.0, 5.0), "delay_s": (0.0, 5.0), "power_w_per_kg": (1.0, 1000.0)},
}
"""What the numbers can be, by field."""
PERFECT_SENSING = Sensing()
PERFECT_ACTUATION = Actuation()

SENSE = "sense"
ACT = "act"


def with_numbers(imperfection: Kind, prefix: str, case: Any) -> Kind:
    """Return an imperfection with the numbers that a case has for its ranges.

    Args:
        imperfection: fields that are a number or a range of numbers.
        prefix: begins the names of these fields in a case.
        case: the case, with an attribute PREFIX_NAME for each of them.
    """
    ranged = imperfection.ranged
    if not ranged:
        return imperfection
    values: dict[str, Any] = {name: getattr(case, f"{prefix}_{name}") for name in ranged}
    return replace(imperfection, **values)  # type: ignore[type-var]
