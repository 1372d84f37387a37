"""Controllers: their observation, their answers, and an array of them that drives all corridors."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Self

import msgspec
import numpy as np

from merge_sumo.controllers.deadline import Deadline, close_within, text_of
from merge_sumo.drivers.base import MERGE, NO_REQUEST, STAY, Driver, Scene
from merge_sumo.drivers.car_following import conflicting_car
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S, POV, VUT, Bounds
from merge_sumo.scenario.signals import StepSignals


class Car(NamedTuple):
    """A car on the mainline.

    Attributes:
        x_m: position of its front bumper along the lane, in m; 0 at M, negative before M.
        v_mps: speed, in m/s.
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
    """The observation of a controller at a step: the state of the road.

    It does not contain the level and the psi of the POV. A controller that drives a POV (`--pov`)
    sees its own vehicle as the VUT, and the VUT as the POV.

    In traffic the conflicting car counts as the POV. merge-sumo assumes that each car keeps its
    speed, and that the VUT drives the level-0 profile of the scenario. The conflicting car is then
    the car nearest to M when the VUT reaches M. `others` has all cars.

    On a road with an acceleration lane, the lane begins at `lane_begin_m` and ends at `lane_end_m`,
    and M is where a merge is expected. Without a lane both are 0, and the VUT merges at M.

    Example:
        ```python
        def act(seen: Seen) -> float:
            return 1.0 if seen.x_vut_m > seen.x_pov_m else -1.0
        ```

    Attributes:
        t_s: time since the beginning of the episode, in s.
        x_pov_m: position of the POV's front bumper, in m; 0 at M, negative before M.
        v_pov_mps: speed of the POV, in m/s.
        x_vut_m: position of the VUT's front bumper, in m; 0 at M, negative before M.
        v_vut_mps: speed of the VUT, in m/s.
    """

    _traffic: tuple[Car, ...] = ()
    _lane_m: Bounds = 0.0, 0.0
    _merged: bool = False

    @property
    def others(self) -> tuple[Car, ...]:
        """All cars on the mainline, the first one ahead."""
        if not self._traffic:
            return (Car(self.x_pov_m, self.v_pov_mps),)
        cars = list(self._traffic)
        del cars[VUT]
        return tuple(sorted(cars, reverse=True))

    @property
    def lane_begin_m(self) -> float:
        """Position where the acceleration lane begins, in m; 0 without a lane."""
        return self._lane_m[0]

    @property
    def lane_end_m(self) -> float:
        """Position where the acceleration lane ends, in m; 0 without a lane."""
        return self._lane_m[1]

    @property
    def merged(self) -> bool:
        """Whether the VUT is on the mainline; without an acceleration lane, whether it is at M."""
        return self._merged if self.lane_begin_m < self.lane_end_m else self.x_vut_m >= 0.0

    @property
    def may_merge(self) -> bool:
        """Whether a merge request at this step moves the VUT to the mainline in the next step.

        False after the merge, and without an acceleration lane.
        """
        next_m = self.x_vut_m + self.v_vut_mps * DT_S
        is_on_lane = self.lane_begin_m < self.lane_end_m and not self._merged
        return is_on_lane and next_m >= self.lane_begin_m


def seen_in(
    t_s: float,
    conflicting: int,
    x_m: Sequence[float],
    v_mps: Sequence[float],
    lane_m: Bounds | None = None,
    *,
    merged: bool = False,
) -> Seen:
    """Return the observation of a VUT in a corridor.

    Args:
        t_s: time since the episode began.
        conflicting: row of the car that counts as POV.
        x_m: positions by row.
        v_mps: speeds by row.
        lane_m: acceleration lane, None without one.
        merged: whether the VUT has left that lane.
    """
    seen = Seen(t_s, x_m[conflicting], v_mps[conflicting], x_m[VUT], v_mps[VUT])
    if lane_m is not None:
        seen._lane_m, seen._merged = lane_m, merged
    if len(x_m) > 2:
        seen._traffic = tuple(map(Car, x_m, v_mps))
    return seen


