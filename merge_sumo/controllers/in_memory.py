"""VUTs that are objects of this Python process: a class of a notebook, a lambda, an instance.

An importable object is named `module:Name` and hosted as on the command line; any other one is
named `here:Name` and drives in this process.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, Protocol, SupportsFloat

from merge_sumo.controllers.controller import Seen
from merge_sumo.controllers.kinds import parse, runs_code
from merge_sumo.controllers.python import SeenBatch, object_of, objects
from merge_sumo.controllers.signatures import is_code
from merge_sumo.controllers.spec import HERE, ControllerSpec
from merge_sumo.errors import notice

Answer = SupportsFloat | tuple[SupportsFloat, bool]
"""An acceleration, or it and whether to merge."""


class Acts(Protocol):
    """A controller of one corridor."""

    def act(self, seen: Seen, /) -> Answer:
        """Return the acceleration for the next 0.1 s, in m/s2, or it and whether to merge.

        Args:
            seen: the observation at this step.
        """


class ActsInBatches(Protocol):
    """A controller of all K corridors at once."""

    def act_batch(self, seen: SeenBatch, /) -> Any:
        """Return accelerations for 0.1 s, in m/s2, (K,), or these and whether to merge, (2, K).

        Args:
            seen: the observation of all corridors at this step.
        """


AnyVut = str | type[Any] | Callable[[Seen], Answer] | Acts | ActsInBatches
"""A spec, as after `--vut`, or a class, a function, or an object with `act` or `act_batch`."""


def spec_of(vut: Any) -> str:
    """Return the spec of a VUT for this process and for those that it starts.

    Args:
        vut: a spec, or an object that drives; that it can is checked when it is loaded.
    """
    if isinstance(vut, str):
        return vut
    if is_code(vut) and (importable := _importable(vut)) is not None:
        return importable
    name = str(getattr(vut, "__qualname__", type(vut).__qualname__)).rpartition(".")[2]
    name = "lambda" if name == "<lambda>" else name
    number, unique = 1, name
    while objects.get(unique, vut) is not vut:
        number += 1
        unique = f"{name}-{number}"
    objects[unique] = vut
    return str(ControllerSpec(HERE, unique))


def is_in_process(text: str) -> bool:
    """Return whether a spec names an object of this process.

    Args:
        text: the spec.
    """
    return parse(text).kind == HERE


def names_code(text: str) -> bool:
    """Return whether a received spec names code that would run; an object of this process does not.

    Args:
        text: the spec.
    """
    return runs_code(text) and object_of(parse(text)) is None


def spec_of_driver(vut: Any) -> str:
    """Return the spec of a controller; warn where it is an object, which has no workers.

    Args:
        vut: a spec or an object.
    """
    spec = spec_of(vut)
    if is_in_process(spec):
        notice(
            f"{parse(spec).argument} is an object: it drives in this process, without workers, "
            "and a crash of it ends this process. To give it a process of its own, put its class "
            "or function into a module.",
            UserWarning,
        )
    return spec


def _importable(target: Any) -> str | None:
    """Return MODULE:NAME of a class or a function; None if other processes cannot import it."""
    module, name = getattr(target, "__module__", None), getattr(target, "__qualname__", "")
    if module in (None, "__main__", "__mp_main__") or "<" in name:
        return None
    imported: Any = sys.modules.get(str(module))
    if getattr(imported, "__file__", None) is None:
        return None
    for part in name.split("."):
        imported = getattr(imported, part, None)
    return f"{module}:{name}" if imported is target else None
