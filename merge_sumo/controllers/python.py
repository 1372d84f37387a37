"""A VUT in Python: a class, a plain function, or a class that acts in all corridors at once."""

from __future__ import annotations

import copy
import importlib
import importlib.util
import inspect
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.controllers.base import ControllerKind, VutOptions, VutSpec
from merge_sumo.controllers.controller import (
    Controller,
    ControllerArray,
    ControllerDriver,
    Seen,
    Start,
    WrongAnswerError,
)
from merge_sumo.controllers.deadline import Deadline, closed, text_of
from merge_sumo.controllers.parameters import Parameters
from merge_sumo.controllers.signatures import check_call, check_methods, fits, takes_seed
from merge_sumo.drivers.base import MERGE, NO_WISH, STAY, Driver, Scene, VutLostError
from merge_sumo.errors import UserError
from merge_sumo.registry import entries_of
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import DT_S, VUT
from merge_sumo.scenario.signals import Left, as_signals
from merge_sumo.source_files import module_of_file
from merge_sumo.trust import check_code

GROUP: Final = "merge_sumo.vuts"
"""Entry points of this group are VUTs by their name."""


def installed_vuts() -> dict[str, EntryPoint]:
    """Return the VUTs that installed packages register, by name."""
    return {name: entry for name, found in entries_of(GROUP).items() for entry in found.values()}


def is_code(target: Any) -> bool:
    """Return whether something is a class or a function, and no other object."""
    return isinstance(target, type) or inspect.isroutine(target)


NO_VUT: Final = (
    "a VUT is a class with `act(self, seen)`, a class with `act_batch(self, seen)`, or a function "
    "`f(seen)`"
)


class OfPython(ControllerKind):
    """A class, a function or an object, which a subclass finds.

    Each corridor has an object of its own: a new one of a class, a copy of an object. One that acts
    in all corridors at once is not copied, unless parameters are given.
    """

    asks_sumo = False

    def __init__(self, spec: VutSpec, options: VutOptions) -> None:
        """Check the target; `UserError` where it cannot be called as a VUT is."""
        super().__init__(spec, options)
        self._given = spec.numbers()
        self._target = target = self.target()
        if inspect.isroutine(target):
            check_call(target, ("seen",))
        else:
            check_methods(target)
        self._is_class = isinstance(target, type)
        self._is_batched = callable(getattr(target, "act_batch", None))
        self._acts = callable(getattr(target, "act", None))
        called = not self._is_class and callable(target) and fits(target, 1)
        if not (self._is_batched or self._acts or called):
            raise self.refused(target)
        in_order = int(not self._is_class or self._is_batched)
        self._parameters = Parameters(target, spec, self._given, in_order)

    def target(self) -> Any:
        """Return the class, function or object; `UserError` where it cannot be loaded."""
        raise NotImplementedError

    def refused(self, target: Any) -> UserError:
        """Return the error for a target that is not a VUT."""
        return UserError(f"{self.spec} is {text_of(target, repr)[:80]}: {NO_VUT}")

    def controller(self) -> Controller:
        """Return a controller of one corridor."""
        return PythonController(self._new(), self._parameters, acts=self._acts)

    def driver(self, corridors: int, _world: object) -> Driver:
        """Return the driver of all corridors."""
        deadline_s = self.options.deadline_s
        if self._is_batched:
            new = lambda: self._new(corridors)  # noqa: E731
            return BatchedVut(corridors, new, deadline_s, self._parameters)
        return ControllerArray(corridors, self.controller, deadline_s)

    def _new(self, *corridors: int) -> Any:
        """Return a new object, made with the number of corridors where it acts in all of them."""
        parameters, target = self._parameters, self._target
        if inspect.isroutine(target):
            return parameters.bound(target)
        if self._is_class:
            return parameters.set_in(self._made(*corridors))
        return parameters.set_in(target if self._is_batched and not self._given else self._copy())

    def _made(self, *corridors: int) -> Any:
        try:
            return self._target(*corridors, **self._parameters.keywords)
        except (Exception, SystemExit) as error:
            given = f" with {corridors[0]} corridors" if corridors else " without arguments"
            what = f"{type(error).__name__}: {text_of(error)}"
            raise UserError(f"{self.spec} cannot be made{given}: {what}") from error

    def _copy(self) -> Any:
        """Return a copy of the object as it was given: no episode changes that of another."""
        try:
            return copy.deepcopy(self._target)
        except Exception as error:
            raise UserError(
                f"{self.spec} cannot be copied for the episodes that run at a time "
                f"({text_of(error)}): give its class, or a function that makes no difference "
                "between them"
            ) from error


