"""Imperfect sensing and actuation of the VUT, as values of a scenario.

By default both are perfect: the VUT knows the state of every car at once, and its acceleration acts
at once. A number that is a range is a coordinate of the pool, `sense_NAME` or `act_NAME` of a case.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

from merge_sumo.errors import UserError, explained
from merge_sumo.records import convert

Bounds = tuple[float, float]
Amount = float | Bounds
"""A number, or a range: then it is a coordinate of the pool."""


def check_amount(name: str, value: Amount, possible: Bounds) -> None:
    """Check a number or a range.

    Args:
        name: its name, for messages.
        value: the number or the range.
        possible: lowest and highest possible number.

    Raises:
        UserError: a number is impossible, or the range is empty.
    """
    low, high = possible
    numbers = value if isinstance(value, tuple) else (value,)
    text = "..".join(f"{number:g}" for number in numbers)
    for number in numbers:
        if not low <= number <= high:
            raise UserError(f"{name} is {text}: choose {low:g} to {high:g}")
    if isinstance(value, tuple) and not value[0] < value[1]:
        raise UserError(f"{name} is {text}: write the lower number of a range first")


@dataclass(frozen=True, kw_only=True, slots=True)
class Imperfection:
    """Base of `Sensing` and `Actuation`: numbers and ranges by name.

    Attributes:
        possible: lowest and highest possible number of each field.
    """

    possible: ClassVar[dict[str, Bounds]]

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            UserError: a number is impossible, or a range is empty.
        """
        for field, value in self._numbers():
            check_amount(field, value, self.possible[field])

    def _numbers(self) -> Iterator[tuple[str, Amount]]:
        """Yield (field, value) of the fields with a value."""
        for field in self.possible:
            if (value := getattr(self, field)) is not None:
                yield field, value

    def to_record(self) -> dict[str, Any]:
        """Return the imperfect numbers by field, for JSON."""
        perfect = type(self)()
        return {name: v for name, v in self._numbers() if v != getattr(perfect, name)}

    @property
    def is_perfect(self) -> bool:
        """Whether it has no effect in any case."""
        return not self.to_record()

    def in_case(self, case: Any, prefix: str) -> Self:
        """Return the imperfection with the numbers of a case in place of ranges.

        Args:
            case: a case, with an attribute PREFIX_NAME for each range.
            prefix: `SENSE` or `ACT`.
        """
        numbers: dict[str, Any] = {}
        for name, value in self._numbers():
            if isinstance(value, tuple):
                numbers[name] = getattr(case, f"{prefix}_{name}")
        return replace(self, **numbers) if numbers else self

    def at_most(self, name: str, default: float = math.inf) -> float:
        """Return the largest value of a number in any case.

        Args:
            name: field of the number.
            default: value for a field without a number.
        """
        value: Amount | None = getattr(self, name)
        largest = value[1] if isinstance(value, tuple) else value
        return default if largest is None else largest

    @classmethod
    def parsed(cls, text: str, option: str) -> Self:
        """Parse the text of an option.

        Args:
            text: numbers and ranges by name, as in "delay_s=0.3,noise_x_m=0..0.5".
            option: name of the option, for messages.

        Returns:
            The imperfection.

        Raises:
            UserError: a name is unknown, or a number is missing or wrong.
        """
        values: dict[str, str | list[str]] = {}
        for part in text.split(","):
            name, _, number = part.strip().partition("=")
            values[name] = number.split("..") if ".." in number else number
        with explained(option):
            return convert(values, cls, strict=False)


@dataclass(frozen=True, kw_only=True, slots=True)
class Sensing(Imperfection):
    """Imperfect sensing of other cars by the VUT. Its own state is always exact.

    Attributes:
        delay_s: age of the states that it sees.
        noise_x_m: standard deviation of the error of positions, drawn at each step.
        noise_v_mps: standard deviation of the error of speeds, drawn at each step.
        dropout: share of the steps in which the last state of a car is repeated.
        range_m: maximum distance of front bumpers at which a car is seen; None for no limit.
        occluded_until_m: lane coordinate of the VUT from which it sees other cars; None for all.

    Example:
        >>> Sensing(delay_s=0.3, noise_x_m=(0.0, 0.5)).to_record()
        {'delay_s': 0.3, 'noise_x_m': (0.0, 0.5)}
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
        """Whether states are drawn at random."""
        return any(self.at_most(name) > 0.0 for name in ("noise_x_m", "noise_v_mps", "dropout"))


@dataclass(frozen=True, kw_only=True, slots=True)
class Actuation(Imperfection):
    """Imperfect execution of the accelerations that a controller commands.

    Attributes:
        lag_s: time constant of a first-order lag of the acceleration.
        delay_s: dead time between a command and its effect.
        power_w_per_kg: power over mass, which limits the acceleration to P / (m v); None for no
            limit.
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
