"""How a class, a function or an object of a user is called, and which numbers it has."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from inspect import Parameter
from types import MemberDescriptorType
from typing import Any

import numpy as np

from merge_sumo.errors import UserError
from merge_sumo.printable import printable

OF_ONE = {"act": ("seen",), "reset": ("seen",), "close": ()}
OF_A_BATCH = {"act_batch": ("seen",), "reset": ("corridor", "seen"), "close": ()}
"""Methods of a VUT and their arguments; a `reset` may also have a `seed`."""


def is_code(target: Any) -> bool:
    """Return whether an object is a class or a function.

    Args:
        target: any object.
    """
    return isinstance(target, type) or inspect.isroutine(target)


def check_methods(vut: Any) -> None:
    """Check that the methods of a class or object can be called as those of a VUT.

    Only plain methods are checked: others fail when they are called.

    Args:
        vut: the class or object.

    Raises:
        UserError: for a method that takes other arguments.
    """
    owner = vut if isinstance(vut, type) else type(vut)
    batched = callable(getattr(vut, "act_batch", None))
    for name, arguments in (OF_A_BATCH if batched else OF_ONE).items():
        method = inspect.getattr_static(owner, name, None)
        if inspect.isfunction(method):
            check_call(method, ("self", *arguments))


def _parameters(function: Callable[..., Any]) -> Mapping[str, Parameter]:
    """Return the parameters of a function by name; none where Python does not know them."""
    try:
        return inspect.signature(function).parameters
    except (TypeError, ValueError):
        return {}


def takes_seed(reset: Callable[..., Any]) -> bool:
    """Return whether a method has a parameter `seed`: then it is called with the episode's.

    Args:
        reset: the method.
    """
    return "seed" in _parameters(reset)


def check_call(function: Callable[..., Any], arguments: tuple[str, ...]) -> None:
    """Check that a function can be called with some arguments in order.

    Args:
        function: the function.
        arguments: their names.

    Raises:
        UserError: if it takes others.
    """
    name = getattr(function, "__name__", "it")
    if fits(function, len(arguments), seeded=name == "reset"):
        return
    parameters = ", ".join(_parameters(function))
    called = f"{name}({parameters}) must accept the call {name}({', '.join(arguments)})"
    raise UserError(printable(called))


def fits(function: Callable[..., Any], count: int, *, seeded: bool = False) -> bool:
    """Return whether a function takes a number of positional arguments; True where not known.

    Args:
        function: the function.
        count: number of arguments.
        seeded: whether it is also called with the keyword `seed` if it has it.
    """
    keywords = {"seed": 0} if seeded and takes_seed(function) else {}
    try:
        inspect.signature(function).bind(*range(count), **keywords)
    except ValueError:  # Python does not know the signature
        return True
    except TypeError:
        return False
    return True


def defaults_of(target: Any, positional: int) -> dict[str, Any]:
    """Return the keywords of a class or function with their defaults; {} for another object.

    Args:
        target: the class, function or object.
        positional: number of first arguments that are positional in a call.
    """
    defaults: dict[str, Any] = {}
    if is_code(target):
        for parameter in list(_parameters(target).values())[positional:]:
            if parameter.kind in (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY):
                defaults[parameter.name] = parameter.default
    return defaults


def attributes_of(made: Any) -> dict[str, float]:
    """Return the public attributes of an object that are numbers, by name; no property runs.

    Args:
        made: the object.
    """
    values: dict[str, Any] = {}
    for name in sorted(object.__dir__(made)):
        value = inspect.getattr_static(made, name, None)
        if isinstance(value, MemberDescriptorType):  # of __slots__
            value = getattr(made, name, None)
        if not name.startswith("_"):
            values[name] = value
    return numbers_of(values)


def numbers_of(values: Mapping[str, Any]) -> dict[str, float]:
    """Return the values that are finite numbers, as numbers of Python, by name.

    Args:
        values: any objects by name.
    """
    numbers: dict[str, float] = {}
    for name, value in values.items():
        number = value.item() if isinstance(value, np.number) else value
        if type(number) in (int, float) and math.isfinite(number):
            numbers[name] = number
    return numbers
