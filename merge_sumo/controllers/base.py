"""What every kind of controller has: its name in a spec, how it is hosted, and what it is."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import ClassVar, Final

import msgspec

from merge_sumo.controllers.controller import Controller, ControllerArray
from merge_sumo.drivers.base import Driver
from merge_sumo.errors import UserError
from merge_sumo.scenario.scenario import DEADLINE_S, MEMORY_GIB


@dataclass(frozen=True, kw_only=True, slots=True)
class VutOptions:
    """How a controller is hosted; `UserError` for values out of their range."""

    deadline_s: float = DEADLINE_S
    """Time for one step, and for one reset."""
    connect_s: float = 60.0
    """Time for a program to start and connect."""
    in_process: bool = False
    """Whether a user's code runs in this process instead of one of its own: a debugger reaches
    it then, and its faults may end this process."""
    memory_gib: float = MEMORY_GIB
    """Memory that the process of a user's code may take."""
    log: Path | None = None
    """File to which what a controller prints is added; None is standard error."""
    policies: Path | None = None
    """Folder of the networks of the learned VUTs; None for the shipped ones."""

    def __post_init__(self) -> None:
        for option, unit, value in (
            ("deadline_s", "seconds", self.deadline_s),
            ("vut_memory_gib", "GiB", self.memory_gib),
        ):
            if not (isinstance(value, Real) and math.isfinite(value) and float(value) > 0.0):
                raise UserError(f"`{option}` is {value!r}: give {unit}, more than 0")


BUILT_IN, INSTALLED, PYTHON, HERE = "built-in", "installed", "python", "here"
WITHOUT_PREFIX: Final = (BUILT_IN, INSTALLED, PYTHON)
"""The kinds whose specs do not begin with the name of the kind."""


class VutSpec(msgspec.Struct, frozen=True):
    """The name of a VUT, as after `--vut`, in its parts; `spec.parse` reads one.

    Attributes:
        kind: a name of `registry.KINDS`.
        argument: a name, a file or a command, as the kind has it.
        parameters: names and values in the order in which they were written.
    """

    kind: str
    argument: str = ""
    parameters: tuple[tuple[str, str], ...] = ()

    def __str__(self) -> str:
        head = self.argument if self.kind in WITHOUT_PREFIX else self.kind
        if head is self.kind and self.argument:
            head = f"{self.kind}:{self.argument}"
        options = "&".join(f"{name}={value}" for name, value in self.parameters)
        return f"{head}?{options}" if options else head

    def numbers(self) -> dict[str, float]:
        """Return the parameters as numbers, whole ones as int; `UserError` for what is none."""
        numbers: dict[str, float] = {}
        for name, text in self.parameters:
            try:
                value = float(text)
                numbers[name] = int(text) if text.lstrip("+-").isdecimal() else value
            except ValueError:
                value = math.nan
            if not math.isfinite(value):
                raise UserError(f"{self}: {name} is {text!r}: give a number")
        return numbers

    def with_values(
        self, values: Mapping[str, float], today: Mapping[str, float] | None = None
    ) -> VutSpec:
        """Return the spec with other values of parameters, those that are `today`'s left out."""
        known = today or {}
        changed = {name: f"{v:.12g}" for name, v in values.items() if known.get(name) != v}
        return msgspec.structs.replace(
            self, parameters=tuple({**dict(self.parameters), **changed}.items())
        )

    def has_no(self, name: str, known: Iterable[str]) -> UserError:
        """Return the error for a parameter that the VUT does not have among those `known`."""
        names = ", ".join(sorted(known))
        choice = f"choose from {names}" if names else "it has none"
        return UserError(f"{self}: it has no parameter {name!r}: {choice}")


class ControllerKind:
    """A kind of controller: a subclass. Its instance is a controller of that kind, loaded.

    A kind whose corridors have a controller each implements `controller`; another one, `driver`.

    Attributes:
        form: how a user writes it; "" for a kind that is not listed.
        what: what it is, in a phrase.
        example: an option `--vut` that names one.
        has_parameters: whether "?" ends the argument in a spec.
        no_parameters: why a spec cannot set parameters, in a clause; "" where it can.
        hosted: whether it runs a user's code in this process, unless that has one of its own.
        own_code: whether to test it is to run code that is neither of this package nor of SUMO.
        files_are_known: whether `files` are all of which it is made before it drives.
        asks_sumo: whether its drivers ask SUMO, or are SUMO's own; their cases take longer.
        by_arrays: whether its drivers need nothing of SUMO, and take any number of corridors.
        spec: the controller.
        options: how it is hosted.
        files: files of code of the user's, as far as they are known.
        max_corridors: corridors that one driver can serve; None for any number.
        max_workers: processes that can have such a driver at a time; None for any number.
        vut_type: attributes of the SUMO vType with which SUMO itself drives; None if it does not.
        parameters: numbers that its spec may set, with present values; None where a driver knows.
        no_pov: why it cannot drive a POV; "" where it can.
    """

    form: ClassVar[str] = ""
    what: ClassVar[str] = ""
    example: ClassVar[str] = ""
    has_parameters: ClassVar[bool] = True
    no_parameters: ClassVar[str] = ""
    hosted: ClassVar[bool] = False
    own_code: ClassVar[bool] = True
    files_are_known: ClassVar[bool] = True
    asks_sumo: ClassVar[bool] = True
    by_arrays: ClassVar[bool] = False

    files: tuple[Path, ...] = ()
    max_corridors: int | None = None
    max_workers: int | None = None
    vut_type: Mapping[str, str] | None = None
    parameters: Mapping[str, float] | None = None
    no_pov: str = ""

    def __init__(self, spec: VutSpec, options: VutOptions) -> None:
        """Load a controller; subclasses raise `UserError` where it cannot be."""
        self.spec, self.options = spec, options

    @classmethod
    def file_of(cls, _argument: str) -> str:
        """Return the file of code that an argument names; "" for none."""
        return ""

    @classmethod
    def waits(cls, _argument: str) -> bool:
        """Return whether the controller of an argument is a program that a user starts."""
        return False

    def controller(self) -> Controller:
        """Return a new controller of one corridor."""
        raise NotImplementedError

    def driver(self, corridors: int, _world: object) -> Driver:
        """Return a driver for a number of corridors in a world of SUMO; None for no world."""
        return ControllerArray(corridors, self.controller, self.options.deadline_s)

    def with_options(self, spec: VutSpec, options: VutOptions) -> ControllerKind:
        """Return the controller with other parameters, or hosted otherwise."""
        return type(self)(spec, options)

    def release(self) -> None:
        """End what was started to load it, as its drivers are in other processes."""