class PythonKind(OfPython):
    """`module:Name` or `file.py:Name`."""

    form = "MODULE:NAME[?PARAMETER=VALUE&...] or FILE.py:NAME"
    what = "a class with act(seen), a function of seen, or a batched class"
    example = "--vut my_vut.py:MyVut"
    hosted = True

    @classmethod
    def file_of(cls, argument: str) -> str:
        """Return the file that an argument names."""
        source = argument.rpartition(":")[0]
        return source if source.endswith(".py") else ""

    def target(self) -> Any:
        """Return what the module has by that name."""
        source, _, name = self.spec.argument.rpartition(":")
        module = _module_of(source)
        target: Any = module
        for part in name.split("."):
            target = getattr(target, part, None)
        if target is None:
            raise UserError(f"{source} has no {name!r}: name a class or a function of it")
        return self.code_of(target, module)

    def code_of(self, target: Any, module: ModuleType | None) -> Any:
        """Return a class or a function, and note its file; `UserError` for something else."""
        if not is_code(target):
            raise self.refused(target)
        if file := getattr(module, "__file__", None):
            self.files = (Path(file),)
        return target


class InstalledKind(PythonKind):
    """A name that an installed package registers."""

    form = what = example = ""

    @classmethod
    def file_of(cls, _argument: str) -> str:
        """Return that a name is not a file."""
        return ""

    def target(self) -> Any:
        """Return what the package registers."""
        name = self.spec.argument
        try:
            target = installed_vuts()[name].load()
        except (Exception, SystemExit) as error:
            raise UserError(_cannot_load(name, error)) from error
        return self.code_of(target, sys.modules.get(getattr(target, "__module__", "")))


class PythonController(Controller):
    """An object with `act(seen)`, or one that is called itself.

    An object without `reset` is never told that an episode begins, so each episode has a new one; a
    function has nothing to reset.
    """

    def __init__(self, thing: Any, parameters: Parameters, *, acts: bool) -> None:
        """Drive by a thing; `acts` says whether it has `act`."""
        self._thing, self._parameters = thing, parameters
        self._act = thing.act if acts else thing
        self._reset = getattr(thing, "reset", None)
        self.single_use = self._reset is None and not inspect.isroutine(thing)

    def reset(self, start: Start) -> None:
        """Call `reset`, if there is one."""
        if self._reset is not None:
            _reset(self._reset, start.seen, seed=start.seed)

    def act(self, seen: Seen) -> Any:
        """Ask the object."""
        return self._act(seen)

    def signals(self) -> Left:
        """Return the `signals` that the object has left as an attribute."""
        left = getattr(self._thing, "signals", None)
        return {} if left is None else as_signals(left)

    def parameters(self) -> Mapping[str, float]:
        """Return the parameters of the object."""
        return self._parameters.present(self._thing)

    def close(self) -> None:
        """Call `close`, if there is one."""
        _close(self._thing)


class BatchedVut(ControllerDriver):
    """Drives by one object that acts in all corridors at once.

    It is made with the number of corridors K, has `act_batch(seen)`, which returns K
    accelerations, (K,), or these and whether to merge, (2, K), and perhaps `reset(corridor, seen)`,
    or `reset(corridor, seen, seed)`, and `close()`.
    """

    def __init__(
        self,
        corridors: int,
        new: Callable[[], Any],
        deadline_s: float,
        parameters: Parameters,
    ) -> None:
        """Make the object.

        Args:
            corridors: number of corridors.
            new: makes an object.
            deadline_s: time for one call.
            parameters: its parameters.
        """
        super().__init__(corridors)
        self._deadline = Deadline(deadline_s)
        self._new, self._parameters = new, parameters
        self._object = new()
        self._replace = False
        self._raised: str | None = None
        self._wrong: dict[int, str] = {}
        """What is wrong in a corridor alone: its reset raised something, or its wish is none."""
        self._lanes_m = np.zeros((2, corridors))

    def reset(self, corridor: int, start: Start) -> None:
        """Call `reset`, if there is one; an error is kept as the reason of the answer.

        After an act that failed all episodes begin, and a new object serves them.
        """
        self._wrong.pop(corridor, None)
        self._lanes_m[:, corridor] = start.lane_m or (0.0, 0.0)
        try:
            with self._deadline as deadline:
                deadline.start()
                if self._replace:
                    self._object, self._replace = self._new(), False
                reset = getattr(self._object, "reset", None)
                if reset is not None:
                    _reset(reset, corridor, start.seen, seed=start.seed)
                deadline.stop()
        except BaseException as error:
            self._wrong[corridor] = f"reset: {self._deadline.reason(error)}"

    def act(self, scene: Scene) -> FloatArray:
        """Call `act_batch` on a copy of the scene.

        Raises `VutLostError` when it fails and several episodes run: the one at fault is unknown.
        """
        self._raised = self._wishes = None
        seen, k = _batch(scene, self._lanes_m), self.corridors
        try:
            with self._deadline as deadline:
                deadline.start()
                answer = np.asarray(self._object.act_batch(seen))
                deadline.stop()
            if answer.shape not in ((k,), (2, k)) or answer.dtype.kind not in "fiu":
                raise WrongAnswerError(
                    f"answered shape {answer.shape} of {answer.dtype} instead of {k} numbers, or "
                    f"these and {k} wishes"
                )
        except BaseException as error:
            self._raised = self._deadline.reason(error)
            self._replace = True
            if scene.active.sum() > 1:
                raise VutLostError(self._raised) from None
            return np.full(self.corridors, np.nan)
        answer = answer.astype(np.float64)
        if answer.ndim == 2:
            answer, wishes = answer
            self._take(wishes, scene.active)
        answer[list(self._wrong)] = np.nan
        return answer

    def _take(self, wishes: FloatArray, active: NDArray[np.bool_]) -> None:
        """Take whether to merge, 1 or 0, (K,), where an episode runs."""
        known = (wishes == MERGE) | (wishes == STAY)
        self._wishes = np.where(active & known, wishes == MERGE, NO_WISH).astype(np.int8)
        for corridor in np.flatnonzero(active & ~known).tolist():
            wrong = f"wishes {wishes[corridor]} instead of 1 or 0, to merge or not"
            self._wrong.setdefault(corridor, wrong)

    def parameters(self) -> Mapping[str, float]:
        """Return the parameters of the object."""
        return self._parameters.present(self._object)

    def reason(self, corridor: int) -> str | None:
        """Return what went wrong in a corridor."""
        return self._wrong.get(corridor) or self._raised

    def close(self) -> None:
        """Call `close`, if there is one."""
        closed(self._deadline.deadline_s, lambda: _close(self._object))