class Start(msgspec.Struct, array_like=True, frozen=True):
    """First observation of an episode; level and orientation of the POV are hidden.

    Attributes:
        seed: seed of the episode, for controllers that draw random numbers.
        a_min_mps2: least acceleration of the scenario.
        a_max_mps2: largest acceleration of the scenario.
        lane_m: acceleration lane, None without one.
        conflicting: row of the car that counts as POV.
        x_m: positions by row.
        v_mps: speeds by row.
    """

    seed: int
    a_min_mps2: float
    a_max_mps2: float
    lane_m: tuple[float, float] | None
    conflicting: int
    x_m: tuple[float, ...]
    v_mps: tuple[float, ...]

    @classmethod
    def of(cls, case: Case) -> Self:
        """Return the start of a case.

        Args:
            case: the case.
        """
        scenario = case.scenario
        x_m, v_mps = np.array(case.starts(), dtype=np.float64).T
        conflicting = POV
        if len(x_m) > 2:
            conflicting = int(conflicting_car(x_m[:, None], v_mps[:, None], scenario)[0])
        return cls(
            seed=case.controller_seed,
            a_min_mps2=scenario.a_min_mps2,
            a_max_mps2=scenario.a_max_mps2,
            lane_m=scenario.lane_m,
            conflicting=conflicting,
            x_m=tuple(x_m.tolist()),
            v_mps=tuple(v_mps.tolist()),
        )

    @property
    def seen(self) -> Seen:
        """The controller's observation at the start."""
        return seen_in(0.0, self.conflicting, self.x_m, self.v_mps, self.lane_m)


class Controller:
    """Drives the vehicle of one corridor, one episode after another; subclasses implement `act`.

    Example:
        ```python
        class Steady(Controller):
            def act(self, seen: Seen) -> float:
                return 0.0
        ```

    Attributes:
        single_use: whether it drives one episode only, and a new one drives the next.
    """

    single_use: bool = False

    def reset(self, start: Start) -> None:
        """Begin an episode.

        Args:
            start: its first observation.
        """

    def act(self, seen: Seen) -> Any:
        """Return the acceleration for the next step, m/s2, or (acceleration, whether to merge).

        Args:
            seen: the observation at this step.
        """
        raise NotImplementedError

    def signals(self) -> StepSignals:
        """Return the signals of the last answer."""
        return {}

    def parameters(self) -> Mapping[str, float]:
        """Return the numbers that a spec may set, by name, with their present values."""
        return {}

    def close(self) -> None:
        """Release files, processes and memory of the controller."""


class ControllerDriver(Driver):
    """A driver that is told only the `Start` of an episode, so it can run in another process."""

    def __init__(self, corridors: int) -> None:
        """Prepare for corridors 0 to `corridors` - 1.

        Args:
            corridors: number of corridors.
        """
        super().__init__(corridors)
        self._reasons: dict[int, str] = {}
        """Errors of controllers by corridor."""
        self._signals: dict[int, StepSignals] = {}

    def reason(self, corridor: int) -> str | None:
        """Return the error of the controller of a corridor; None without one.

        Args:
            corridor: index of the corridor.
        """
        return self._reasons.get(corridor)

    def signals(self) -> Mapping[int, StepSignals]:
        """Return the signals of the last answers, by corridor."""
        return self._signals

    def begin(self, corridor: int, case: Case) -> None:
        """Begin an episode of a case.

        Args:
            corridor: index of the corridor.
            case: the case.
        """
        self.reset(corridor, Start.of(case))

    @abstractmethod
    def reset(self, corridor: int, start: Start) -> None:
        """Begin an episode in a corridor.

        Args:
            corridor: index of the corridor.
            start: first observation of the episode.
        """


