"""The name of a controller in its parts, how it is hosted, and its kind.

`kinds.parse` reads a name, and `kinds.load` gives the `ControllerKind` of it, which opens drivers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import import_module
from numbers import Real
from pathlib import Path
from typing import Any, ClassVar, Self

import msgspec

from merge_sumo.controllers.controller import Controller, ControllerArray
from merge_sumo.drivers.base import Driver
from merge_sumo.errors import UserError
from merge_sumo.files import Files, check_code, hashed
from merge_sumo.printable import printable
from merge_sumo.scenario.scenario import DEADLINE_S, MEMORY_GIB

BUILT_IN, INSTALLED, PYTHON, HERE = "built-in", "installed", "python", "here"
WITHOUT_PREFIX = (BUILT_IN, INSTALLED, PYTHON)
"""The kinds whose specs do not begin with the name of the kind."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ControllerOptions:
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
    """File to which the output of a controller is added; None is standard error."""
    policies: Path | None = None
    """Folder of the networks of the learned VUTs; None for the shipped ones."""

    def __post_init__(self) -> None:
        for option, unit, value in (
            ("deadline_s", "seconds", self.deadline_s),
            ("vut_memory_gib", "GiB", self.memory_gib),
        ):
            if not (isinstance(value, Real) and math.isfinite(value) and float(value) > 0.0):
                raise UserError(f"`{option}` is {value!r}: give {unit}, more than 0")


class ControllerSpec(msgspec.Struct, frozen=True):
    """The name of a controller in its parts, [KIND:]ARGUMENT[?NAME=VALUE&...].

    Attributes:
        kind: a name of `kinds.KINDS`.
        argument: a name, a file or a command, as the kind has it.
        parameters: names and values in the order in which they were written.
    """

    kind: str
    argument: str = ""
    parameters: tuple[tuple[str, str], ...] = ()

    def __str__(self) -> str:
        kind = "" if self.kind in WITHOUT_PREFIX else self.kind
        head = ":".join(filter(None, (kind, self.argument)))
        options = "&".join(f"{name}={value}" for name, value in self.parameters)
        return f"{head}?{options}" if options else head

    def numbers(self) -> dict[str, float]:
        """Return the parameters as numbers, whole ones as int; `UserError` for other text."""
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

    def with_value(self, name: str, value: float) -> ControllerSpec:
        """Return the spec with another value of a parameter."""
        parameters = {**dict(self.parameters), name: f"{value:.12g}"}
        return msgspec.structs.replace(self, parameters=tuple(parameters.items()))

    def has_no(self, name: str, known: Iterable[str]) -> UserError:
        """Return the error for a parameter that the controller does not have among `known`."""
        names = ", ".join(sorted(known))
        choice = f"choose from {names}" if names else "it has none"
        return UserError(f"{self}: it has no parameter {name!r}: {choice}")


