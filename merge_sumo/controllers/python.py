"""A VUT in Python: a class, a plain function, or a class that acts in all corridors at once."""

from __future__ import annotations

import copy
import importlib
import importlib.util
import inspect
import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from merge_sumo.controllers.controller import (
    Controller,
    ControllerDriver,
    Start,
    WrongAnswerError,
)
from merge_sumo.controllers.deadline import Deadline, close_within, text_of
from merge_sumo.controllers.signatures import (
    attributes_of,
    check_call,
    check_methods,
    defaults_of,
    fits,
    is_code,
    numbers_of,
    takes_seed,
)
from merge_sumo.controllers.spec import HERE, ControllerKind, ControllerSpec
from merge_sumo.drivers.base import MERGE, NO_REQUEST, STAY, Driver, EpisodesLostError, Scene
from merge_sumo.errors import ControllerError, UserError
from merge_sumo.files import check_code
from merge_sumo.registry import entries_of
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import DT_S, VUT
from merge_sumo.scenario.signals import StepSignals, valid_signals

objects: dict[str, Any] = {}
"""Objects of this process that are controllers, by the arguments of their specs."""


def object_of(spec: ControllerSpec) -> Any:
    """Return the object of this process that a spec names; None for a spec of another kind.

    Args:
        spec: any spec.
    """
    return objects.get(spec.argument) if spec.kind == HERE else None


def installed_vuts() -> dict[str, EntryPoint]:
    """Return the VUTs that installed packages register, by name."""
    vuts: dict[str, EntryPoint] = {}
    for name, entries in entries_of("merge_sumo.vuts").items():
        *_, vuts[name] = entries.values()
    return vuts


class PythonObjectKind(ControllerKind):
    """A class, a function or an object that drives; a subclass finds it.

    Each corridor has an object of its own: a new one of a class, a copy of an object. An object
    that acts in all corridors at once is not copied, unless parameters are given.

    A parameter is a keyword of the constructor, or of the function. A parameter that the
    constructor does not have is a numeric attribute of the object that is made.

    Attributes:
        is_function: whether it is a function, which has no state to reset.
    """

    asks_sumo = False

    def load(self) -> None:
        """Check the target and the parameters.

        Raises:
            UserError: if it cannot be called as a VUT, or has no such parameter.
        """
        self._target = target = self.target()
        self.is_function, self._is_class = inspect.isroutine(target), isinstance(target, type)
        if self.is_function:
            check_call(target, ("seen",))
        else:
            check_methods(target)
        self._is_batched = callable(getattr(target, "act_batch", None))
        acts = self._is_batched or callable(getattr(target, "act", None))
        if not acts and (self._is_class or not callable(target) or not fits(target, 1)):
            raise self.not_a_vut(target)
        # An observation, or the number of corridors, is positional.
        positional = int(not self._is_class or self._is_batched)
        defaults = defaults_of(target, positional)
        self._keywords: dict[str, float] = {}
        self._attributes: dict[str, float] = {}
        for name, value in self.spec.numbers().items():
            if name in defaults:
                self._keywords[name] = value
            elif self.is_function:
                raise self.spec.unknown_parameter(name, defaults)
            else:
                self._attributes[name] = value
        self._numbers = numbers_of(defaults | self._keywords)

    def target(self) -> Any:
        """Return the class, function or object.

        Raises:
            UserError: if it cannot be loaded.
        """
        raise NotImplementedError

    def not_a_vut(self, target: Any) -> UserError:
        """Return the error for a target that is not a VUT.

        Args:
            target: any object.
        """
        return UserError(
            f"{self.spec.argument} is {text_of(target, repr)[:80]}: a VUT is a class or an object "
            "with `act(self, seen)` or `act_batch(self, seen)`, or a function `f(seen)`"
        )

    def controller(self) -> Controller:
        """Return a controller of one corridor."""
        return PythonController(self)

    def driver(self, corridors: int, simulation: object) -> Driver:
        """Return the driver of all corridors.

        Args:
            corridors: number of corridors.
            simulation: not used.
        """
        if self._is_batched:
            return BatchedDriver(corridors, self)
        return super().driver(corridors, simulation)

    def make(self, *corridors: int) -> Any:
        """Return a new object, or the function with its keywords.

        Args:
            *corridors: the number of corridors, for a class that acts in all of them.

        Raises:
            UserError: if it cannot be made, or has no such parameter.
        """
        target = self._target
        if self.is_function:
            return partial(target, **self._keywords) if self._keywords else target
        if self._is_batched and not (self._is_class or self._attributes):
            return target
        try:
            made = copy.deepcopy(target)  # of a class, itself
            if self._is_class:
                made = target(*corridors, **self._keywords)
            present = self.parameters_of(made)
            for name, value in self._attributes.items():
                if name not in present:
                    raise self.spec.unknown_parameter(name, present)
                setattr(made, name, value)
        except UserError:
            raise
        except (Exception, SystemExit) as error:
            how = "made" if self._is_class else "copied for each corridor (give its class instead)"
            why = f"{type(error).__name__}: {text_of(error)}"
            raise UserError(f"{self.spec} cannot be {how}: {why}") from error
        return made

    def parameters_of(self, made: Any) -> dict[str, float]:
        """Return the parameters of an object, by name, with their present values.

        Args:
            made: an object that `make` returned.
        """
        return ({} if self.is_function else attributes_of(made)) | self._numbers


