"""Parameters of a controller: the numbers that a spec sets, as in `my_vut.py:MyVut?gain=2`.

A parameter of a controller in Python is a keyword of the constructor, or of the function, that is
the controller. One that the constructor does not have is an attribute, with a number, that the
object has once it is made.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from inspect import Parameter
from types import MemberDescriptorType
from typing import Any, Final

import numpy as np

from merge_sumo.controllers.base import VutSpec
from merge_sumo.errors import UserError

DIGITS: Final = 3
"""A value is rounded to so many digits of its range: 0.5..3 to thousandths."""
MOST_DIGITS: Final = 100
BY_NAME: Final = (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY)


class Parameters:
    """How the parameters of a spec reach the objects of a controller.

    Those that the constructor or the function knows are its keywords; the others are attributes
    that an object is given after it was made.
    """

    def __init__(
        self, target: Any, spec: VutSpec, given: Mapping[str, float], in_order: int
    ) -> None:
        """Sort `given` parameters of a class, a function or an object.

        `in_order` arguments are given by their place. Raises `UserError` for a parameter that a
        function does not have.
        """
        defaults: dict[str, Any] = {}
        if isinstance(target, type) or inspect.isroutine(target):
            with suppress(TypeError, ValueError):  # Python does not know the signature
                known = list(inspect.signature(target).parameters.values())[in_order:]
                defaults = {p.name: p.default for p in known if p.kind in BY_NAME}
        self.spec = spec
        self.keywords = {name: value for name, value in given.items() if name in defaults}
        self.attributes = {name: value for name, value in given.items() if name not in defaults}
        if self.attributes and inspect.isroutine(target):
            raise spec.has_no(next(iter(self.attributes)), defaults)
        both = defaults | self.keywords
        self._numbers = {n: v for n, value in both.items() if (v := _number(value)) is not None}

    def bound(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that has its keywords, and is called with what the VUT sees."""
        if not self.keywords:
            return function

        def called(seen: Any) -> Any:
            return function(seen, **self.keywords)

        return called

    def set_in(self, made: Any) -> Any:
        """Give an object its attributes, and return it; `UserError` where it has none of them."""
        if self.attributes:
            present = self.present(made)
            for name, value in self.attributes.items():
                if name not in present:
                    raise self.spec.has_no(name, present)
                try:
                    setattr(made, name, value)
                except Exception as error:
                    raise UserError(f"{self.spec}: {name} cannot be set") from error
        return made

    def present(self, made: Any) -> dict[str, float]:
        """Return all parameters of an object, or of a function, that have a number."""
        return ({} if inspect.isroutine(made) else _attributes(made)) | self._numbers


def _attributes(made: Any) -> dict[str, float]:
    """Return the public attributes of an object that are numbers; no code of it runs."""
    try:
        names = set(object.__getattribute__(made, "__dict__"))
    except AttributeError:
        names = set()
    for owner in type(made).__mro__:
        names |= set(vars(owner))
    found: dict[str, float] = {}
    for name in sorted(names, key=str):
        value = inspect.getattr_static(made, name, None)
        if isinstance(value, MemberDescriptorType):  # of __slots__
            value = getattr(made, name, None)
        number = _number(value)
        if number is not None and not name.startswith("_"):
            found[name] = number
    return found


def _number(value: Any) -> float | None:
    """Return a value as a number; None for what is no finite one."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return None
    number = value.item() if isinstance(value, np.generic) else value
    return number if math.isfinite(number) else None


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
        """Read a range, NAME=LOW..HIGH; raises `UserError` for what is none."""
        name, _, bounds = text.partition("=")
        try:
            low, high = map(float, bounds.split("..", 1))
        except ValueError:
            low = high = math.nan
        if not name.strip() or not (math.isfinite(low) and math.isfinite(high)):
            raise UserError(f"`params` {text}: write NAME=LOW..HIGH, as headway_s=0.5..3")
        if not low < high:
            raise UserError(f"`params` {text}: the range is empty: give the lower end first")
        return cls(name.strip(), low, high)

    @property
    def digits(self) -> int:
        """Digits behind the point of a rounded value."""
        return min(max(0, DIGITS - math.floor(math.log10(self.high - self.low))), MOST_DIGITS)
