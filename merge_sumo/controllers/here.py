"""VUTs that are objects of this process, `here:NAME`; they drive in the process of the cases."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any, Final

from merge_sumo.controllers.base import HERE, VutSpec
from merge_sumo.controllers.deadline import text_of
from merge_sumo.controllers.python import OfPython, is_code
from merge_sumo.errors import UserError

objects: Final[dict[str, Any]] = {}
"""By the arguments of their specs."""


def object_of(spec: VutSpec) -> Any:
    """Return the object that a spec names; None for a spec that is a text for everybody."""
    return objects.get(spec.argument) if spec.kind == HERE else None


class HereKind(OfPython):
    """An object of this process."""

    files_are_known = False

    def target(self) -> Any:
        """Return the object; `UserError` where that was an object of another process."""
        if self.spec.argument not in objects:
            raise UserError(
                f"{self.spec} was an object of a Python process: name a VUT, or give the object "
                "again"
            )
        target = objects[self.spec.argument]
        try:
            file = inspect.getsourcefile(target if is_code(target) else type(target))
        except (TypeError, OSError):
            file = None
        if file and Path(file).is_file():
            self.files = (Path(file),)
        return target

    def refused(self, target: Any) -> UserError:
        """Return the error for an object that is not a VUT."""
        return UserError(
            f"{text_of(target, repr)[:80]} is no VUT: give a spec, a class or an object with "
            "`act(self, seen)` or `act_batch(self, seen)`, or a function `f(seen)`"
        )
