"""Verbs: functions whose keywords are the fields of a record."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import fields
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

from merge_sumo.help_texts import with_names
from merge_sumo.options import Asked
from merge_sumo.system.suggestions import nearest

P = ParamSpec("P")
A = TypeVar("A", bound=Asked)
R = TypeVar("R")


def verb(record: Callable[P, A]) -> Callable[[Callable[[A], R]], Callable[P, R]]:
    """Return a decorator of a function of a record, which is then called with the keywords of that.

    A type checker takes the signature from the record, and so does `help`. An unknown keyword is a
    `TypeError`, as in Python.
    """

    def made(do: Callable[[A], R]) -> Callable[P, R]:
        names = {one.name for one in fields(record)}  # type: ignore[arg-type]

        def call(*args: P.args, **given: P.kwargs) -> R:
            for name in given.keys() - names:
                close = nearest(name, names)
                hint = f": did you mean {close[0]!r}?" if close else ""
                raise TypeError(
                    f"{do.__name__}() got an unexpected keyword argument {name!r}{hint}"
                )
            asked = record(*args, **given)
            object.__setattr__(asked, "given", frozenset(given))
            # One thread: products are small, and the cores are for workers.
            with threadpool_limits(1):
                return do(asked)

        call.__name__, call.__qualname__, call.__module__ = (
            do.__name__,
            do.__qualname__,
            do.__module__,
        )
        call.__doc__ = _documented(record)
        returned = inspect.signature(do).return_annotation
        call.__signature__ = inspect.signature(record).replace(  # type: ignore[attr-defined]
            return_annotation=returned
        )
        return call

    return made


def _documented(record: Callable[..., Asked]) -> str:
    """Return the docstring of a verb: that of its record, and its keywords."""
    about = [
        f"    {one.name}: {with_names(one.metadata['help'])}"
        for one in fields(record)  # type: ignore[arg-type]
        if "help" in one.metadata
    ]
    return "\n".join([inspect.cleandoc(record.__doc__ or ""), "", "Args:", *about])
