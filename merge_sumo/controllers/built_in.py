"""The VUTs that the package brings: `VUTS` of each file in `drivers/`, where it has some."""

from __future__ import annotations

from dataclasses import asdict, replace
from importlib import import_module
from pkgutil import iter_modules
from typing import Any, Final

from merge_sumo.controllers.base import ControllerKind, VutOptions, VutSpec
from merge_sumo.drivers import __name__ as room
from merge_sumo.drivers import __path__ as folders
from merge_sumo.drivers.base import BuiltInVut, Driver
from merge_sumo.errors import UserError


def found() -> dict[str, BuiltInVut]:
    """Return the VUTs of the files in `drivers/` by name, in the order of the names."""
    files = (import_module(f"{room}.{file.name}") for file in iter_modules(folders))
    return dict(sorted(item for file in files for item in getattr(file, "VUTS", {}).items()))


BUILT_IN_VUTS: Final = found()


class BuiltInKind(ControllerKind):
    """A VUT that the package brings, with its parameters."""

    own_code, asks_sumo, by_arrays = False, False, True

    def __init__(self, spec: VutSpec, options: VutOptions) -> None:
        """Take the parameters; `UserError` for those that it cannot have."""
        super().__init__(spec, options)
        self._built_in = built_in = BUILT_IN_VUTS[spec.argument]
        known = {} if built_in.design is None else asdict(built_in.design)
        chosen = {name: float(value) for name, value in spec.numbers().items()}
        for name in chosen:
            if name not in known:
                raise spec.has_no(name, known)
        self._arguments: tuple[Any, ...] = (options.policies,) if built_in.network else ()
        if built_in.design is not None:
            try:
                self._arguments = (replace(built_in.design, **chosen),)
            except UserError as error:
                raise UserError(f"{spec}: {error}") from error
        self.parameters = known | chosen
        if built_in.ramp_only:
            self.no_pov = "that is a VUT for the ramp; the POVs of levels 0 to 2 need no name"

    def driver(self, corridors: int, _world: object) -> Driver:
        """Return its driver for a number of corridors."""
        return self._built_in.make(corridors, *self._arguments)