class ControllerKind:
    """A kind of controller: a subclass. Its instance is a controller of that kind, loaded.

    A kind whose corridors have a controller each implements `controller`; another one, `driver`.

    Attributes:
        form: how a user writes it; "" for a kind that is not listed.
        what: its description, in a phrase.
        example: an option `--vut` that names one.
        has_parameters: whether "?" ends the argument in a spec.
        no_parameters: why a spec cannot set parameters, in a clause; "" where it can.
        hosted: whether it runs a user's code in this process, unless that has one of its own.
        own_code: whether to test it is to run code that is neither of this package nor of SUMO.
        files_are_known: whether `code` is all of which it is made before it drives.
        asks_sumo: whether its drivers ask SUMO, or are SUMO's own; their cases take longer.
        by_arrays: whether its drivers need nothing of SUMO, and take any number of corridors.
        spec: the controller.
        options: how it is hosted.
        code: files of code of the user's, as far as they are known.
        max_corridors: corridors that one driver can serve; None for any number.
        max_workers: processes that can have such a driver at a time; None for any number.
        vut_type: attributes of the SUMO vType with which SUMO itself drives; None if it does not.
        settable: numbers that its spec may set, with present values; None where a driver knows.
        no_pov: why it cannot drive a POV; "" where it can.
    """

    form: ClassVar[str] = ""
    what: ClassVar[str] = ""
    example: ClassVar[str] = ""
    has_parameters: ClassVar[bool] = True
    hosted: ClassVar[bool] = False
    own_code: ClassVar[bool] = True

    no_parameters: str = ""
    files_are_known: bool = True
    asks_sumo: bool = True
    by_arrays: bool = False
    code: tuple[Path, ...] = ()
    max_corridors: int | None = None
    max_workers: int | None = None
    vut_type: Mapping[str, str] | None = None
    settable: Mapping[str, float] | None = None
    no_pov: str = ""

    def __init__(self, spec: ControllerSpec, options: ControllerOptions) -> None:
        """Load a controller; subclasses raise `UserError` where it cannot be."""
        self.spec, self.options = spec, options

    @classmethod
    def waits(cls, _argument: str) -> bool:
        """Return whether the controller of an argument is a program that a user starts."""
        return False

    def controller(self) -> Controller:
        """Return a new controller of one corridor."""
        raise NotImplementedError

    def driver(self, corridors: int, _simulation: object) -> Driver:
        """Return a driver for a number of corridors in a simulation of SUMO, or in none (None)."""
        return ControllerArray(corridors, self.controller, self.options.deadline_s)

    def release(self) -> None:
        """End the process that loaded it, as its drivers are in other processes."""

    @cached_property
    def files(self) -> Files:
        """The files of `code` with their hashes when it was loaded first."""
        return hashed(self.code)

    def with_spec(self, spec: ControllerSpec) -> Self:
        """Return the same controller with other parameters."""
        return self._changed(spec, self.options)

    def with_log(self, log: Path) -> Self:
        """Return the same controller, with its output added to a file."""
        return self._changed(self.spec, replace(self.options, log=log))

    def _changed(self, spec: ControllerSpec, options: ControllerOptions) -> Self:
        changed: Self = _loaded(type(self), spec, options, self.files)
        return changed

    @property
    def _values(self) -> tuple[Any, ...]:
        """The arguments of `_loaded`."""
        return type(self), self.spec, self.options, self.files

    def __reduce__(self) -> tuple[Callable[..., ControllerKind], tuple[Any, ...]]:
        """Travel to another process as plain values; it is loaded there."""
        return _loaded, self._values

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ControllerKind) and self._values == other._values

    def __hash__(self) -> int:
        return hash(self.spec)

    def open(self, corridors: int, simulation: object = None) -> Driver:
        """Return a driver.

        Args:
            corridors: number of corridors.
            simulation: the simulation of SUMO in which it drives, if there is one.

        Raises:
            UserError: if the code of the controller has changed since it was loaded first.
        """
        for name, sha256 in hashed(self.code).items():
            if sha256 not in self.files.values():
                raise UserError(
                    f"{printable(name)}, code of the VUT {self.spec}, is not as it was when this "
                    "began: let it be while it runs, and let all workers have the same"
                )
        return self.driver(corridors, simulation)

    def parameters(self) -> dict[str, float]:
        """Return the parameters that a spec may set, with their present values.

        A Python controller is made to tell its attributes. Of SUMO's drivers only those are known
        that the spec sets. Raises `UserError` for a kind without parameters.
        """
        if self.no_parameters:
            raise UserError(f"{self.spec} has no parameters to change: {self.no_parameters}")
        if self.settable is not None:
            return dict(self.settable)
        with closing(self.open(1)) as driver:
            return dict(driver.parameters())


class FileKind(ControllerKind):
    """A model in a file, which a library runs in the process of the controller: KIND:FILE.

    Attributes:
        library: the module of the library, which the extra of the kind's name installs.
        names: the parameters that a spec may have.
        api: the library.
        path: the file.
        chosen: the parameters of the spec.
    """

    library: ClassVar[str]
    names: ClassVar[tuple[str, ...]]
    hosted, asks_sumo = True, False

    def __init__(self, spec: ControllerSpec, options: ControllerOptions) -> None:
        """Import the library and check the file; `UserError` where either cannot be used."""
        super().__init__(spec, options)
        self.path, self.chosen = Path(spec.argument), dict(spec.parameters)
        for name in self.chosen:
            if name not in self.names:
                raise spec.has_no(name, self.names)
        try:
            self.api: Any = import_module(self.library)
        except ImportError as error:
            extra = f"pip install 'merge-sumo[{spec.kind}]'"
            raise UserError(f"{spec} needs {self.library}: run `{extra}`") from error
        if not self.path.is_file():
            raise UserError(f"{spec}: there is no such file")
        check_code(self.path)
        self.code = (self.path,)


def _loaded(
    kind: type[Any],
    spec: ControllerSpec,
    options: ControllerOptions,
    files: Files,
    *more: object,
) -> Any:
    """Return a controller of a kind whose files had some hashes when it was loaded first."""
    controller = kind(spec, options, *more)
    controller.files = files
    return controller
