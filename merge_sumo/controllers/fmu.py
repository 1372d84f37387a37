"""A VUT as an FMU: a co-simulation unit of FMI 2.0 or 3.0, such as Simulink exports."""

from __future__ import annotations

from contextlib import chdir, suppress
from importlib import import_module
from tempfile import TemporaryDirectory
from typing import Any

from merge_sumo.controllers.controller import Controller, Seen, Start, as_merge
from merge_sumo.controllers.spec import FileKind
from merge_sumo.errors import UserError
from merge_sumo.scenario.scenario import DT_S

INPUTS = ("x_pov_m", "v_pov_mps", "x_vut_m", "v_vut_mps")
OUTPUT = "acceleration_mps2"
REACHED = "v_mps"
"""An output instead of the acceleration: the speed of the vehicle after the step."""
MERGE = "merge"
SEED = "seed"
"""Optional variables: an output, whether to merge, and an input or a parameter."""
FLOATS = ("Real", "Float64", "Float32")
"""Types of variables that a float is written to."""


class FmuKind(FileKind):
    """A unit: `fmu:FILE?x_vut_m=NAME&...`.

    The unit may lack inputs that the spec does not name, but not all of them. Its output is the
    speed reached, or else the acceleration; a spec that names the acceleration alone selects it.

    Attributes:
        version: first digit of the version of FMI.
        inputs: for each input its index in `INPUTS`, and its variable.
        output: variable of the acceleration, or of the speed reached.
        reaches: whether the output is the speed reached.
        merge_request: variable of the merge request; None without one.
        seed: variable of the seed; None without one.
    """

    form = "fmu:FILE[?VARIABLE=NAME&...]"
    what = "an FMI 2.0 or 3.0 co-simulation unit; VARIABLE=NAME maps its names of variables"
    example = '--vut "fmu:controller.fmu?v_vut_mps=Speed&acceleration_mps2=Cmd"'
    no_parameters = "the options of an FMU are the names of its variables"
    library = "fmpy"
    names = (*INPUTS, OUTPUT, REACHED, MERGE, SEED)

    def load(self) -> None:
        """Read the description of the unit.

        Raises:
            UserError: if it cannot be read, or cannot drive.
        """
        super().load()
        path = self.path
        # The unpacked unit; it is removed with this object.
        self._folder = TemporaryDirectory(prefix="merge-sumo-fmu-", ignore_cleanup_errors=True)
        try:
            self._description = self.api.read_model_description(str(path))
            self.api.extract(str(path), self._folder.name)
        except Exception as error:  # of many classes: XML, zip, FMPy's own
            raise UserError(f"{path} is not a readable FMU: {str(error)[:200]}") from error
        simulation, version = self._description.coSimulation, str(self._description.fmiVersion)
        if simulation is None or version[0] not in "23":
            raise UserError(
                f"{path} is not a co-simulation FMU of FMI 2.0 or 3.0: export it as one"
            )
        self.version, self._instances = version[0], 0
        if str(simulation.canBeInstantiatedOnlyOncePerProcess) == "True":
            self.max_corridors = 1
        self._variables = {each.name: each for each in self._description.modelVariables}
        self.inputs: list[tuple[int, Any]] = []
        for index, key in enumerate(INPUTS):
            if (variable := self._variable(key, "input")) is not None:
                self.inputs.append((index, variable))
        if not self.inputs:
            raise UserError(
                f"{path} has none of the inputs {', '.join(INPUTS)}: give the names of yours, as "
                f"in fmu:{path}?v_vut_mps=NAME"
            )
        self.output = None
        if REACHED in self.chosen or OUTPUT not in self.chosen:
            self.output = self._variable(REACHED, "output")
        self.reaches = self.output is not None
        if self.output is None:
            self.chosen.setdefault(OUTPUT, OUTPUT)  # it must be there
            self.output = self._variable(OUTPUT, "output")
        self.merge_request = self._variable(MERGE, "output")
        self.seed = self._variable(SEED, "input parameter")

    def controller(self) -> Controller:
        """Return a controller of one corridor."""
        return FmuController(self)

    def instance(self) -> Any:
        """Return a new instance of the unit."""
        self._instances += 1
        module = import_module(f"fmpy.fmi{self.version}")
        # FMPy goes to the folder of the binary and, when that cannot be loaded, stays there.
        with chdir("."):
            instance: Any = getattr(module, f"FMU{self.version}Slave")(
                guid=self._description.guid,
                unzipDirectory=self._folder.name,
                modelIdentifier=self._description.coSimulation.modelIdentifier,
                instanceName=f"vut{self._instances}",
            )
        instance.instantiate()
        return instance

    def _variable(self, key: str, causalities: str) -> Any:
        """Return the variable of one of our names, or None.

        Args:
            key: our name of the variable.
            causalities: causalities that it must have where the spec does not name it.

        Raises:
            UserError: for a variable that the spec names and that is not there.
        """
        name = self.chosen.get(key, key)
        variable = self._variables.get(name)
        if key not in self.chosen:
            if variable is None or variable.causality not in causalities.split():
                return None
        elif variable is None:
            names = ", ".join(sorted(self._variables)[:12])
            raise UserError(f"{self.path} has no variable {name!r}; it has {names}")
        return variable


