"""A VUT as an FMU: a co-simulation unit by FMI 2.0 or 3.0, such as Simulink exports."""

from __future__ import annotations

from contextlib import chdir, suppress
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from merge_sumo.controllers.controller import Controller, Seen, Start, as_merge
from merge_sumo.controllers.spec import ControllerKind, ControllerOptions, ControllerSpec
from merge_sumo.errors import UserError
from merge_sumo.files import check_code
from merge_sumo.printable import either
from merge_sumo.scenario.scenario import DT_S

INPUTS: Final = ("x_pov_m", "v_pov_mps", "x_vut_m", "v_vut_mps")
OUTPUT: Final = "acceleration_mps2"
REACHED: Final = "v_mps"
"""An output in the place of the acceleration: the speed that the vehicle has after the step."""
MERGE: Final = "merge"
SEED: Final = "seed"
"""What a unit need not have: an output, whether to merge, and an input or a parameter."""
NAMES: Final = (*INPUTS, OUTPUT, REACHED, MERGE, SEED)
_FLOATS: Final = ("Real", "Float64", "Float32")
_INTEGERS: Final = ("Integer", "Int32", "UInt32", "Int64", "UInt64")


class FmuKind(ControllerKind):
    """A unit: `fmu:FILE?x_vut_m=NAME&...`.

    An input that the unit does not have is not set, if at least one is there and none of the
    missing ones was named; an output must be there, the speed reached or else the acceleration. A
    spec that names the acceleration alone has it read. Whether to merge and the seed may be there.

    Attributes:
        version: first digit of the version of FMI.
        inputs: indices in the state and references, by type: a unit takes those of a type at once.
        output: variable of the acceleration, or of the speed reached.
        reaches: whether the output is the speed reached.
        wish: variable of whether to merge, if there is one.
        seed: variable of the seed, if there is one.
    """

    form = "fmu:FILE[?VARIABLE=NAME&...]"
    what = "an FMI 2.0 or 3.0 co-simulation unit, with its names of the variables"
    example = '--vut "fmu:controller.fmu?v_vut_mps=Speed&acceleration_mps2=Cmd"'
    no_parameters = "the options of an FMU are the names of its variables"
    hosted, asks_sumo = True, False

    def __init__(self, spec: ControllerSpec, options: ControllerOptions) -> None:
        """Read the description of the unit; `UserError` for one that cannot drive."""
        super().__init__(spec, options)
        self._names, path = dict(spec.parameters), Path(spec.argument)
        if unknown := set(self._names) - set(NAMES):
            raise UserError(
                f"{spec}: there is no variable {unknown.pop()!r} to name: choose from "
                f"{', '.join(NAMES)}"
            )
        check_code(path)
        self.code, self._instances = (path,), 0
        self._description: Any = _description(path)
        self.version = str(self._description.fmiVersion)[0]
        once = str(self._description.coSimulation.canBeInstantiatedOnlyOncePerProcess)
        self.max_corridors = 1 if once == "True" else None
        self._variables = {each.name: each for each in self._description.modelVariables}
        self.inputs: dict[str, tuple[list[int], list[int]]] = {}
        for index, key in enumerate(INPUTS):
            if key not in self._names and key not in self._variables:
                continue
            variable = self._checked(key)
            indices, references = self.inputs.setdefault(variable.type, ([], []))
            indices.append(index)
            references.append(variable.valueReference)
        if not self.inputs:
            raise UserError(
                f"{path} has none of the inputs {', '.join(INPUTS)}: name its own, as in "
                f"fmu:{path}?v_vut_mps=NAME"
            )
        reached = None
        if REACHED in self._names or OUTPUT not in self._names:
            reached = self._optional(REACHED, ("output",), _FLOATS)
        self.reaches = reached is not None
        self.output = reached or self._checked(OUTPUT)
        self.wish = self._optional(MERGE, ("output",), (*_FLOATS, "Boolean"))
        self.seed = self._optional(SEED, ("input", "parameter"), (*_FLOATS, *_INTEGERS))

    def controller(self) -> Controller:
        """Return a controller of one corridor."""
        return FmuController(self)

    def instance(self) -> Any:
        """Return a new instance of the unit."""
        self._instances += 1
        if self.version == "2":
            from fmpy.fmi2 import FMU2Slave as Slave
        else:
            from fmpy.fmi3 import FMU3Slave as Slave
        # FMPy goes to the folder of the binary and, when that cannot be loaded, stays there.
        with chdir("."):
            made: Any = Slave(
                guid=self._description.guid,
                unzipDirectory=self._folder.name,
                modelIdentifier=self._description.coSimulation.modelIdentifier,
                instanceName=f"vut{self._instances}",
            )
        made.instantiate()
        return made

    @cached_property
    def _folder(self) -> TemporaryDirectory[str]:
        """The unpacked unit, which is removed with this object."""
        import fmpy

        folder = TemporaryDirectory(prefix="merge-sumo-fmu-", ignore_cleanup_errors=True)
        fmpy.extract(str(self.code[0]), folder.name)
        return folder

    def _optional(self, key: str, causalities: tuple[str, ...], types: tuple[str, ...]) -> Any:
        """Return a variable that is named, or there by its own name; None for neither."""
        own = getattr(self._variables.get(key), "causality", None)
        return self._checked(key, types) if key in self._names or own in causalities else None

    def _checked(self, key: str, types: tuple[str, ...] = _FLOATS) -> Any:
        """Return a variable that is of one of some types; `UserError` when it is not."""
        name, path = self._names.get(key, key), self.code[0]
        variable = self._variables.get(name)
        if variable is None:
            names = ", ".join(sorted(self._variables)[:12])
            raise UserError(f"{path} has no variable {name!r}; it has {names}")
        if variable.type not in types:
            raise UserError(
                f"the variable {name!r} of {path} is a {variable.type}: it must be a "
                f"{either(types)}"
            )
        if variable.dimensions:
            raise UserError(f"the variable {name!r} of {path} is an array: name a number")
        return variable


