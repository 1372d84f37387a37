"""The VUTs of this package: those in `VUTS` of each file in `drivers/` that has it."""

from __future__ import annotations

from dataclasses import asdict, replace
from importlib import import_module
from pkgutil import iter_modules

from merge_sumo.controllers.spec import ControllerKind
from merge_sumo.drivers import __name__ as room
from merge_sumo.drivers import __path__ as folders
from merge_sumo.drivers.base import BuiltInVut, Driver
from merge_sumo.errors import explained


def found() -> dict[str, BuiltInVut]:
    """Return the VUTs of the files in `drivers/` by name, in the order of the names."""
    vuts: dict[str, BuiltInVut] = {}
    for file in iter_modules(folders):
        vuts |= getattr(import_module(f"{room}.{file.name}"), "VUTS", {})
    return dict(sorted(vuts.items()))


BUILT_IN_VUTS = found()


class BuiltInKind(ControllerKind):
    """A VUT of this package, with its parameters."""

    own_code = asks_sumo = False

    def load(self) -> None:
        """Take the parameters.

        Raises:
            UserError: for a parameter or a value that it cannot have.
        """
        spec = self.spec
        self._built_in = built_in = BUILT_IN_VUTS[spec.argument]
        self._design = built_in.design
        self.settable = settable = {} if self._design is None else asdict(self._design)
        for name, value in spec.numbers().items():
            if name not in settable:
                raise spec.unknown_parameter(name, settable)
            settable[name] = float(value)
        if self._design is not None:
            with explained(str(spec)):
                self._design = replace(self._design, **settable)
        if built_in.ramp_only:
            self.no_pov = "this VUT drives on the ramp only; the POVs of levels 0 to 2 are built in"

    def driver(self, corridors: int, _simulation: object) -> Driver:
        """Return its driver.

        Args:
            corridors: number of corridors.
            _simulation: not used.
        """
        make = self._built_in.make
        if self._design is not None:
            return make(corridors, self._design)
        if self._built_in.network:
            return make(corridors, self.options.policies)
        return make(corridors)
