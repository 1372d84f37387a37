"""Names of VUTs and what all kinds share: observation, deadline, one controller per corridor."""

from __future__ import annotations

import math
import signal
import sys
import threading
from abc import abstractmethod
from bdb import BdbQuit
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Real
from pathlib import Path
from time import perf_counter
from types import FrameType, TracebackType
from typing import Any, Final, NamedTuple, Self, TextIO

import msgspec
import numpy as np

from merge_sumo.drivers.base import MERGE, NO_WISH, STAY, Driver, Scene
from merge_sumo.drivers.following import car_met
from merge_sumo.errors import UserError
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DEADLINE_S, DT_S, MEMORY_GIB, POV, VUT, Bounds, lane_of
from merge_sumo.scenario.signals import Left
from merge_sumo.scenario.trajectory import as_reason
from merge_sumo.system.interrupt import Stopped
from merge_sumo.vuts.blame_cell import NO_CORRIDOR, current_call


@dataclass(frozen=True, kw_only=True, slots=True)
class VutOptions:
    """How a VUT is hosted; `UserError` for values out of their range."""

    deadline_s: float = DEADLINE_S  # time for one step, and for one reset
    connect_s: float = 60.0  # time for a program to start and connect
    in_process: bool = False
    """Whether a user's code runs in this process instead of one of its own: a debugger reaches
    it then, and its faults may end this process."""
    memory_gib: float = MEMORY_GIB  # memory that the process of a user's code may take
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


@dataclass(frozen=True, kw_only=True, slots=True)
class Vut:
    """A VUT that is ready to be made."""

    make: Callable[[int, object], Driver]
    """Returns the driver for a number of corridors in a world of SUMO; None for no world."""
    max_corridors: int | None = None  # corridors that one driver can serve; None for any number
    max_workers: int | None = None
    """Processes that can each have such a driver at a time; None for any number."""
    vut_type: Mapping[str, str] | None = None
    """Attributes of the SUMO vType with which SUMO itself drives; None if it does not."""
    files: tuple[Path, ...] = ()  # files of the user's that it is made of, as far as they are known
    data: tuple[Path, ...] = ()
    """Of the files those that are no code: it has read them, and may write them as it drives."""
    parameters: Mapping[str, float] | None = None
    """Numbers that its spec may set, with their present values; None where its driver has them."""
    no_pov: str = ""  # why it cannot drive a POV; "" where it can


@dataclass(frozen=True, kw_only=True, slots=True)
class VutKind:
    """A kind of VUT: all that the package asks of it."""

    form: str = ""  # what a person writes for it; "" for a kind that no list shows
    what: str = ""  # what it is, in a phrase
    example: str = ""  # an option `--vut` that names one
    prepare: Callable[[VutSpec, VutOptions], Vut]
    """Makes the VUT of a spec of this kind; raises `UserError`."""
    has_parameters: bool = True  # whether "?" ends the argument in a spec
    no_parameters: str = ""
    """Why a spec cannot set the parameters of its controller, in a clause; "" where it can."""
    hosted: bool = False
    """Whether it runs a user's code in this process, unless that is hosted in one of its own."""
    own_code: bool = True
    """Whether to test it is to run code that is neither of this package nor of SUMO."""
    files_are_known: bool = True  # whether `Vut.files` are all of which it is made before it drives
    asks_sumo: bool = True
    """Whether its drivers ask SUMO, or are SUMO's own; their cases take longer."""
    by_arrays: bool = False
    """Whether its drivers need nothing of SUMO, and take any number of corridors."""
    file_of: Callable[[str], str] = lambda _: ""
    """Returns the file of code that an argument names; "" for none."""
    waits: Callable[[str], bool] = lambda _: False
    """Returns whether the controller of an argument is a program that a person starts."""


class Car(NamedTuple):
    """A car of the mainline.

    Attributes:
        x_m: distance of its front bumper to M along its lane, negative before M.
        v_mps: its speed.
    """

    x_m: float
    v_mps: float


class _State(NamedTuple):
    t_s: float
    x_pov_m: float
    v_pov_mps: float
    x_vut_m: float
    v_vut_mps: float