@dataclass(frozen=True, slots=True)
class SeenBatch:
    """What a batched VUT sees: like `Seen`, with arrays over the K corridors, (K,).

    In a corridor that is not `active` the numbers mean nothing. The arrays are copies. Of all cars
    of the mainline, the one in front first, `x_others_m` and `v_others_mps` are (cars, K). Where
    there is no acceleration lane `lane_begin_m` and `lane_end_m` are 0.
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

    @property
    def may_merge(self) -> NDArray[np.bool_]:
        """Whether a wish to merge, now, puts the VUT on the mainline in the next step, (K,)."""
        has_lane = self.lane_begin_m < self.lane_end_m
        next_m = self.x_vut_m + self.v_vut_mps * DT_S
        may: NDArray[np.bool_] = has_lane & ~self.merged & (next_m >= self.lane_begin_m)
        return may


def _batch(scene: Scene, lanes_m: FloatArray) -> SeenBatch:
    """Return what a VUT sees of a scene; the lanes, (2, K), begin and end there."""
    x_m, v_mps = np.delete(scene.x_m, VUT, axis=0), np.delete(scene.v_mps, VUT, axis=0)
    order = np.argsort(-x_m, axis=0, kind="stable")
    begin_m, end_m = lanes_m.copy()
    merged = scene.x_vut_m >= 0.0
    if scene.merged is not None:
        merged = np.where(begin_m < end_m, scene.merged, merged)
    return SeenBatch(
        active=scene.active.copy(),
        t_s=np.round(scene.step * DT_S, 1),
        x_pov_m=scene.x_pov_m.copy(),
        v_pov_mps=scene.v_pov_mps.copy(),
        x_vut_m=scene.x_vut_m.copy(),
        v_vut_mps=scene.v_vut_mps.copy(),
        x_others_m=np.take_along_axis(x_m, order, axis=0),
        v_others_mps=np.take_along_axis(v_mps, order, axis=0),
        lane_begin_m=begin_m,
        lane_end_m=end_m,
        merged=merged,
    )


def _close(thing: Any) -> None:
    """Call `close` of an object that has it."""
    if getattr(thing, "close", None) is not None:
        thing.close()


def _reset(reset: Callable[..., Any], *arguments: Any, seed: int) -> None:
    """Call a reset, with the seed of the episode where it takes one."""
    if takes_seed(reset):
        reset(*arguments, seed=seed)
    else:
        reset(*arguments)


def _module_of(source: str) -> ModuleType:
    """Return the module of a file or of a name; `UserError` where it cannot be loaded."""
    is_file = source.endswith(".py")
    # A program does not look for modules in the folder where it is started; a person does.
    if not is_file and str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))
    try:
        if is_file:
            return module_of_file(Path(source))
        found = importlib.util.find_spec(source.partition(".")[0])
        if found is not None and found.has_location and found.origin is not None:
            check_code(Path(found.origin))
        return importlib.import_module(source)
    except UserError:
        raise
    except (Exception, SystemExit) as error:
        if is_file and isinstance(error, OSError):
            raise UserError(f"cannot read the VUT {source}: {error.strerror}") from error
        raise UserError(_cannot_load(source, error)) from error


def _cannot_load(what: str, error: BaseException) -> str:
    return f"cannot load the VUT {what}: {type(error).__name__}: {text_of(error)}"