class PythonKind(PythonObjectKind):
    """A class or a function of a module or a file: `module:Name` or `file.py:Name`."""

    form = "MODULE:NAME[?PARAMETER=VALUE&...] or FILE.py:NAME"
    what = "a class with act(seen), a function of seen, or a batched class"
    example = "--vut my_vut.py:MyVut"
    hosted = True

    def target(self) -> Any:
        """Return the class or function that the spec names."""
        return self.code_at(self.spec.argument)

    def code_at(self, reference: str) -> Any:
        """Return a class or function, and note its file.

        Args:
            reference: MODULE:NAME or FILE.py:NAME.

        Raises:
            UserError: if the module cannot be loaded, or has no such class or function.
        """
        source, _, name = reference.rpartition(":")
        module = _module_of(source)
        target: Any = module
        for part in name.split("."):
            target = getattr(target, part, None)
        if target is None:
            raise UserError(f"{source} has no {name!r}: name one of its classes or functions")
        if not is_code(target):
            raise self.not_a_vut(target)
        if file := getattr(module, "__file__", None):
            self.code = (Path(file),)
        return target


class InstalledKind(PythonKind):
    """A VUT that an installed package registers, by its name."""

    form = what = example = ""

    def target(self) -> Any:
        """Return the object that the package registers."""
        entry = installed_vuts()[self.spec.argument]
        return self.code_at(f"{entry.module}:{entry.attr}")


class InProcessKind(PythonObjectKind):
    """An object of this process, `here:NAME`, which drives in it."""

    files_are_known, max_workers = False, 1

    def target(self) -> Any:
        """Return the object.

        Raises:
            UserError: if it was an object of another process.
        """
        if self.spec.argument not in objects:
            raise UserError(
                f"{self.spec} was an object of a Python process: name a VUT, or pass the object "
                "again"
            )
        target = objects[self.spec.argument]
        with suppress(TypeError, OSError):  # it was typed at a prompt
            file = inspect.getsourcefile(target if is_code(target) else type(target))
            if file and Path(file).is_file():
                self.code = (Path(file),)
        return target


class PythonController(Controller):
    """An object with `act(seen)`, or one that is called itself.

    An object without `reset` cannot forget an episode, so each episode has a new one; a function
    has nothing to forget.
    """

    def __init__(self, kind: PythonObjectKind) -> None:
        """Make the object.

        Args:
            kind: makes it.
        """
        self._kind, self._thing = kind, kind.make()
        # The driver calls the user's function itself: a frame less in each step.
        self.act = getattr(self._thing, "act", self._thing)  # type: ignore[method-assign]
        self.single_use = not kind.is_function and getattr(self._thing, "reset", None) is None

    def reset(self, start: Start) -> None:
        """Call `reset`, if the object has it.

        Args:
            start: first observation of the episode.
        """
        _reset(self._thing, start.seen, seed=start.seed)

    def signals(self) -> StepSignals:
        """Return the signals that the object has left in its attribute `signals`."""
        left = getattr(self._thing, "signals", None)
        return {} if left is None else valid_signals(left)

    def parameters(self) -> Mapping[str, float]:
        """Return the parameters of the object."""
        return self._kind.parameters_of(self._thing)

    def close(self) -> None:
        """Call `close`, if the object has it."""
        _close(self._thing)


