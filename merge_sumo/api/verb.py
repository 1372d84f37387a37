"""Verbs: functions whose keywords are the fields of a config."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Callable
from dataclasses import fields
from functools import cache, update_wrapper
from itertools import pairwise
from typing import Any, ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

from merge_sumo import config as configs

P = ParamSpec("P")
C = TypeVar("C")
R = TypeVar("R")


def verb(config: Callable[P, C]) -> Callable[[Callable[[C], R]], Callable[P, R]]:
    """Return a decorator of a function of a config, which then takes the fields of that."""

    def decorated(work: Callable[[C], R]) -> Callable[P, R]:
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            # One thread: products are small, and the cores are for workers.
            with threadpool_limits(1):
                return work(config(*args, **kwargs))

        update_wrapper(call, work)
        # What `help` shows.
        signature = inspect.signature(config).replace(
            return_annotation=work.__annotations__["return"]
        )
        vars(call)["__signature__"] = signature
        call.__doc__ = f"{inspect.getdoc(config)}\n\nArgs:\n{_arguments(config)}"
        return call

    return decorated


def _arguments(config: Any) -> str:
    """Return the fields of a config with the docstrings under them."""
    lines = []
    for field in fields(config):
        owner = next(kind for kind in config.__mro__ if field.name in kind.__annotations__)
        lines.append(f"    {field.name}: {_docstrings()[owner.__name__, field.name]}")
    return "\n".join(lines)


@cache
def _docstrings() -> dict[tuple[str, str], str]:
    """Return the docstrings under the fields, by the name of the class and that of the field."""
    found = {}
    for kind in ast.parse(inspect.getsource(configs)).body:
        if not isinstance(kind, ast.ClassDef):
            continue
        for field, text in pairwise(kind.body):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
                name = ast.unparse(field.target)
                found[kind.name, name] = " ".join(ast.literal_eval(text.value).split())
    return found