class Seen(_State):
    """What a VUT sees at a step: time and state, and nothing of the POV's driver.

    A controller that drives a POV (`--pov`) sees itself as the VUT, and the VUT as the POV.

    In traffic the car that the VUT will meet counts as POV: the one that would be nearest to M when
    the VUT is there, if the car kept its speed and the VUT drove the scenario's level-0 profile
    (`drivers.following.car_met`). `others` has all cars.

    On a road with an acceleration lane the lane begins at `lane_begin_m` and ends at `lane_end_m`;
    M is where a merge is expected. Elsewhere both are 0, and the VUT merges at M.

    Attributes:
        t_s: time since the episode began.
        x_pov_m: distance of the POV's front bumper to M along its lane, negative before M.
        v_pov_mps: speed of the POV.
        x_vut_m: distance of the VUT's front bumper to M along its lane, negative before M.
        v_vut_mps: speed of the VUT.
    """

    _traffic: tuple[Car, ...] = ()
    _lane_m: Bounds | None = None
    _merged: bool = False

    @property
    def vehicles(self) -> tuple[Car, ...]:
        """All vehicles in the order of their rows: POV, VUT, and the cars ahead and behind."""
        pair = Car(self.x_pov_m, self.v_pov_mps), Car(self.x_vut_m, self.v_vut_mps)
        return self._traffic or pair

    @property
    def others(self) -> tuple[Car, ...]:
        """All cars of the mainline, the one in front first."""
        cars = (car for row, car in enumerate(self.vehicles) if row != VUT)
        return tuple(sorted(cars, reverse=True))

    @property
    def lane_begin_m(self) -> float:
        """Where the acceleration lane begins; 0 where there is none."""
        return 0.0 if self._lane_m is None else self._lane_m[0]

    @property
    def lane_end_m(self) -> float:
        """Where it ends; 0 where there is none."""
        return 0.0 if self._lane_m is None else self._lane_m[1]

    @property
    def merged(self) -> bool:
        """Whether the VUT is on the mainline; without an acceleration lane it is from M on."""
        return self.x_vut_m >= 0.0 if self._lane_m is None else self._merged

    @property
    def may_merge(self) -> bool:
        """Whether a wish to merge, now, puts the VUT on the mainline in the next step.

        False after the merge, and where there is no acceleration lane.
        """
        if self._lane_m is None or self._merged:
            return False
        return self.x_vut_m + self.v_vut_mps * DT_S >= self._lane_m[0]


def seen_in(
    t_s: float,
    met: int,
    x_m: Sequence[float],
    v_mps: Sequence[float],
    lane_m: Bounds | None = None,
    *,
    merged: bool = False,
) -> Seen:
    """Return what a VUT sees of vehicles by their rows.

    `met` is the row that counts as POV, `lane_m` the acceleration lane, None without one, and
    `merged` whether the VUT has left it.
    """
    seen = Seen(t_s, x_m[met], v_mps[met], x_m[VUT], v_mps[VUT])
    if lane_m is not None:
        seen._lane_m, seen._merged = lane_m, merged
    if len(x_m) > 2:
        seen._traffic = tuple(map(Car, x_m, v_mps))
    return seen


def seen_at_start(case: Case) -> Seen:
    """Return what a VUT sees as an episode begins; level and orientation of the POV are hidden."""
    x_m, v_mps = zip(*case.starts(), strict=True)
    met = POV
    if len(x_m) > 2:
        x, v = np.array([x_m, v_mps])[..., None]
        met = int(car_met(x, v, case.scenario.level0_a_mps2, case.scenario.level0_v_mps)[0])
    return seen_in(0.0, met, x_m, v_mps, lane_of(case.scenario))


class DeadlineExceeded(BaseException):
    """A call ran into its deadline. Not an Exception, so that a VUT does not catch it by habit."""


RING_AFTER: Final = 1.02
"""Of the deadline: when a timer rings for a call, that is too late beyond doubt."""


