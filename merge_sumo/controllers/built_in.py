"""The VUTs that the package brings: `VUTS` of each file in `drivers/`, where it has some."""

from __future__ import annotations

from dataclasses import asdict, replace
from importlib import import_module
from pkgutil import iter_modules

from merge_sumo.controllers.spec import ControllerKind, ControllerOptions, ControllerSpec
from merge_sumo.drivers import __name__ as room
from merge_sumo.drivers import __path__ as folders
from merge_sumo.drivers.base import BuiltInVut, Driver
from merge_sumo.errors import UserError


def found() -> dict[str, BuiltInVut]:
    """Return the VUTs of the files in `drivers/` by name, in the order of the names."""
    vuts: dict[str, BuiltInVut] = {}
    for file in iter_modules(folders):
        vuts |= getattr(import_module(f"{room}.{file.name}"), "VUTS", {})
    return dict(sorted(vuts.items()))


BUILT_IN_VUTS = found()


class BuiltInKind(ControllerKind):
    """A VUT that the package brings, with its parameters."""

    own_code = asks_sumo = False

    def __init__(self, spec: ControllerSpec, options: ControllerOptions) -> None:
        """Take the parameters; `UserError` for those that it cannot have."""
        super().__init__(spec, options)
        self._built_in = built_in = BUILT_IN_VUTS[spec.argument]
        self._design = design = built_in.design
        known = {} if design is None else asdict(design)
        chosen = {name: float(value) for name, value in spec.numbers().items()}
        for name in chosen:
            if name not in known:
                raise spec.unknown_parameter(name, known)
        if design is not None:
            try:
                self._design = replace(design, **chosen)
            except UserError as error:
                raise UserError(f"{spec}: {error}") from error
        self.settable = known | chosen
        if built_in.ramp_only:
            self.no_pov = "that is a VUT for the ramp; the POVs of levels 0 to 2 need no name"

    def driver(self, corridors: int, _simulation: object) -> Driver:
        """Return its driver for a number of corridors."""
        make = self._built_in.make
        if self._design is not None:
            return make(corridors, self._design)
        if self._built_in.network:
            return make(corridors, self.options.policies)
        return make(corridors)