class BatchedDriver(ControllerDriver):
    """Drives by one object that acts in all corridors at once.

    The object is made with the number of corridors K. Its `act_batch(seen)` returns accelerations,
    (K,), or these and whether to merge, (2, K). It may have `reset(corridor, seen)`, or
    `reset(corridor, seen, seed)`, and `close()`.
    """

    def __init__(self, corridors: int, kind: PythonObjectKind) -> None:
        """Make the object.

        Args:
            corridors: number of corridors.
            kind: makes it.
        """
        super().__init__(corridors)
        self._kind, self._deadline = kind, Deadline(kind.options.deadline_s)
        self._object = kind.make(corridors)
        self._replace = False
        self._lanes_m = np.zeros((2, corridors))

    def reset(self, corridor: int, start: Start) -> None:
        """Call `reset`, if the object has it; an error is kept as the reason of the answer.

        After an act that failed, all episodes begin again, with a new object.

        Args:
            corridor: index of the corridor.
            start: first observation of the episode.
        """
        self._reasons.pop(corridor, None)
        self._lanes_m[:, corridor] = start.lane_m or (0.0, 0.0)
        try:
            with self._deadline as deadline:
                deadline.start()
                if self._replace:
                    self._object, self._replace = self._kind.make(self.corridors), False
                _reset(self._object, corridor, start.seen, seed=start.seed)
                deadline.stop()
        except BaseException as error:
            self._reasons[corridor] = f"reset: {self._deadline.reason(error)}"

    def act(self, scene: Scene) -> FloatArray:
        """Call `act_batch` on a copy of the scene.

        Args:
            scene: the state of all corridors.

        Returns:
            Accelerations, (K,), m/s2; NaN where there is a reason.

        Raises:
            EpisodesLostError: if it fails and several episodes run: any may be at fault.
        """
        self._merge_requests, k = None, self.corridors
        seen = SeenBatch.of(scene, self._lanes_m)
        try:
            with self._deadline as deadline:
                deadline.start()
                answer = np.asarray(self._object.act_batch(seen))
                deadline.stop()
            if answer.shape not in ((k,), (2, k)) or answer.dtype.kind not in "fiu":
                raise WrongAnswerError(
                    f"answered shape {answer.shape} of {answer.dtype} instead of {k} numbers, or "
                    f"{k} numbers and {k} merge requests"
                )
        except BaseException as error:
            reason, self._replace = self._deadline.reason(error), True
            running = np.flatnonzero(scene.active).tolist()
            if len(running) > 1:
                raise EpisodesLostError(reason) from None
            self._reasons = dict.fromkeys(running, reason) | self._reasons
            return np.full(k, np.nan)
        answer = answer.astype(np.float64)
        if answer.ndim == 2:
            answer, requests = answer
            self._take_requests(requests, scene.active)
        answer[list(self._reasons)] = np.nan
        return answer

    def _take_requests(self, requests: FloatArray, active: NDArray[np.bool_]) -> None:
        """Take whether to merge, 1 or 0, (K,), where an episode runs."""
        known = (requests == MERGE) | (requests == STAY)
        self._merge_requests = np.where(active & known, requests, NO_REQUEST).astype(np.int8)
        for corridor in np.flatnonzero(active & ~known).tolist():
            wrong = f"requested the merge with {requests[corridor]} instead of 1 or 0"
            self._reasons.setdefault(corridor, wrong)

    def parameters(self) -> Mapping[str, float]:
        """Return the parameters of the object."""
        return self._kind.parameters_of(self._object)

    def close(self) -> None:
        """Call `close`, if the object has it."""
        close_within(self._deadline.deadline_s, partial(_close, self._object))


