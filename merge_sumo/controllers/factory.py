"""The way from a spec to a driver, in any process."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from merge_sumo.controllers.base import INSTALLED, ControllerKind, VutOptions, VutSpec
from merge_sumo.controllers.built_in import BUILT_IN_VUTS
from merge_sumo.controllers.here import object_of, objects
from merge_sumo.controllers.hosting import SUPPORTED, HostedKind
from merge_sumo.controllers.parameters import Range
from merge_sumo.controllers.python import installed_vuts
from merge_sumo.controllers.registry import KINDS
from merge_sumo.controllers.spec import parse
from merge_sumo.drivers.base import Driver
from merge_sumo.errors import UserError
from merge_sumo.hashing import Files, hashed
from merge_sumo.printable import printable, quoted
from merge_sumo.suggestions import meant
from merge_sumo.trust import check_code
from merge_sumo.workers import workers_or_cores


@dataclass(frozen=True)
class VutFactory:
    """Makes the driver that `spec` names; plain values, which travel to other processes.

    `files` are those of the user's that the VUT is made of, with their hashes, as far as they are
    known before it drives; they are looked up unless they are given. Raises `UserError` for a spec
    that names no VUT, or one that cannot be loaded.
    """

    spec: VutSpec
    options: VutOptions = field(default_factory=VutOptions)
    files: Files | None = field(default=None, hash=False)

    def __post_init__(self) -> None:
        if self.files is None:
            object.__setattr__(self, "files", hashed(self.vut.files))

    @classmethod
    def of(cls, text: str, options: VutOptions | None = None) -> VutFactory:
        """Return what makes the VUT of a spec that is a text, as after `--vut`."""
        return cls(parse(text), options or VutOptions())

    @property
    def kind(self) -> type[ControllerKind]:
        """The kind of the VUT."""
        return KINDS[self.spec.kind]

    @cached_property
    def vut(self) -> ControllerKind:
        """The VUT, hosted in a process of its own where its kind says so."""
        spec, kind = self.spec, self.kind
        if spec.kind == INSTALLED and spec.argument not in installed_vuts():
            raise UserError(_why_unknown(spec.argument))
        if file := kind.file_of(spec.argument):
            check_code(Path(file))
        if kind.hosted and SUPPORTED and not self.options.in_process:
            return HostedKind(spec, self.options)
        return kind(spec, self.options)

    def with_spec(self, spec: VutSpec) -> VutFactory:
        """Return what makes the same VUT with other parameters."""
        return self._with(VutFactory(spec, self.options, self.files))

    def with_log(self, log: Path) -> VutFactory:
        """Return what makes the same VUT, with what it prints added to a file."""
        return self._with(VutFactory(self.spec, replace(self.options, log=log), self.files))

    def _with(self, other: VutFactory) -> VutFactory:
        """Let another factory know what was opened for this one."""
        other.__dict__["vut"] = self.vut.with_options(other.spec, other.options)
        return other

    def workers(self, requested: int | None) -> int:
        """Return in how many processes it is tested: the requested ones, or one a core for None.

        Raises `UserError` when more are requested than it can serve, or less than one.
        """
        count, most = workers_or_cores(requested), self.vut.max_workers
        if most is None or count <= most:
            if count > 1:
                self.vut.release()
            return count
        if requested is None:
            return most
        raise UserError(f"`workers` is {requested}: {self.spec} serves at most {most} at a time")

    def __call__(self, corridors: int, world: object = None) -> Driver:
        """Return a driver for corridors 0 to `corridors` - 1 of a world of SUMO, if there is one.

        Raises `UserError` where the code of the VUT has changed since this was made.
        """
        then, now = self.files or {}, hashed(self.vut.files)
        if other := [name for name, sha256 in now.items() if sha256 not in then.values()]:
            raise UserError(
                f"{printable(other[0])}, code of the VUT {self.spec}, is not as it was when this "
                "began: let it be while it runs, and let all workers have the same"
            )
        return self.vut.driver(corridors, world)

    def parameters(self) -> dict[str, float]:
        """Return the parameters that a spec may set, with their present values.

        A Python controller is made to tell its attributes. Of SUMO's drivers only those are known
        that the spec sets. Raises `UserError` for a kind without parameters.
        """
        if why := self.kind.no_parameters:
            raise UserError(f"{self.spec} has no parameters to change: {why}")
        if self.vut.parameters is not None:
            return dict(self.vut.parameters)
        with closing(self(1)) as driver:
            return dict(driver.parameters())

    def values_of(self, ranges: Sequence[Range]) -> dict[str, float]:
        """Return the present values of the parameters of some ranges, by name.

        Raises `UserError` where one is unknown, named twice, or out of its range.
        """
        known = self.parameters() if ranges else {}
        names = [each.name for each in ranges]
        for each in ranges:
            name = each.name
            if names.count(name) > 1:
                raise UserError(f"`params` {name} is given twice: give each parameter once")
            if name not in known and self.vut.vut_type is not None:
                named = quoted(str(self.spec.with_values({name: each.low})))
                raise UserError(
                    f"`params` {name}: its value today is not known; name it, as in `vut` {named}"
                )
            if name not in known:
                hint = meant(name, known)
                choice = f"{hint}choose from {', '.join(sorted(known))}" if known else "it has none"
                raise UserError(f"`params` {name}: {self.spec} has no such parameter: {choice}")
            if not each.low <= known[name] <= each.high:
                raise UserError(
                    f"`params` {name}={each.low:g}..{each.high:g}: it is {known[name]:g} today, "
                    "which is not in that range: give a range around it"
                )
        return {name: float(known[name]) for name in names}

    def __reduce__(self) -> tuple[Callable[..., VutFactory], tuple[Any, ...]]:
        """Travel as plain values, with what was opened and an object of this process."""
        hosted = self.vut if isinstance(self.vut, HostedKind) else None
        return (_arrived, (self.spec, self.options, self.files, hosted, object_of(self.spec)))


def _arrived(
    spec: VutSpec, options: VutOptions, files: Files | None, hosted: HostedKind | None, vut: Any
) -> VutFactory:
    if vut is not None:
        objects[spec.argument] = vut
    factory = VutFactory(spec, options, files)
    if hosted is not None:
        factory.__dict__["vut"] = hosted
    return factory


def _why_unknown(name: str) -> str:
    if name.endswith(".py"):
        return f"{name} is a file: name a class or a function of it, {name}:NAME"
    names = [*BUILT_IN_VUTS, *installed_vuts()]
    choice = f"{', '.join(names)}, or bring your own (`merge-sumo vuts` lists the kinds)"
    if not name:
        return f"name the vehicle under test, as in `vut` design2: {choice}"
    kinds = [kind for kind, brings in KINDS.items() if brings.form]
    return f"there is no VUT {name!r}: {meant(name, (*names, *kinds))}choose one of {choice}"
