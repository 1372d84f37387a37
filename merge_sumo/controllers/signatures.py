"""Whether a class, object or function can be called as VUTs are; if not, its file and line."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

from merge_sumo.errors import UserError
from merge_sumo.printable import printable

OF_ONE: Final = {"act": ("seen",), "reset": ("seen",), "close": ()}
OF_A_BATCH: Final = {"act_batch": ("seen",), "reset": ("corridor", "seen"), "close": ()}
"""Methods of a VUT, and what each is called with; a `reset` may have a `seed` besides."""


def check_methods(vut: Any) -> None:
    """Raise `UserError` where a method of a class or object cannot be called as a VUT's is.

    The sentence names the file and line of the method. Methods whose signature Python does not know
    are left alone, as are attributes that are no methods.
    """
    batched = callable(getattr(vut, "act_batch", None))
    for name, arguments in (OF_A_BATCH if batched else OF_ONE).items():
        method = inspect.getattr_static(vut, name, None)
        first: tuple[str, ...] = ("self",)
        if isinstance(method, staticmethod | classmethod):
            first = ("cls",) if isinstance(method, classmethod) else ()
            method = method.__func__
        elif not isinstance(vut, type) and name in getattr(vut, "__dict__", {}):
            first = ()  # an attribute of the object is called as it is
        if inspect.isfunction(method):
            seeded = name == "reset" and takes_seed(method)
            check_call(method, (*first, *arguments), seeded=seeded)


def takes_seed(reset: Callable[..., Any]) -> bool:
    """Return whether a `reset` has a parameter `seed`: then it is called with the episode's."""
    try:
        return "seed" in inspect.signature(reset).parameters
    except (TypeError, ValueError):
        return False


def check_call(
    function: Callable[..., Any], arguments: tuple[str, ...], *, seeded: bool = False
) -> None:
    """Raise `UserError` where a function cannot be called with so many arguments in order.

    One that is `seeded` is called with `seed` besides.
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
