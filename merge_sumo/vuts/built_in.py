"""The VUTs that the package brings: `VUTS` of each file in `drivers/`, where it has some."""

from __future__ import annotations

from dataclasses import asdict, replace
from importlib import import_module
from pkgutil import iter_modules
from typing import Any, Final

from merge_sumo.drivers import __name__ as room
from merge_sumo.drivers import __path__ as folders
from merge_sumo.drivers.base import BuiltInVut, Driver
from merge_sumo.errors import UserError
from merge_sumo.vuts.base import Vut, VutKind, VutOptions, VutSpec


def found() -> dict[str, BuiltInVut]:
    """Return the VUTs of the files in `drivers/` by name, in the order of the names."""
    files = (import_module(f"{room}.{file.name}") for file in iter_modules(folders))
    return dict(sorted(item for file in files for item in getattr(file, "VUTS", {}).items()))


BUILT_IN_VUTS: Final = found()


def built_in_vut(spec: VutSpec, options: VutOptions) -> Vut:
    """Return the VUT of a name with its parameters; `UserError` for those that it cannot have."""
    built_in = BUILT_IN_VUTS[spec.argument]
    known = {} if built_in.design is None else asdict(built_in.design)
    chosen = {name: float(value) for name, value in spec.numbers().items()}
    for name in chosen:
        if name not in known:
            raise spec.has_no(name, known)
    arguments: tuple[Any, ...] = (options.policies,) if built_in.network else ()
    if built_in.design is not None:
        try:
            arguments = (replace(built_in.design, **chosen),)
        except UserError as error:
            raise UserError(f"{spec}: {error}") from error

    def make(corridors: int, _world: object) -> Driver:
        return built_in.make(corridors, *arguments)

    no_pov = "that is a VUT for the ramp; the POVs of levels 0 to 2 need no name"
    return Vut(make=make, parameters=known | chosen, no_pov=no_pov if built_in.ramp_only else "")


KIND: Final = VutKind(prepare=built_in_vut, own_code=False, asks_sumo=False, by_arrays=True)
