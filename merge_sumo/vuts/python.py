"""A VUT in Python: a class, a plain function, or a class that acts in all corridors at once."""

from __future__ import annotations

import copy
import importlib
import importlib.util
import inspect
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.base import MERGE, NO_WISH, STAY, Driver, Scene, VutLostError
from merge_sumo.errors import UserError
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S, VUT, lane_of
from merge_sumo.scenario.signals import as_signals
from merge_sumo.system.registry import entries_of
from merge_sumo.system.source_files import module_of_file
from merge_sumo.system.trust import check_code
from merge_sumo.vuts.base import (
    Deadline,
    PerCorridor,
    Seen,
    Vut,
    VutKind,
    VutOptions,
    VutSpec,
    WrongAnswerError,
    seen_at_start,
    text_of,
)
from merge_sumo.vuts.blame_cell import ALL_CORRIDORS, NO_CORRIDOR, current_call
from merge_sumo.vuts.parameters import Parameters
from merge_sumo.vuts.signatures import check_call, check_methods, fits, takes_seed

GROUP: Final = "merge_sumo.vuts"
"""Entry points of this group are VUTs by their name."""


def installed_vuts() -> dict[str, EntryPoint]:
    """Return the VUTs that installed packages register, by name."""
    return {name: entry for name, found in entries_of(GROUP).items() for entry in found.values()}


def installed_vut(spec: VutSpec, options: VutOptions) -> Vut:
    """Return the VUT that an installed package registers; `UserError` when it cannot be loaded."""
    try:
        target = installed_vuts()[spec.argument].load()
    except (Exception, SystemExit) as error:
        raise UserError(_cannot_load(spec.argument, error)) from error
    module = sys.modules.get(getattr(target, "__module__", ""))
    return _named_vut(target, spec, module, options)


def python_vut(spec: VutSpec, options: VutOptions) -> Vut:
    """Return the VUT `module:Name` or `file.py:Name`; `UserError` when it cannot be loaded."""
    source, _, name = spec.argument.rpartition(":")
    module = _module_of(source)
    target: Any = module
    for part in name.split("."):
        target = getattr(target, part, None)
    if target is None:
        raise UserError(f"{source} has no {name!r}: name a class or a function of it")
    return _named_vut(target, spec, module, options)


def _named_vut(target: Any, spec: VutSpec, module: ModuleType | None, options: VutOptions) -> Vut:
    vut = vut_of(target, spec, options, spec.numbers()) if is_code(target) else None
    if vut is None:
        raise UserError(
            f"{spec} is {text_of(target, repr)[:80]}: a VUT is a class with `act(self, seen)`, a "
            "class with `act_batch(self, seen)`, or a function `f(seen)`"
        )
    file = getattr(module, "__file__", None)
    return replace(vut, files=(Path(file),) if file else ())


def is_code(target: Any) -> bool:
    """Return whether something is a class or a function, and no other object."""
    return isinstance(target, type) or inspect.isroutine(target)


def vut_of(
    target: Any, spec: VutSpec, options: VutOptions, given: Mapping[str, float]
) -> Vut | None:
    """Return the VUT that a class, a function or an object makes; None where it makes none.

    Each corridor has an object of its own: a new one of a class, a copy of an object. One that acts
    in all corridors at once is not copied, unless parameters are `given`. Raises `UserError` where
    a method or a function cannot be called as VUTs are, or has no such parameter.
    """
    if inspect.isroutine(target):
        check_call(target, ("seen",))
    else:
        check_methods(target)
    is_class = isinstance(target, type)
    batched, acts = (callable(getattr(target, method, None)) for method in ("act_batch", "act"))
    if not (batched or acts or (not is_class and callable(target) and fits(target, 1))):
        return None
    parameters = Parameters(target, spec, given, in_order=int(not is_class or batched))

    def make(corridors: int, _world: object) -> Driver:
        def new(*arguments: int) -> Any:
            if is_class:
                made = _made(target, spec, *arguments, **parameters.keywords)
                return parameters.set_in(made)
            if inspect.isroutine(target):
                return parameters.bound(target)
            return parameters.set_in(target if batched and not given else _copied(target, spec))

        if batched:
            return BatchedVut(corridors, lambda: new(corridors), options.deadline_s, parameters)
        return PythonVut(corridors, new, options.deadline_s, parameters, acts=acts)

    return Vut(make=make)


class PythonVut(PerCorridor):
    """Drives by one object per corridor, with `act(seen)` or called itself.

    An object with `reset(seen)`, or `reset(seen, seed)`, drives one episode after the other in its
    corridor. One without is never told that an episode begins, so each episode has a new one; a
    function has nothing to begin anew. `close()` is called in the end where an object has it.
    """

    def __init__(
        self,
        corridors: int,
        new: Callable[[], Any],
        deadline_s: float,
        parameters: Parameters,
        *,
        acts: bool,
    ) -> None:
        """Make an object for each corridor by `new`; `acts` says whether it has `act`."""
        super().__init__(corridors, deadline_s)
        self._new, self._parameters, self._acts = new, parameters, acts
        self._objects: list[Any] = [None] * corridors
        for corridor in range(corridors):
            self.renew(corridor)

    def renew(self, corridor: int) -> None:
        """Replace the object of a corridor."""
        _close(self._objects[corridor], self._deadline.deadline_s)
        self._objects[corridor] = self._new()

    def reset(self, corridor: int, seen: Seen) -> None:
        """Call `reset`; an object without is replaced before the next episode."""
        vut = self._objects[corridor]
        if getattr(vut, "reset", None) is not None:
            _reset(vut.reset, seen, seed=self.seed)
        elif not inspect.isroutine(vut):
            self.renewal = "made anew for this episode, as it has no `reset`"
            self.renew_first[corridor] = True

    def answer(self, corridor: int, seen: Seen) -> Any:
        """Ask the object, and keep the `signals` that it leaves as an attribute."""
        vut = self._objects[corridor]
        answer = vut.act(seen) if self._acts else vut(seen)
        left = getattr(vut, "signals", None)
        if left is not None:
            self._signals[corridor] = as_signals(left)
        return answer

    def parameters(self) -> Mapping[str, float]:
        """Return the parameters of the first object."""
        return self._parameters.present(self._objects[0])

    def close(self) -> None:
        """Call `close` of every object that has it; what it raises is printed."""
        for vut in self._objects:
            _close(vut, self._deadline.deadline_s)


