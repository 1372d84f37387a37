"""VUTs that are objects of this Python process: a class of a notebook, a lambda, an instance.

What can be imported is named, `module:Name`, and hosted as on the command line. The rest is kept
here under a name of its own, `here:Name`, and drives in the process that runs the cases.
"""

from __future__ import annotations

import inspect
import sys
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any, Final, Protocol, SupportsFloat

from merge_sumo.errors import UserError
from merge_sumo.system.workers import AnyWorkers, workers_or_cores
from merge_sumo.vuts.base import Seen, Vut, VutOptions, numbers_of, split_options, text_of
from merge_sumo.vuts.python import SeenBatch, is_code, vut_of

Answer = SupportsFloat | tuple[SupportsFloat, bool]
"""An acceleration, or it and whether to merge."""


class Acts(Protocol):
    """A controller of one corridor."""

    def act(self, seen: Seen, /) -> Answer:
        """Return the acceleration for the next 0.1 s, in m/s2, or it and whether to merge."""


class ActsInBatches(Protocol):
    """A controller of all K corridors at once."""

    def act_batch(self, seen: SeenBatch, /) -> Any:
        """Return accelerations for 0.1 s, in m/s2, (K,), or these and whether to merge, (2, K)."""


AnyVut = str | type[Any] | Callable[[Seen], Answer] | Acts | ActsInBatches
"""A spec, as after `--vut`, or a class, a function, or an object with `act` or `act_batch`."""
HERE: Final = "here"
"""The part of their specs before the colon."""
MAINS: Final = ("__main__", "__mp_main__")

_objects: dict[str, Any] = {}
"""By the part of their specs behind the colon."""


def spec_of(vut: Any) -> str:
    """Return what names a VUT in this process and in those that it starts: a spec as it is.

    Raises `UserError` for what is no VUT.
    """
    if isinstance(vut, str):
        return vut
    if is_code(vut):
        importable = _importable(vut)
        if importable is not None:
            return importable
    name = str(getattr(vut, "__qualname__", type(vut).__qualname__)).rpartition(".")[2]
    name = "lambda" if name == "<lambda>" else name
    vut_of_object(vut, name, VutOptions())
    number, unique = 1, name
    while _objects.get(unique, vut) is not vut:
        number += 1
        unique = f"{name}-{number}"
    _objects[unique] = vut
    return f"{HERE}:{unique}"


def is_here(spec: str) -> bool:
    """Return whether a spec names an object of this process."""
    return spec.partition(":")[0] == HERE


def object_of(spec: str) -> Any:
    """Return the object that a spec names; None for a spec that is a text for everybody."""
    return _objects.get(_name_in(spec)) if is_here(spec) else None


def keep(spec: str, vut: Any) -> None:
    """Keep an object that came from another process, under the name that it has there."""
    _objects[_name_in(spec)] = vut


def _name_in(spec: str) -> str:
    return spec.partition(":")[2].partition("?")[0]


def travels(spec: str) -> bool:
    """Return whether other processes can be given a VUT: by name, or as a copy of the object.

    What the main module defines cannot be found there.
    """
    if not is_here(spec):
        return True
    try:
        content = bytes(ForkingPickler.dumps(object_of(spec)))
    except Exception:  # whatever an object does when it is asked for a copy of itself
        return False
    return not any(name.encode() in content for name in MAINS)


def drivers_of(
    vut: Any, pov: Any, workers: AnyWorkers, *, stacklevel: int = 3
) -> tuple[str, str | None, AnyWorkers]:
    """Return the specs of what drives, and which workers can have it.

    Says in a sentence where something drives in this process that could do it harm.
    """
    several = isinstance(workers, str) or workers_or_cores(workers) > 1
    specs = spec_of(vut), None if pov is None else spec_of(pov)
    for spec in specs:
        if spec is None or object_of(spec) is None:
            continue
        name = spec.partition(":")[2]
        if travels(spec):
            process = "the processes of the workers" if several else "this process"
            why = (
                f"{name} is an object, so it drives in {process}, which what it does wrong may end"
            )
        else:
            alone = ", and without workers," if several else ""
            workers = 1
            why = (
                f"{name} is known to this process alone, so it drives here{alone} where what it "
                "does wrong may end everything; put its class or function into a module for a "
                "process of its own"
            )
        warnings.warn(why, stacklevel=stacklevel)
    return *specs, workers


def here_vut(argument: str, options: VutOptions) -> Vut:
    """Return the VUT of `here:NAME`; `UserError` where that is an object of another process."""
    name, given = split_options(argument, f"{HERE}:{argument}")
    if name not in _objects:
        raise UserError(
            f"{HERE}:{argument} was an object of a Python process: name a VUT with --vut, or give "
            "the object again"
        )
    spec = f"{HERE}:{argument}"
    return vut_of_object(_objects[name], spec, options, numbers_of(given, spec))


def vut_of_object(
    thing: Any, name: str, options: VutOptions, given: Mapping[str, float] | None = None
) -> Vut:
    """Return the VUT that an object, a class or a function is; `UserError` for one that is none."""
    vut = vut_of(thing, name, options, given)
    if vut is None:
        raise UserError(
            f"{text_of(thing, repr)[:80]} is no VUT: give a spec as after --vut, a class or an "
            "object with `act(self, seen)` or `act_batch(self, seen)`, or a function `f(seen)`"
        )
    return replace(vut, files=_files(thing), named_only=True)


def _importable(target: Any) -> str | None:
    """Return MODULE:NAME of a class or a function; None where no other process finds it so."""
    module, name = getattr(target, "__module__", None), getattr(target, "__qualname__", "")
    if module in (None, *MAINS) or "<" in name:
        return None
    imported: Any = sys.modules.get(str(module))
    if any(getattr(imported, own, None) is None for own in ("__spec__", "__file__")):
        return None
    for part in name.split("."):
        imported = getattr(imported, part, None)
    return f"{module}:{name}" if imported is target else None


def _files(vut: Any) -> tuple[Path, ...]:
    try:
        file = inspect.getsourcefile(vut if is_code(vut) else type(vut))
    except (TypeError, OSError):
        return ()
    return (Path(file),) if file is not None and Path(file).is_file() else ()