class FmuController(Controller):
    """Steps an instance of the unit: set the state, step by 0.1 s, read."""

    def __init__(self, unit: FmuKind) -> None:
        """Make an instance.

        Args:
            unit: the unit.

        Raises:
            UserError: if it cannot be instantiated.
        """
        self._unit, self._has_run = unit, False
        try:
            self._instance = unit.instance()
        except Exception as error:  # of FMPy or of the loader of the binary
            raise UserError(f"the FMU cannot be instantiated: {error}") from error

    def reset(self, start: Start) -> None:
        """Initialise the instance at t = 0 with the state at the start.

        Args:
            start: first observation of the episode.
        """
        instance = self._instance
        if self._has_run:
            instance.reset()
        self._has_run = True
        if self._unit.version == "2":
            instance.setupExperiment(startTime=0.0)
            instance.enterInitializationMode()
        else:
            instance.enterInitializationMode(startTime=0.0)
        self._set_state(start.seen)
        variable = self._unit.seed
        if variable is not None:
            # A signed integer of 32 bits has no room for all seeds.
            is_float = variable.type in FLOATS
            self._set(variable, float(start.seed) if is_float else start.seed % 2**31)
        instance.exitInitializationMode()

    def act(self, seen: Seen) -> float | tuple[float, bool]:
        """Return the outputs after a step of 0.1 s with a constant state.

        Args:
            seen: the observation at this step.

        Returns:
            An acceleration in m/s2, or (acceleration, whether to merge).
        """
        unit = self._unit
        self._set_state(seen)
        self._instance.doStep(seen.t_s, DT_S)
        acceleration_mps2 = self._value(unit.output)
        if unit.reaches:
            acceleration_mps2 = (acceleration_mps2 - seen.v_vut_mps) / DT_S
        if unit.merge_request is None:
            return acceleration_mps2
        return acceleration_mps2, as_merge(self._value(unit.merge_request))

    def close(self) -> None:
        """Free the instance."""
        with suppress(Exception):  # a unit that failed cannot be terminated
            self._instance.terminate()
        self._instance.freeInstance()

    def _set_state(self, seen: Seen) -> None:
        for index, variable in self._unit.inputs:
            self._set(variable, seen[1 + index])

    def _set(self, variable: Any, value: float) -> None:
        """Set a variable, which FMPy does by its type."""
        getattr(self._instance, f"set{variable.type}")([variable.valueReference], [value])

    def _value(self, variable: Any) -> float:
        """Return the value of a variable, which FMPy reads by its type."""
        return float(getattr(self._instance, f"get{variable.type}")([variable.valueReference])[0])
