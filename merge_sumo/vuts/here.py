"""VUTs that are objects of this process, `here:NAME`; they drive in the process of the cases."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from merge_sumo.errors import UserError
from merge_sumo.vuts.base import HERE, Vut, VutKind, VutOptions, VutSpec, text_of
from merge_sumo.vuts.python import is_code, vut_of

objects: Final[dict[str, Any]] = {}
"""By the arguments of their specs."""


def object_of(spec: VutSpec) -> Any:
    """Return the object that a spec names; None for a spec that is a text for everybody."""
    return objects.get(spec.argument) if spec.kind == HERE else None


def here_vut(spec: VutSpec, options: VutOptions) -> Vut:
    """Return the VUT of an object; `UserError` where that is an object of another process."""
    if spec.argument not in objects:
        raise UserError(
            f"{spec} was an object of a Python process: name a VUT, or give the object again"
        )
    return vut_of_object(objects[spec.argument], spec, options, spec.numbers())


def vut_of_object(
    thing: Any, spec: VutSpec, options: VutOptions, given: Mapping[str, float]
) -> Vut:
    """Return the VUT that an object, a class or a function is; `UserError` for one that is none."""
    vut = vut_of(thing, spec, options, given)
    if vut is None:
        raise UserError(
            f"{text_of(thing, repr)[:80]} is no VUT: give a spec, a class or an "
            "object with `act(self, seen)` or `act_batch(self, seen)`, or a function `f(seen)`"
        )
    try:
        file = inspect.getsourcefile(thing if is_code(thing) else type(thing))
    except (TypeError, OSError):
        file = None
    return replace(vut, files=(Path(file),) if file and Path(file).is_file() else ())


KIND: Final = VutKind(prepare=here_vut, files_are_known=False, asks_sumo=False)
