"""The text of a controller in its parts, how it is hosted, and its kind.

`kinds.parse` reads a text, and `kinds.load` gives the `ControllerKind` of it, which opens drivers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

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
            if not (isinstance(value, int | float) and 0.0 < value < math.inf):
                raise UserError(f"`{option}` is {value!r}: it must be a number of {unit} above 0")


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
        """Return the parameters as numbers, whole ones as int.

        Raises:
            UserError: for a value that is not a finite number.
        """
        numbers: dict[str, float] = {}
        for name, text in self.parameters:
            try:
                value = float(text)
            except ValueError:
                value = math.nan
            if not math.isfinite(value):
                raise UserError(f"{self}: {name} is {text!r}: it must be a number")
            numbers[name] = int(text) if text.lstrip("+-").isdecimal() else value
        return numbers

    def with_value(self, name: str, value: float) -> ControllerSpec:
        """Return the spec with another value of a parameter.

        Args:
            name: the parameter.
            value: its value, which is written with 12 digits.
        """
        parameters = {**dict(self.parameters), name: f"{value:.12g}"}
        return msgspec.structs.replace(self, parameters=tuple(parameters.items()))

    def unknown_parameter(self, name: str, known: Iterable[str]) -> UserError:
        """Return the error for a parameter that the controller does not have.

        Args:
            name: the parameter.
            known: the parameters that it has.
        """
        names = ", ".join(sorted(known))
        choice = f"choose from {names}" if names else "it has none"
        return UserError(f"{self}: it has no parameter {name!r}: {choice}")


class ControllerKind:
    """An instance is a loaded controller; a class is a kind of controller.

    The settings of a campaign hold the text of a controller, its plan holds an instance of this
    class, and each process that runs cases opens a `Driver` of it. A kind whose corridors have a
    controller each implements `controller`; another kind implements `driver`. A text named `kind`
    is the name of a kind.

    Example:
        ```python
        vut = kinds.load("my_vut.py:MyVut?gain=2")
        with closing(vut.open(corridors=8)) as driver:
            driver.begin(0, case)
        ```

    Attributes:
        form: how a user writes it; "" for a kind that is not listed.
        what: its description, in a phrase.
        example: an option `--vut` that names one.
        has_parameters: whether "?" ends the argument in a spec.
        no_parameters: why a spec cannot set parameters, in a clause; "" where it can.
        hosted: whether it runs a user's code, so that `kinds.load` gives it a process of its own.
            Such a kind implements `controller`, or a `driver` that is a `ControllerDriver`, and
            cannot ask SUMO. Other processes know only its `no_parameters`, `max_workers`,
            `max_corridors` and `code` (`HostedKind`).
        own_code: whether code of the user runs in a test.
        files_are_known: whether `code` names all files of the controller before it drives.
        asks_sumo: whether its drivers ask SUMO, or are SUMO's own; their cases take longer.
        spec: the controller.
        options: how it is hosted.
        code: files of the user's code, as far as they are known.
        files: the same with their hashes when the controller was loaded first.
        max_corridors: corridors that one driver can serve; None for any number.
        max_workers: processes that can have such a driver at a time; None for any number.
        vut_type: attributes of the SUMO vType with which SUMO itself drives; None if it does not.
        settable: numbers that its spec may set, with present values; None if a driver has to tell.
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
    code: tuple[Path, ...] = ()
    files: Files
    max_corridors: int | None = None
    max_workers: int | None = None
    vut_type: Mapping[str, str] | None = None
    settable: Mapping[str, float] | None = None
    no_pov: str = ""
    _more: tuple[Any, ...] = ()
    """Further arguments of the constructor."""

    def __init__(self, spec: ControllerSpec, options: ControllerOptions) -> None:
        """Load a controller.

        Args:
            spec: the controller.
            options: how it is hosted.

        Raises:
            UserError: if it cannot be loaded.
        """
        self.spec, self.options = spec, options
        self.load()

    def load(self) -> None:
        """Read the spec and load what it names, in the constructor; subclasses implement it.

        Raises:
            UserError: if it cannot be loaded.
        """

    @classmethod
    def waits(cls, _argument: str) -> bool:
        """Return whether the user starts the program of a controller.

        Args:
            _argument: argument of its spec.
        """
        return False

    def controller(self) -> Controller:
        """Return a new controller of one corridor."""
        raise NotImplementedError

    def driver(self, corridors: int, _simulation: object) -> Driver:
        """Return a driver; its users call `open`.

        Args:
            corridors: number of corridors.
            _simulation: the simulation of SUMO in which it drives; None without SUMO.
        """
        return ControllerArray(corridors, self.controller, self.options.deadline_s)

    def release(self) -> None:
        """End the process that loaded it, as its drivers are in other processes."""

    def with_spec(self, spec: ControllerSpec) -> Self:
        """Return the same controller with other parameters.

        Args:
            spec: the same kind and argument with these parameters.
        """
        return load_as(type(self), spec, self.options, self.files, *self._more)

    def with_log(self, log: Path) -> Self:
        """Return the same controller with another log; a process that loaded it goes there too.

        Args:
            log: file to which its output is added.
        """
        options = replace(self.options, log=log)
        return load_as(type(self), self.spec, options, self.files, *self._more)

    def __reduce__(self) -> tuple[Callable[..., ControllerKind], tuple[Any, ...]]:
        """Travel to another process as plain values; it is loaded there."""
        return load_as, (type(self), self.spec, self.options, self.files, *self._more)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ControllerKind) and self.__reduce__() == other.__reduce__()

    def __hash__(self) -> int:
        return hash(self.spec)

    def open(self, corridors: int, simulation: object = None) -> Driver:
        """Return a driver.

        Args:
            corridors: number of corridors.
            simulation: the simulation of SUMO in which it drives; None without SUMO.

        Raises:
            UserError: if the code of the controller has changed since it was loaded first.
        """
        for name, sha256 in hashed(self.code).items():
            if sha256 not in self.files.values():
                raise UserError(
                    f"{printable(name)}, code of the VUT {self.spec}, has changed since it was "
                    "loaded: do not change it during a run, and give all workers the same file"
                )
        return self.driver(corridors, simulation)

    def parameters(self) -> dict[str, float]:
        """Return the numbers that its spec may set, by name, with their present values.

        A Python controller is made to find its attributes. Of SUMO's drivers only those are known
        that the spec sets.

        Raises:
            UserError: for a kind without parameters.
        """
        if self.no_parameters:
            raise UserError(f"{self.spec} has no parameters to change: {self.no_parameters}")
        if self.settable is not None:
            return dict(self.settable)
        with closing(self.open(1)) as driver:
            return dict(driver.parameters())