@dataclass(slots=True)
class Deadline:
    """Ends calls to a VUT that take longer than the deadline.

    While it is entered, a timer rings in the main thread and interrupts a call that is too late,
    and standard output of the VUT is standard error. Native code is not interrupted; neither is a
    call in another thread or on a system without such timers (Windows): it counts as too late when
    it returns.
    """

    deadline_s: float
    _since_s: float = math.inf
    _stdout: TextIO | None = None
    _restore: Callable[[], None] | None = field(default=None, repr=False)

    def __enter__(self) -> Self:
        self._stdout, sys.stdout = sys.stdout, sys.stderr
        if hasattr(signal, "setitimer") and (threading.current_thread() is threading.main_thread()):
            handler = signal.signal(signal.SIGALRM, self._ring)
            timer = signal.setitimer(signal.ITIMER_REAL, 0.0)

            def restore() -> None:
                signal.setitimer(signal.ITIMER_REAL, *timer)
                signal.signal(signal.SIGALRM, handler)

            self._restore = restore
        return self

    def __exit__(self, *_: object) -> None:
        current_call.note(NO_CORRIDOR)
        if self._restore is not None:
            self._restore()
            self._restore = None
        if self._stdout is not None:
            sys.stdout = self._stdout

    def _ring(self, _signal: int, _frame: FrameType | None) -> None:
        if perf_counter() - self._since_s > self.deadline_s:
            raise DeadlineExceeded

    def call(self, corridor: int, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return function(*arguments), called for a corridor; `DeadlineExceeded` if late."""
        current_call.note(corridor)
        if self._restore is not None:
            # Anew for each call: a ring before its deadline would cut short what waits in C.
            first_s = RING_AFTER * self.deadline_s
            signal.setitimer(signal.ITIMER_REAL, first_s, self.deadline_s / 10)
        self._since_s = start = perf_counter()
        try:
            answer = function(*arguments)
        finally:
            self._since_s = math.inf
        if perf_counter() - start > self.deadline_s:
            raise DeadlineExceeded
        return answer

    def reason(self, error: BaseException) -> str:
        """Return what a call did wrong, with file and line; raise what is no VUT's: Ctrl-C."""
        if isinstance(error, (Stopped, KeyboardInterrupt)) and not current_call.shared:
            raise error
        if isinstance(error, DeadlineExceeded):
            return self.deadline_exceeded
        if isinstance(error, BdbQuit):
            return "a debugger was left; breakpoints work with `merge-sumo run --debug`"
        name = text_of(error, lambda error: type(error).__name__)
        return f"{name}: {text_of(error)}{text_of(error, _place)}"

    @property
    def deadline_exceeded(self) -> str:
        """The reason of a call that was too late."""
        return f"took longer than the deadline of {self.deadline_s:g} s"


MOST_CHARACTERS: Final = 300
"""Of a text of a VUT's."""


def text_of(thing: object, as_text: Callable[[Any], str] = str) -> str:
    """Return the text of an object of a VUT's in one line, even where making it raises.

    A text of a subclass of `str` is taken as the characters that it has.
    """
    try:
        return as_reason(str.__str__(as_text(thing)))[:MOST_CHARACTERS]
    except Exception as error:
        return f"({type(error).__name__} when it was to be shown)"


def _place(error: BaseException) -> str:
    """Return where an error was raised, " (FILE, line N)"; "" where that was not in a VUT."""
    last: TracebackType | None = error.__traceback__
    while last is not None and last.tb_next is not None:  # a recursion leaves thousands
        last = last.tb_next
    if last is None or last.tb_frame.f_code.co_filename == __file__:
        return ""
    return f" ({Path(last.tb_frame.f_code.co_filename).name}, line {last.tb_lineno})"


class PerCorridor(Driver):
    """Calls a controller of its own in each corridor, so that corridors share no state.

    What a controller does wrong is the reason of its corridor alone; it is then made anew.

    Attributes:
        renewal: begins the reason where that fails.
        renew_first: whether the controller of a corridor is made anew before its next episode.
        seed: of the episode that begins, for controllers that draw random numbers.
    """

    renewal = "made anew"
    seed = 0

    def __init__(self, corridors: int, deadline_s: float) -> None:
        super().__init__(corridors)
        self._deadline = Deadline(deadline_s)
        self._reasons: list[str | None] = [None] * corridors
        self.renew_first = [False] * corridors
        self._signals: dict[int, Left] = {}
        self._lanes_m: list[Bounds | None] = [None] * corridors

    @abstractmethod
    def renew(self, corridor: int) -> None:
        """Make the controller of a corridor anew."""

    @abstractmethod
    def reset(self, corridor: int, seen: Seen) -> None:
        """Begin an episode for the controller of a corridor."""

    @abstractmethod
    def answer(self, corridor: int, seen: Seen) -> Any:
        """Return the acceleration in one corridor, m/s2, or it and whether to merge.

        Raises what the controller raises.
        """

    def begin(self, corridor: int, case: Case) -> None:
        """Reset the controller of a corridor; an error is kept as the reason of its answer."""
        self._reasons[corridor] = None
        self._lanes_m[corridor] = lane_of(case.scenario)
        activity = self.renewal
        try:
            with self._deadline as deadline:
                if self.renew_first[corridor]:
                    deadline.call(corridor, self.renew, corridor)
                    self.renew_first[corridor] = False
                activity, self.seed = "reset", case.told_seed
                deadline.call(corridor, self.reset, corridor, seen_at_start(case))
        except BaseException as error:
            self._fault(corridor, f"{activity}: {self._deadline.reason(error)}")

    def act(self, scene: Scene) -> FloatArray:
        """Return the answers of the controllers; NaN where there is a reason."""
        self._signals, self._wishes = {}, None
        answers = [0.0] * self.corridors
        wishes: dict[int, int] = {}
        met = [POV] * self.corridors if scene.facing is None else scene.facing.tolist()
        merged = [False] * self.corridors if scene.merged is None else scene.merged.tolist()
        rows = (scene.active, scene.step, scene.x_m.T, scene.v_mps.T)
        states = zip(*(row.tolist() for row in rows), met, strict=True)
        with self._deadline as deadline:
            for k, (active, step, x_m, v_mps, row) in enumerate(states):
                if not active:
                    continue
                if self._reasons[k] is not None:
                    answers[k] = math.nan
                    continue
                try:
                    t_s, lane_m = round(step * DT_S, 1), self._lanes_m[k]
                    seen = seen_in(t_s, row, x_m, v_mps, lane_m, merged=merged[k])
                    answers[k], wish = deadline.call(k, self._checked, k, seen)
                    if wish != NO_WISH:
                        wishes[k] = wish
                except BaseException as error:
                    self._fault(k, deadline.reason(error))
                    answers[k] = math.nan
        if wishes:
            self._wishes = np.full(self.corridors, NO_WISH, dtype=np.int8)
            self._wishes[list(wishes)] = list(wishes.values())
        return np.array(answers)

    def reason(self, corridor: int) -> str | None:
        """Return what the controller of a corridor did wrong."""
        return self._reasons[corridor]

    def signals(self) -> Mapping[int, Left]:
        """Return what the controllers left with their last answers, by corridor."""
        return self._signals

    def _checked(self, corridor: int, seen: Seen) -> tuple[float, int]:
        return as_answer(self.answer(corridor, seen))

    def _fault(self, corridor: int, reason: str) -> None:
        self._reasons[corridor] = reason
        self.renew_first[corridor] = True


class WrongAnswerError(Exception):
    """A VUT answered something that is no acceleration, or no wish."""


def as_answer(answer: Any) -> tuple[float, int]:
    """Return an answer as an acceleration and a wish, `NO_WISH` where it says nothing of one.

    Raises `WrongAnswerError` for what is neither one real number nor (number, whether to merge).
    """
    if isinstance(answer, tuple | list) and len(answer) == 2:
        acceleration, merge = answer
        return as_number(acceleration), as_wish(merge)
    return as_number(answer), NO_WISH


def as_number(answer: Any) -> float:
    """Return an answer as a float; raises `WrongAnswerError` for what is not one real number."""
    if type(answer) is float:
        return answer
    if isinstance(answer, (int, float, np.integer, np.floating)) and not isinstance(answer, bool):
        return float(answer)
    if isinstance(answer, np.ndarray) and answer.shape == () and answer.dtype.kind in "fiu":
        return float(answer)
    raise WrongAnswerError(f"answered {_shown(answer)} instead of a number, or (number, merge)")


def as_wish(merge: Any) -> int:
    """Return `MERGE` or `STAY`; raises `WrongAnswerError` for what is not True, False, 1 or 0."""
    value = merge.item() if isinstance(merge, np.ndarray) and merge.shape == () else merge
    is_number = isinstance(value, (bool, int, float, np.bool_, np.integer, np.floating))
    if is_number and value in (0, 1):
        return MERGE if value else STAY
    raise WrongAnswerError(f"wishes {_shown(merge)} instead of True or False, to merge or not")


MERGES_ABOVE: Final = 0.5
"""A number that says whether to merge, as of a network or a unit, wishes it above this."""


def as_merge(number: float) -> bool:
    """Return whether a number wishes to merge; raises `WrongAnswerError` for one that is none."""
    if not math.isfinite(number):
        raise WrongAnswerError(f"wishes {number} instead of a number, to merge or not")
    return number > MERGES_ABOVE


def _shown(answer: Any) -> str:
    return f"{text_of(answer, repr)[:60]} ({type(answer).__name__})"