class BatchedVut(Driver):
    """Drives by one object that acts in all corridors at once.

    It is made with the number of corridors K, has `act_batch(seen)`, which returns K
    accelerations, (K,), or these and whether to merge, (2, K), and perhaps `reset(corridor, seen)`,
    or `reset(corridor, seen, seed)`, and `close()`.
    """

    def __init__(
        self,
        corridors: int,
        make: Callable[[], Any],
        deadline_s: float,
        parameters: Parameters,
    ) -> None:
        super().__init__(corridors)
        self._deadline = Deadline(deadline_s)
        self._make, self._parameters = make, parameters
        self._object = make()
        self._renew_first = False
        self._raised: str | None = None
        self._wrong: dict[int, str] = {}
        """What is wrong in a corridor alone: its reset raised something, or its wish is none."""
        self._lanes_m = np.zeros((2, corridors))

    def begin(self, corridor: int, case: Case) -> None:
        """Call `reset`, if there is one; an error is kept as the reason of the answer.

        After an act that failed all episodes begin, and the object is made anew for the first.
        """
        self._wrong.pop(corridor, None)
        self._lanes_m[:, corridor] = lane_of(case.scenario) or (0.0, 0.0)
        try:
            with self._deadline as deadline:
                if self._renew_first:
                    self._object = deadline.call(corridor, self._make)
                    self._renew_first = False
                reset = getattr(self._object, "reset", None)
                if reset is not None:
                    begun = seen_at_start(case)
                    again = partial(_reset, reset, seed=case.told_seed)
                    deadline.call(corridor, again, corridor, begun)
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
                answer = np.asarray(deadline.call(ALL_CORRIDORS, self._object.act_batch, seen))
            if answer.shape not in ((k,), (2, k)) or answer.dtype.kind not in "fiu":
                raise WrongAnswerError(
                    f"answered shape {answer.shape} of {answer.dtype} instead of {k} numbers, or "
                    f"these and {k} wishes"
                )
        except BaseException as error:
            self._raised = self._deadline.reason(error)
            self._renew_first = True
            if scene.active.sum() > 1:
                raise VutLostError(self._raised, final=True) from None
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
        _close(self._object, self._deadline.deadline_s)


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


def _made(target: type, spec: VutSpec, *arguments: int, **keywords: float) -> Any:
    current_call.note(NO_CORRIDOR)  # it goes on: each object may take its time
    try:
        return target(*arguments, **keywords)
    except (Exception, SystemExit) as error:
        given = f" with {arguments[0]} corridors" if arguments else " without arguments"
        what = f"{type(error).__name__}: {text_of(error)}"
        raise UserError(f"{spec} cannot be made{given}: {what}") from error


def _reset(reset: Callable[..., Any], *arguments: Any, seed: int) -> None:
    """Call a reset, with the seed of the episode where it takes one."""
    if takes_seed(reset):
        reset(*arguments, seed=seed)
    else:
        reset(*arguments)


def _copied(target: Any, spec: VutSpec) -> Any:
    """Return a copy of an object as it was given, so that no episode changes that of another."""
    try:
        return copy.deepcopy(target)
    except Exception as error:
        raise UserError(
            f"{spec} cannot be copied for the episodes that run at a time ({text_of(error)}): give "
            "its class, or a function that makes no difference between them"
        ) from error


def _close(vut: Any, deadline_s: float) -> None:
    """Call `close`, if there is one; what it raises comes too late to matter, and is printed."""
    if vut is None:
        return
    deadline = Deadline(deadline_s)  # of its own: this may be part of another call
    try:
        with deadline:
            if getattr(vut, "close", None) is not None:
                deadline.call(NO_CORRIDOR, vut.close)
    except BaseException as error:
        sys.stderr.write(f"closing the VUT: {deadline.reason(error)}\n")


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


def _file_of(argument: str) -> str:
    source = argument.rpartition(":")[0]
    return source if source.endswith(".py") else ""


KIND: Final = VutKind(
    form="MODULE:NAME[?PARAMETER=VALUE&...] or FILE.py:NAME",
    what="a class with act(seen), a function of seen, or a batched class",
    example="--vut my_vut.py:MyVut",
    prepare=python_vut,
    hosted=True,
    asks_sumo=False,
    file_of=_file_of,
)
INSTALLED_KIND: Final = VutKind(prepare=installed_vut, hosted=True, asks_sumo=False)