@dataclass(frozen=True, slots=True)
class SeenBatch:
    """The observation of a batched controller: as `Seen`, with an array over K corridors.

    Each array has the shape (K,) unless stated otherwise, and is a copy.

    Example:
        ```python
        def act_batch(self, seen: SeenBatch) -> FloatArray:
            return np.where(seen.x_vut_m > seen.x_pov_m, 1.0, -1.0)
        ```

    Attributes:
        active: whether an episode runs in the corridor; if not, its numbers have no meaning.
        t_s: time since the beginning of the episode, in s.
        x_pov_m: position of the POV's front bumper, in m; 0 at M, negative before M.
        v_pov_mps: speed of the POV, in m/s.
        x_vut_m: position of the VUT's front bumper, in m; 0 at M, negative before M.
        v_vut_mps: speed of the VUT, in m/s.
        x_others_m: positions of all cars on the mainline, the first one ahead, (cars, K), in m.
        v_others_mps: speeds of these cars, (cars, K), in m/s.
        lane_begin_m: position where the acceleration lane begins, in m; 0 without a lane.
        lane_end_m: position where the acceleration lane ends, in m; 0 without a lane.
        merged: whether the VUT is on the mainline; without a lane, whether it is at M.
    """

    active: NDArray[np.bool_]
    t_s: FloatArray
    x_pov_m: FloatArray
    v_pov_mps: FloatArray
    x_vut_m: FloatArray
    v_vut_mps: FloatArray
    x_others_m: FloatArray
    v_others_mps: FloatArray
    lane_begin_m: FloatArray
    lane_end_m: FloatArray
    merged: NDArray[np.bool_]

    @classmethod
    def of(cls, scene: Scene, lanes_m: FloatArray) -> Self:
        """Return the observation of a scene.

        Args:
            scene: the state of all corridors.
            lanes_m: begin and end of the acceleration lanes, (2, K), in m; 0 and 0 without a lane.
        """
        scene, (begin_m, end_m) = copy.deepcopy(scene), lanes_m.copy()
        x_m, v_mps = np.delete(scene.x_m, VUT, axis=0), np.delete(scene.v_mps, VUT, axis=0)
        order = np.argsort(-x_m, axis=0, kind="stable")
        merged = scene.x_vut_m >= 0.0
        if scene.merged is not None:
            merged = np.where(begin_m < end_m, scene.merged, merged)
        return cls(
            active=scene.active,
            t_s=np.round(scene.step * DT_S, 1),
            x_pov_m=scene.x_pov_m,
            v_pov_mps=scene.v_pov_mps,
            x_vut_m=scene.x_vut_m,
            v_vut_mps=scene.v_vut_mps,
            x_others_m=np.take_along_axis(x_m, order, axis=0),
            v_others_mps=np.take_along_axis(v_mps, order, axis=0),
            lane_begin_m=begin_m,
            lane_end_m=end_m,
            merged=merged,
        )

    @property
    def may_merge(self) -> NDArray[np.bool_]:
        """Whether a merge request moves the VUT to the mainline in the next step, (K,)."""
        has_lane = self.lane_begin_m < self.lane_end_m
        next_m = self.x_vut_m + self.v_vut_mps * DT_S
        may: NDArray[np.bool_] = has_lane & ~self.merged & (next_m >= self.lane_begin_m)
        return may


def _close(thing: Any) -> None:
    """Call `close` of an object that has it."""
    if getattr(thing, "close", None) is not None:
        thing.close()


def _reset(thing: Any, *arguments: Any, seed: int) -> None:
    """Call `reset` of an object that has it, with the seed of the episode where it takes one."""
    reset = getattr(thing, "reset", None)
    if reset is None:
        return
    if takes_seed(reset):
        reset(*arguments, seed=seed)
    else:
        reset(*arguments)


def _module_of(source: str) -> ModuleType:
    """Return the module of a file or of a name; raises `UserError` if it cannot be loaded."""
    try:
        if source.endswith(".py"):
            check_code(Path(source))
            return module_of_file(Path(source))
        return _imported(source)
    except UserError:
        raise
    except (Exception, SystemExit) as error:
        why = f"{type(error).__name__}: {text_of(error)}"
        raise ControllerError(f"cannot load the VUT {source}: {why}") from error


def _imported(name: str) -> ModuleType:
    """Return a module; as in a Python started there, it may be in the working folder."""
    _search_in(Path.cwd())
    found = importlib.util.find_spec(name.partition(".")[0])
    if found is not None and found.has_location and found.origin is not None:
        check_code(Path(found.origin))
    return importlib.import_module(name)


def _search_in(folder: Path) -> None:
    """Let modules of a folder be imported, after those of all other folders."""
    if str(folder) not in sys.path:
        sys.path.append(str(folder))


def module_of_file(path: Path) -> ModuleType:
    """Execute a file as a module, which can import the modules next to it, and return it.

    What its code raises is not caught.

    Args:
        path: the file.

    Raises:
        OSError: if it cannot be read.
    """
    path = path.resolve()
    spec = importlib.util.spec_from_file_location(f"merge_sumo_file_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise ImportError("it is not a Python file")
    module = importlib.util.module_from_spec(spec)
    _search_in(path.parent)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