def _description(path: Path) -> Any:
    """Return the description of a unit for co-simulation."""
    try:
        import fmpy
    except ImportError as error:
        raise UserError("an FMU needs FMPy: run `pip install 'merge-sumo[fmu]'`") from error
    if not path.is_file():
        raise UserError(f"there is no FMU {path}")
    try:
        description = fmpy.read_model_description(str(path))
    except Exception as error:  # of many classes: XML, zip, FMPy's own
        raise UserError(f"{path} is no readable FMU: {str(error)[:200]}") from error
    if description.coSimulation is None:
        raise UserError(f"{path} has no co-simulation: export it as an FMU for co-simulation")
    if str(description.fmiVersion)[0] not in "23":
        raise UserError(f"{path} is of FMI {description.fmiVersion}: export it as FMI 2.0 or 3.0")
    return description


class FmuController(Controller):
    """Steps an instance of the unit: set the state, step by 0.1 s, read."""

    def __init__(self, unit: FmuKind) -> None:
        """Make an instance; `UserError` when that cannot be."""
        self._unit, self._ran = unit, False
        try:
            self._instance = unit.instance()
        except Exception as error:  # of FMPy or of the loader of the binary
            raise UserError(f"the FMU cannot be made: {error}") from error

    def reset(self, start: Start) -> None:
        """Initialise the instance at t = 0 with the state at the start."""
        instance = self._instance
        if self._ran:
            instance.reset()
        self._ran = True
        if self._unit.version == "2":
            instance.setupExperiment(startTime=0.0)
            instance.enterInitializationMode()
        else:
            instance.enterInitializationMode(startTime=0.0)
        self._set(start.seen)
        if (taken := self._unit.seed) is not None:
            # A signed integer of 32 bits has no room for all seeds.
            seed = float(start.seed) if taken.type in _FLOATS else start.seed % 2**31
            getattr(instance, f"set{taken.type}")([taken.valueReference], [seed])
        instance.exitInitializationMode()

    def act(self, seen: Seen) -> float | tuple[float, bool]:
        """Return the outputs after a step with the state held."""
        unit = self._unit
        self._set(seen)
        self._instance.doStep(seen.t_s, DT_S)
        acceleration = self._value(unit.output)
        if unit.reaches:
            acceleration = (acceleration - seen.v_vut_mps) / DT_S
        if unit.wish is None:
            return acceleration
        return acceleration, as_merge(self._value(unit.wish))

    def close(self) -> None:
        """Free the instance."""
        with suppress(Exception):  # a unit that failed cannot be terminated
            self._instance.terminate()
        self._instance.freeInstance()

    def _set(self, seen: Seen) -> None:
        for kind, (indices, references) in self._unit.inputs.items():
            set_all = getattr(self._instance, f"set{kind}")
            set_all(references, [seen[1 + index] for index in indices])

    def _value(self, variable: Any) -> float:
        """Return the value of a variable, which FMPy reads by its type."""
        return float(getattr(self._instance, f"get{variable.type}")([variable.valueReference])[0])