class ControllerArray(ControllerDriver):
    """Drives each corridor by a controller of its own.

    Here a fault of a controller begins its way to the record. A call that raises, is late, or
    answers no acceleration ends with NaN as the answer of its corridor, and `reason` has the error
    in words. In a child process `child_main._Host` sends both, and `hosted.HostedDriver` gives both
    to the parent. `Rollout.note_faults` finds the NaN, asks for the reason, and ends that episode
    alone as `End.VUT_ERROR`. The words are the `error` of the trajectory, of the outcome, and of
    its line in `outcomes.jsonl`. The next episode in the corridor has a new controller. One that
    itself answers NaN or infinity is not replaced, and has no reason: `Rollout.note_faults` writes
    "answered nan". A crash of the child process takes another way: see `HostedDriver`.
    """

    def __init__(self, corridors: int, new: Callable[[], Controller], deadline_s: float) -> None:
        """Create a controller for each corridor.

        Args:
            corridors: number of corridors.
            new: creates a controller.
            deadline_s: time for one call.
        """
        super().__init__(corridors)
        self._new, self._deadline = new, Deadline(deadline_s)
        self._controllers: list[Controller] = []
        self._replace = [False] * corridors
        self._lanes_m: list[Bounds | None] = [None] * corridors
        for _ in range(corridors):
            self._controllers.append(new())

    def reset(self, corridor: int, start: Start) -> None:
        """Reset the controller of a corridor; an error is kept as the reason of its answer.

        Args:
            corridor: index of the corridor.
            start: first observation of the episode.
        """
        self._reasons.pop(corridor, None)
        self._lanes_m[corridor] = start.lane_m
        is_new = self._replace[corridor]
        if is_new:
            self._close(corridor)
        try:
            with self._deadline as deadline:
                deadline.start()
                if is_new:
                    self._controllers[corridor] = self._new()
                controller = self._controllers[corridor]
                self._replace[corridor] = controller.single_use
                controller.reset(start)
                deadline.stop()
        except BaseException as error:
            self._fail(corridor, f"reset: {self._deadline.reason(error)}")

    def act(self, scene: Scene) -> FloatArray:
        """Return the answers of the controllers, (K,), m/s2; NaN where there is a reason.

        Args:
            scene: the state of all corridors.
        """
        self._signals = {}
        answers, merge_requests = [0.0] * self.corridors, [NO_REQUEST] * self.corridors
        conflicting, merged = [POV] * self.corridors, [False] * self.corridors
        if scene.conflicting is not None:
            conflicting = scene.conflicting.tolist()
        if scene.merged is not None:
            merged = scene.merged.tolist()
        # Items of lists are read faster than those of arrays.
        steps, x_m, v_mps = scene.step.tolist(), scene.x_m.T.tolist(), scene.v_mps.T.tolist()
        with self._deadline as deadline:
            for k in np.flatnonzero(scene.active).tolist():
                answers[k] = math.nan
                if k in self._reasons:
                    continue
                try:
                    controller, t_s = self._controllers[k], round(steps[k] * DT_S, 1)
                    row, lane_m = conflicting[k], self._lanes_m[k]
                    seen = seen_in(t_s, row, x_m[k], v_mps[k], lane_m, merged=merged[k])
                    deadline.start()
                    answer = as_answer(controller.act(seen))
                    signals = controller.signals()
                    deadline.stop()
                    answers[k], merge_requests[k] = answer
                    if signals:
                        self._signals[k] = signals
                except BaseException as error:
                    self._fail(k, deadline.reason(error))
        chooses = merge_requests.count(NO_REQUEST) < self.corridors
        self._merge_requests = np.array(merge_requests, dtype=np.int8) if chooses else None
        return np.array(answers)

    def parameters(self) -> Mapping[str, float]:
        """Return the parameters of the first controller."""
        return self._controllers[0].parameters()

    def close(self) -> None:
        """Close the controllers; their errors are printed."""
        for corridor in range(len(self._controllers)):
            self._close(corridor)

    def _close(self, corridor: int) -> None:
        close_within(self._deadline.deadline_s, self._controllers[corridor].close)

    def _fail(self, corridor: int, reason: str) -> None:
        self._reasons[corridor], self._replace[corridor] = reason, True


class WrongAnswerError(Exception):
    """The answer of a controller is not an acceleration, or its merge request not a truth value."""


def as_answer(answer: Any) -> tuple[float, int]:
    """Return an answer as an acceleration, m/s2, and a merge request.

    Args:
        answer: one real number, or (number, whether to merge).

    Returns:
        The acceleration, and `MERGE`, `STAY`, or `NO_REQUEST` for one number.

    Raises:
        WrongAnswerError: for another answer.
    """
    if type(answer) is float:
        return answer, NO_REQUEST
    acceleration, request = answer, NO_REQUEST
    if isinstance(answer, tuple | list) and len(answer) == 2:
        acceleration, merge = answer
        request = _as_merge_request(merge)
    number = np.asarray(acceleration)
    if number.shape != () or number.dtype.kind not in "fiu":
        shown = _shown(acceleration)
        raise WrongAnswerError(f"answered {shown} instead of a number or (number, merge)")
    return float(number), request


def _as_merge_request(merge: Any) -> int:
    request = np.asarray(merge)
    if request.shape != () or request.dtype.kind not in "bfiu" or request not in (0, 1):
        shown = _shown(merge)
        raise WrongAnswerError(f"requested the merge with {shown} instead of True or False")
    return MERGE if request else STAY


MERGES_ABOVE = 0.5
"""An output of a network or a unit above this is a merge request."""


def as_merge(number: float) -> bool:
    """Return whether an output is a merge request.

    Args:
        number: the output; a request above 0.5.

    Raises:
        WrongAnswerError: for NaN and infinity.
    """
    if not math.isfinite(number):
        raise WrongAnswerError(f"requested the merge with {number} instead of a number")
    return number > MERGES_ABOVE


def _shown(answer: Any) -> str:
    return f"{text_of(answer, repr)[:60]} ({type(answer).__name__})"
