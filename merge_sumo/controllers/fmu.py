"""A VUT as an FMU: a co-simulation unit by FMI 2.0 or 3.0, such as Simulink exports."""

from __future__ import annotations

from contextlib import chdir, suppress
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from merge_sumo.controllers.base import ControllerKind, VutOptions, VutSpec
from merge_sumo.controllers.controller import Controller, Seen, Start, as_merge
from merge_sumo.errors import UserError
from merge_sumo.scenario.scenario import DT_S
from merge_sumo.suggestions import either

INPUTS: Final = ("x_pov_m", "v_pov_mps", "x_vut_m", "v_vut_mps")
OUTPUT: Final = "acceleration_mps2"
REACHED: Final = "v_mps"
"""An output in the place of the acceleration: the speed that the vehicle has after the step."""
MERGE: Final = "merge"
SEED: Final = "seed"
"""What a unit need not have: an output, whether to merge, and an input or a parameter."""
NAMES: Final = (*INPUTS, OUTPUT, REACHED, MERGE, SEED)
_FLOATS: Final = ("Real", "Float64", "Float32")
_BOOLEAN: Final = "Boolean"
_INTEGERS: Final = ("Integer", "Int32", "UInt32", "Int64", "UInt64")


class Unit:
    """The checked description of an FMU; `UserError` when the file is no such unit.

    An input that the unit does not have is not set, if at least one is there and none of the
    missing ones was named; an output must be there, the speed reached or else the acceleration. A
    spec that names the acceleration alone has it read. Whether to merge and the seed may be there.
    """

    def __init__(self, path: Path, names: dict[str, str]) -> None:
        try:
            import fmpy
        except ImportError as error:
            raise UserError("an FMU needs FMPy: run `pip install 'merge-sumo[fmu]'`") from error
        self._fmpy, self._path, self._instances = fmpy, path, 0
        if not path.is_file():
            raise UserError(f"there is no FMU {path}")
        try:
            self.description: Any = fmpy.read_model_description(str(path))
        except Exception as error:  # of many classes: XML, zip, FMPy's own
            raise UserError(f"{path} is no readable FMU: {str(error)[:200]}") from error
        if self.description.coSimulation is None:
            raise UserError(f"{path} has no co-simulation: export it as an FMU for co-simulation")
        self.version = str(self.description.fmiVersion)[0]
        if self.version not in "23":
            raise UserError(
                f"{path} is of FMI {self.description.fmiVersion}: export it as FMI 2.0 or 3.0"
            )
        variables = {v.name: v for v in self.description.modelVariables}
        inputs = [
            (place, variables[name])
            for place, key in enumerate(INPUTS)
            if (name := names.get(key, key)) in variables or key in names
            if self._checked(variables, name)
        ]
        if not inputs:
            raise UserError(
                f"{path} has none of the inputs {', '.join(INPUTS)}: name its own, as in "
                f"fmu:{path}?v_vut_mps=NAME"
            )

        def optional(key: str, causality: str, types: tuple[str, ...]) -> Any:
            if key in names or getattr(variables.get(key), "causality", None) in causality.split():
                return self._checked(variables, names.get(key, key), types)
            return None

        is_free = REACHED in names or OUTPUT not in names
        output = optional(REACHED, "output", _FLOATS) if is_free else None
        self.reaches = output is not None
        if output is None:
            output = self._checked(variables, names.get(OUTPUT, OUTPUT))
        wish = optional(MERGE, "output", (*_FLOATS, _BOOLEAN))
        self.seed = optional(SEED, "input parameter", (*_FLOATS, *_INTEGERS))
        self.output, self.wish = output, wish
        self.inputs: dict[str, tuple[list[int], list[int]]] = {}
        """Places in the state and references, by type: a unit takes those of a type at once."""
        for place, variable in inputs:
            places, references = self.inputs.setdefault(variable.type, ([], []))
            places.append(place)
            references.append(variable.valueReference)

    def _checked(
        self, variables: dict[str, Any], name: str, types: tuple[str, ...] = _FLOATS
    ) -> Any:
        """Return a variable that is of one of some types; `UserError` when it is not."""
        variable = variables.get(name)
        if variable is None:
            names = ", ".join(sorted(variables)[:12])
            raise UserError(f"{self._path} has no variable {name!r}; it has {names}")
        if variable.type not in types:
            raise UserError(
                f"the variable {name!r} of {self._path} is a {variable.type}: it must be a "
                f"{either(types)}"
            )
        if variable.dimensions:
            raise UserError(f"the variable {name!r} of {self._path} is an array: name a number")
        return variable

    @cached_property
    def _folder(self) -> TemporaryDirectory[str]:
        """The unpacked unit, which is removed with this object."""
        folder = TemporaryDirectory(prefix="merge-sumo-fmu-", ignore_cleanup_errors=True)
        self._fmpy.extract(str(self._path), folder.name)
        return folder

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
                guid=self.description.guid,
                unzipDirectory=self._folder.name,
                modelIdentifier=self.description.coSimulation.modelIdentifier,
                instanceName=f"vut{self._instances}",
            )
        made.instantiate()
        return made


class FmuController(Controller):
    """Steps an instance of the unit: set the state, step by 0.1 s, read."""

    def __init__(self, unit: Unit) -> None:
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
        instance, unit = self._instance, self._unit
        self._set(seen)
        instance.doStep(seen.t_s, DT_S)
        acceleration = float(_value(instance, unit.output))
        if unit.reaches:
            acceleration = (acceleration - seen.v_vut_mps) / DT_S
        if unit.wish is None:
            return acceleration
        return acceleration, as_merge(float(_value(instance, unit.wish)))

    def close(self) -> None:
        """Free the instance."""
        with suppress(Exception):  # a unit that failed cannot be terminated
            self._instance.terminate()
        self._instance.freeInstance()

    def _set(self, seen: Seen) -> None:
        for kind, (places, references) in self._unit.inputs.items():
            set_all = getattr(self._instance, f"set{kind}")
            set_all(references, [seen[1 + place] for place in places])


def _value(instance: Any, variable: Any) -> Any:
    """Return the value of a variable; those of FMPy's instances are read by type."""
    return getattr(instance, f"get{variable.type}")([variable.valueReference])[0]


class FmuKind(ControllerKind):
    """A unit: `fmu:FILE?x_vut_m=NAME&...`."""

    form = "fmu:FILE[?VARIABLE=NAME&...]"
    what = "an FMI 2.0 or 3.0 co-simulation unit, with its names of the variables"
    example = '--vut "fmu:controller.fmu?v_vut_mps=Speed&acceleration_mps2=Cmd"'
    no_parameters = "the options of an FMU are the names of its variables"
    hosted, asks_sumo = True, False

    def __init__(self, spec: VutSpec, options: VutOptions) -> None:
        """Read the description of the unit; `UserError` for one that cannot drive."""
        super().__init__(spec, options)
        names = dict(spec.parameters)
        if unknown := set(names) - set(NAMES):
            raise UserError(
                f"{spec}: there is no variable {unknown.pop()!r} to name: choose from "
                f"{', '.join(NAMES)}"
            )
        self.files = (Path(spec.argument),)
        self._unit = Unit(self.files[0], names)
        once = str(self._unit.description.coSimulation.canBeInstantiatedOnlyOncePerProcess)
        self.max_corridors = 1 if once == "True" else None

    @classmethod
    def file_of(cls, argument: str) -> str:
        """Return the file of the unit."""
        return argument

    def controller(self) -> Controller:
        """Return a controller of one corridor."""
        return FmuController(self._unit)
