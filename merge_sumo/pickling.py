"""Values that go to other processes by the thousand."""

from __future__ import annotations

from dataclasses import fields
from operator import attrgetter
from typing import Any, TypeVar

T = TypeVar("T")


def quickly_pickled(cls: type[T]) -> type[T]:
    """Have a frozen dataclass with slots and two fields or more pickled without a look at each.

    What `dataclass` gives it asks for its fields anew with every instance.
    """
    names = tuple(field.name for field in fields(cls))  # type: ignore[arg-type]
    state = attrgetter(*names)
    setters = [getattr(cls, name).__set__ for name in names]

    def set_state(self: T, values: tuple[Any, ...]) -> None:
        for set_value, value in zip(setters, values, strict=True):
            set_value(self, value)

    def get_state(self: T) -> Any:
        return state(self)

    cls.__getstate__ = get_state  # type: ignore[assignment]
    cls.__setstate__ = set_state  # type: ignore[attr-defined]
    return cls
