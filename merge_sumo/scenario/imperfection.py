"""What lies between a controller and the road: sensing of other cars, and obedience of the VUT.

Both are values of a scenario. Zero, which is the default, is perfect: the VUT knows the state of
every car in the step in which it is asked, and its acceleration acts at once. A range makes a
number a coordinate of the pool: a case calls it `sense_...` or `act_...`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self, TypeVar

from merge_sumo.errors import UserError
from merge_sumo.printable import either, meant

Bounds = tuple[float, float]
Amount = float | Bounds
"""A number, or a range: then it is a coordinate of the pool."""


class Imperfection:
    """The base of `Sensing` and `Actuation`: numbers in their ranges, by name."""

    __slots__ = ()
    possible: ClassVar[dict[str, Bounds]]
    """Lowest and highest numbers, by field."""

    def __post_init__(self) -> None:
        """Check the numbers; raises `UserError`."""
        for field, value in self._given():
            low, high = self.possible[field]
            numbers = value if isinstance(value, tuple) else (value,)
            text = "..".join(f"{x:g}" for x in numbers)
            if not all(low <= x <= high for x in numbers):
                raise UserError(f"{field} is {text}: choose {low:g} to {high:g}")
            if len(numbers) == 2 and not numbers[0] < numbers[1]:
                raise UserError(f"{field} is {text}: the first number of a range must be the lower")

    def _given(self) -> Iterator[tuple[str, Amount]]:
        """Yield (field, value) of all that have one."""
        for field in self.possible:
            if (value := getattr(self, field)) is not None:
                yield field, value

    def to_record(self) -> dict[str, Any]:
        """Return the imperfect numbers, as JSON keeps them."""
        default = type(self)()
        return {name: v for name, v in self._given() if v != getattr(default, name)}

    @property
    def is_perfect(self) -> bool:
        """Whether it changes nothing, in any case."""
        return not self.to_record()

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
        """Return an imperfection from the text of an option.

        Args:
            text: as in "delay_s=0.3,noise_x_m=0..0.5".
            option: its name, for messages.

        Raises:
            UserError: a name is unknown, or a number is missing or wrong.
        """
        known = list(cls.possible)
        values: dict[str, Amount] = {}
        for part in text.split(","):
            name, _, number = part.strip().partition("=")
            if name not in known or name in values:
                hint = meant(name, known) or f"give NAME=NUMBER, with a name of {either(known)}"
                raise UserError(f"{option}: {name!r:.60} is unknown or given twice: {hint.strip()}")
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


Kind = TypeVar("Kind", bound=Imperfection)


@dataclass(frozen=True, kw_only=True, slots=True)
class Sensing(Imperfection):
    """How the VUT senses the other cars; its own state it knows.

    Attributes:
        delay_s: age of the states that it sees.
        noise_x_m: standard deviation of the error of a position, drawn again in each step.
        noise_v_mps: standard deviation of the error of a speed.
        dropout: share of the steps in which nothing new arrives of a car; the last state is kept.
        range_m: a car farther away than this, between front bumpers, is not seen.
        occluded_until_m: no car is seen while the VUT is before this place.
    """

    possible: ClassVar[dict[str, Bounds]] = {
        "delay_s": (0.0, 5.0),
        "noise_x_m": (0.0, 100.0),
        "noise_v_mps": (0.0, 100.0),
        "dropout": (0.0, 1.0),
        "range_m": (1.0, 5000.0),
        "occluded_until_m": (-5000.0, 2000.0),
    }

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

    possible: ClassVar[dict[str, Bounds]] = {
        "lag_s": (0.0, 5.0),
        "delay_s": (0.0, 5.0),
        "power_w_per_kg": (1.0, 1000.0),
    }

    lag_s: Amount = 0.0
    delay_s: Amount = 0.0
    power_w_per_kg: Amount | None = None


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
