"""How a class, a function or an object is called, and which numbers it has.

A VUT that cannot be called is refused by a sentence with the file and line of its method.
"""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Callable
from functools import partial
from inspect import Parameter
from pathlib import Path
from types import MemberDescriptorType
from typing import Any

import numpy as np

from merge_sumo.errors import UserError
from merge_sumo.printable import printable

OF_ONE = {"act": ("seen",), "reset": ("seen",), "close": ()}
OF_A_BATCH = {"act_batch": ("seen",), "reset": ("corridor", "seen"), "close": ()}
"""Methods of a VUT and their arguments; a `reset` may also have a `seed`."""


def is_code(target: Any) -> bool:
    """Return whether something is a class or a function, and no other object."""
    return isinstance(target, type) or inspect.isroutine(target)


def check_methods(vut: Any) -> None:
    """Raise `UserError` where a method of a class or object cannot be called as a VUT's is.

    Only plain methods are checked: what else is called fails when it is called.
    """
    owner = vut if isinstance(vut, type) else type(vut)
    batched = callable(getattr(vut, "act_batch", None))
    for name, arguments in (OF_A_BATCH if batched else OF_ONE).items():
        method = inspect.getattr_static(owner, name, None)
        if inspect.isfunction(method):
            seeded = name == "reset" and takes_seed(method)
            check_call(method, ("self", *arguments), seeded=seeded)


def takes_seed(reset: Callable[..., Any]) -> bool:
    """Return whether a `reset` has a parameter `seed`: then it is called with the episode's."""
    try:
        return "seed" in inspect.signature(reset).parameters
    except (TypeError, ValueError):
        return False


def check_call(
    function: Callable[..., Any], arguments: tuple[str, ...], *, seeded: bool = False
) -> None:
    """Raise `UserError` where a function cannot be called with some arguments in order.

    Args:
        function: the function to check.
        arguments: names of the arguments, for the sentence.
        seeded: whether it is also called with the keyword `seed`.
    """
    known = partial(function, seed=0) if seeded else function
    if fits(known, len(arguments)) is not False:
        return
    name = getattr(function, "__name__", "it")
    parameters = ", ".join(inspect.signature(function).parameters)
    called = f"{name}({parameters}) is called as {name}({', '.join(arguments)})"
    raise UserError(printable(f"{_place(function)}{called}"))


def fits(function: Callable[..., Any], count: int) -> bool | None:
    """Return whether a function takes exactly `count` positional arguments; None if unknown."""
    try:
        bound = inspect.signature(function).bind
    except (TypeError, ValueError):
        return None
    try:
        bound(*range(count))
    except TypeError:
        return False
    return True


def _place(function: Callable[..., Any]) -> str:
    """Return "FILE:LINE: " of a function that is written in a file, else nothing."""
    code = getattr(inspect.unwrap(function), "__code__", None)
    if code is None or not Path(code.co_filename).is_file():
        return ""
    path = os.path.relpath(code.co_filename)
    path = code.co_filename if path.startswith(os.pardir) else path
    return f"{path}:{code.co_firstlineno}: "


def defaults_of(target: Any, by_place: int) -> dict[str, Any]:
    """Return the keywords of a class or function with their defaults; {} for another object.

    Args:
        target: the class, function or object.
        by_place: number of its first arguments that are given by their place.
    """
    defaults: dict[str, Any] = {}
    if not is_code(target):
        return defaults
    try:
        parameters = list(inspect.signature(target).parameters.values())
    except (TypeError, ValueError):  # Python does not know the signature
        return defaults
    for parameter in parameters[by_place:]:
        if parameter.kind in (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY):
            defaults[parameter.name] = parameter.default
    return defaults


def attributes_of(made: Any) -> dict[str, float]:
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
        number = number_of(value)
        if number is not None and not name.startswith("_"):
            found[name] = number
    return found


def number_of(value: Any) -> float | None:
    """Return a value as a number; None unless it is a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return None
    number = value.item() if isinstance(value, np.generic) else value
    return number if math.isfinite(number) else None