K = TypeVar("K", bound=ControllerKind)


def load_as(
    kind: type[K],
    spec: ControllerSpec,
    options: ControllerOptions,
    files: Files | None = None,
    *more: object,
) -> K:
    """Return a controller of a kind.

    Args:
        kind: the kind.
        spec: the controller.
        options: how it is hosted.
        files: its code with the hashes when it was loaded first; None if this is the first time.
        *more: further arguments of the kind's constructor.

    Raises:
        UserError: if it cannot be loaded.
    """
    controller = kind(spec, options, *more)
    controller.files = hashed(controller.code) if files is None else files
    return controller


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

    def load(self) -> None:
        """Import the library and check the file.

        Raises:
            UserError: if the library or the file cannot be used.
        """
        spec = self.spec
        self.path, self.chosen = Path(spec.argument), dict(spec.parameters)
        for name in self.chosen:
            if name not in self.names:
                raise spec.unknown_parameter(name, self.names)
        try:
            self.api: Any = import_module(self.library)
        except ImportError as error:
            extra = f"pip install 'merge-sumo[{spec.kind}]'"
            raise UserError(f"{spec} needs {self.library}: run `{extra}`") from error
        if not self.path.is_file():
            raise UserError(f"{spec}: the file does not exist")
        check_code(self.path)
        self.code = (self.path,)
