"""The VUT: from what a person writes after `--vut` to a driver."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Final

from merge_sumo.drivers.base import Driver
from merge_sumo.drivers.level0 import Level0Vut
from merge_sumo.drivers.policies import load_driver, read_manifest
from merge_sumo.drivers.rule_based import DESIGNS, RuleBasedVut
from merge_sumo.drivers.vuts.base import Vut, VutOptions
from merge_sumo.drivers.vuts.fmu import fmu_vut
from merge_sumo.drivers.vuts.onnx import onnx_vut
from merge_sumo.drivers.vuts.python import installed_vuts, python_vut, vut_of
from merge_sumo.drivers.vuts.sumo_model import sumo_vut
from merge_sumo.drivers.vuts.traci import traci_vut
from merge_sumo.errors import UserError
from merge_sumo.sumo.world import World
from merge_sumo.workers import workers_or_cores


@dataclass(frozen=True, kw_only=True, slots=True)
class Kind:
    """A kind of VUT: what a person writes for it, what it is, and what prepares it."""

    form: str
    what: str
    example: str
    prepare: Callable[[str, VutOptions], Vut]


PYTHON: Final = Kind(
    form="MODULE:NAME or FILE.py:NAME",
    what="a class with act(seen), a function of seen, or a batched class, in this process",
    example="--vut my_vut.py:MyVut",
    prepare=python_vut,
)
KINDS: Final[dict[str, Kind]] = {
    "traci": Kind(
        form="traci[:PORT]",
        what="a program in any language that drives `vut` by TraCI, started by --vut-command",
        example='--vut traci --vut-command "python my_controller.py {port}"',
        prepare=traci_vut,
    ),
    "sumo": Kind(
        form="sumo:MODEL[?OPTION=VALUE&...]",
        what="SUMO's own driver: Krauss, IDM, EIDM, ACC or CACC with SUMO's junction logic",
        example='--vut "sumo:IDM?tau=1.2"',
        prepare=sumo_vut,
    ),
    "onnx": Kind(
        form="onnx:FILE[?decision_period_s=SECONDS]",
        what="a network from the state to an acceleration, or to values of the 7 actions",
        example="--vut onnx:policy.onnx",
        prepare=onnx_vut,
    ),
    "fmu": Kind(
        form="fmu:FILE[?VARIABLE=NAME&...]",
        what="an FMI 2.0 or 3.0 co-simulation unit, with its names of the variables",
        example='--vut "fmu:controller.fmu?v_vut_mps=Speed&acceleration_mps2=Cmd"',
        prepare=fmu_vut,
    ),
}
"""The kinds that have a name of their own before the colon."""


def built_in_vuts() -> dict[str, Callable[[int], Driver]]:
    """Return the VUTs that the package brings, by name."""
    designs = {name: partial(RuleBasedVut, design=design) for name, design in DESIGNS.items()}
    learned = {
        f"level{name[-1]}": partial(load_driver, name)
        for name in read_manifest()
        if name.startswith("vut")
    }
    return {"level0": Level0Vut, **learned, **designs}


@dataclass(frozen=True)
class VutFactory:
    """Makes the driver that `spec` names; made of plain values, so that a process can be told it.

    Raises `UserError` for a spec that names no VUT, or one that cannot be loaded.
    """

    spec: str
    options: VutOptions

    def __post_init__(self) -> None:
        """Find the VUT."""
        _ = self.vut

    @cached_property
    def vut(self) -> Vut:
        """What the spec names."""
        return _find(self.spec, self.options)

    @property
    def sha256(self) -> str | None:
        """Hash of the file that the VUT was loaded from; None where there is none."""
        file = self.vut.file
        return None if file is None else hashlib.sha256(file.read_bytes()).hexdigest()

    def workers(self, asked: int | None) -> int:
        """Return in how many processes it is tested: as many as asked, or one a core.

        Raises `UserError` when more are asked for than it can serve, or less than one.
        """
        count, most = workers_or_cores(asked), self.vut.max_workers
        if most is None or count <= most:
            return count
        if asked is None:
            return most
        raise UserError(f"--workers is {asked}: {self.spec} serves at most {most} at a time")

    def __call__(self, corridors: int, world: World | None = None) -> Driver:
        """Return a driver for corridors 0 to `corridors` - 1 of a world."""
        return self.vut.make(corridors, world)

    def __reduce__(self) -> tuple[type[VutFactory], tuple[str, VutOptions]]:
        """Travel as the spec and the options; the VUT is found again on arrival."""
        return (VutFactory, (self.spec, self.options))


def vut_factory(spec: str, options: VutOptions | None = None) -> VutFactory:
    """Return what makes the VUT that `spec` names; `UserError` for a name nobody knows."""
    return VutFactory(spec, options or VutOptions())


def _find(spec: str, options: VutOptions) -> Vut:
    prefix, colon, argument = spec.partition(":")
    if prefix in KINDS:
        return KINDS[prefix].prepare(argument, options)
    if options.command is not None:
        raise UserError(f"--vut-command goes with --vut traci, not with {spec}")
    built_in = built_in_vuts()
    if spec in built_in:
        make = built_in[spec]
        return Vut(make=lambda corridors, _world: make(corridors))
    if colon:
        return PYTHON.prepare(spec, options)
    installed = installed_vuts()
    if spec in installed:
        try:
            target = installed[spec].load()
        except (Exception, SystemExit) as error:
            raise UserError(
                f"cannot load the VUT {spec}: {type(error).__name__}: {error}"
            ) from error
        return vut_of(target, spec, options)
    names = ", ".join([*built_in, *installed])
    raise UserError(
        f"there is no VUT {spec!r}: choose one of {names}, or bring your own "
        "(`merge-sumo vuts` lists the kinds)"
    )
