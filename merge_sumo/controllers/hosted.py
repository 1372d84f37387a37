"""A user's controller in a child process, so that its faults end no other process.

This is the side of the parent; `child_main.py` is that of the child.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Self

import msgspec
import numpy as np

from merge_sumo.controllers.child_main import HostReply, HostRequest, decode_reply, encode
from merge_sumo.controllers.controller import ControllerDriver, Start
from merge_sumo.controllers.process import BROKEN, ChildProcess, ProcessDiedError
from merge_sumo.controllers.spec import ControllerKind, ControllerOptions, ControllerSpec
from merge_sumo.drivers.base import Driver, EpisodesLostError, Scene
from merge_sumo.errors import ControllerError, UserError
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.signals import valid_signals

SUPPORTED = os.name == "posix"
"""Elsewhere a controller runs in this process."""
GRACE_FACTOR = 1.5
GRACE_S = 1.25
"""The child ends a late call itself. If it has sent nothing for GRACE_FACTOR deadlines and GRACE_S
seconds, the parent kills it."""


class ControllerProcess(ChildProcess):
    """The child process of a controller, which is loaded in it.

    Attributes:
        loaded: properties of the controller: its code, and how many corridors it serves.
    """

    def __init__(
        self, spec: ControllerSpec, options: ControllerOptions, kind: type[ControllerKind]
    ) -> None:
        """Start the process and load the controller.

        Args:
            spec: the controller.
            options: how it is hosted.
            kind: its kind.

        Raises:
            ProcessDiedError: if the process ended.
            UserError: if the controller cannot be loaded.
        """
        self._spec, self._connect_s = spec, options.connect_s
        self._patience_s = GRACE_FACTOR * options.deadline_s + GRACE_S
        self._late = f"took longer than the deadline of {options.deadline_s:g} s"
        settings = {
            "kind": f"{kind.__module__}:{kind.__qualname__}",
            "spec": msgspec.to_builtins(spec),
            "deadline_s": options.deadline_s,
            "memory_gib": options.memory_gib,
        }
        # The order of sets must not be another one in each run.
        environment = {**os.environ, "PYTHONHASHSEED": "0"}
        super().__init__(
            "merge_sumo.controllers.child_main:main", settings, environment, options.log
        )
        self.loaded = self._receive_opening()

    def make(self, corridors: int) -> HostReply:
        """Make the controllers of some corridors.

        Args:
            corridors: their number.

        Raises:
            ProcessDiedError: if the process ended.
            UserError: if they cannot be made.
        """
        self.send(encode(HostRequest("make", corridors=corridors)))
        return self._receive_opening()

    def request(self, request: HostRequest) -> HostReply:
        """Return the reply to a request.

        Args:
            request: any but to make the controllers.

        Raises:
            ProcessDiedError: if none comes in time, or it is invalid; the process is killed.
            UserError: if the request failed, for the controller's reason.
        """
        self.send(encode(request))
        return self._receive_reply(self._patience_s, self._late)

    def close(self) -> None:
        """Let the controllers close, then end the process."""
        if self.alive:
            with suppress(UserError):
                self.request(HostRequest("close"))
                self.exit_code()
        self.kill()

    def _receive_opening(self) -> HostReply:
        """Return the reply when the controller is loaded or made."""
        try:
            return self._receive_reply(self._connect_s, f"took longer than {self._connect_s:g} s")
        except ProcessDiedError as died:
            line = self.output.last_line()
            printed = f" (it printed: {line})" if line else ""
            reason = f"loading the VUT {self._spec}: {died}{printed}; check its code"
            raise ProcessDiedError(reason) from died

    def _receive_reply(self, patience_s: float, late: str) -> HostReply:
        reply: HostReply | None = None
        try:
            while reply is None:
                reply = decode_reply(self.receive(patience_s, late))
        except msgspec.MsgspecError:
            self.kill()
            raise ProcessDiedError(BROKEN) from None
        if reply.is_finding:
            raise ControllerError(reply.failed)
        if reply.failed:
            raise UserError(reply.failed)
        return reply


class HostedKind(ControllerKind):
    """A controller whose code runs in a child process; the first driver takes the process."""

    asks_sumo = False

    def __init__(
        self,
        spec: ControllerSpec,
        options: ControllerOptions,
        kind: type[ControllerKind],
        loaded: HostReply | None = None,
    ) -> None:
        """Load the controller, unless its properties are known.

        Args:
            spec: the controller.
            options: how it is hosted.
            kind: its kind.
            loaded: its properties; None to start the process and load it.

        Raises:
            UserError: if it cannot be loaded.
        """
        super().__init__(spec, options)
        self._kind = kind
        self._process: ControllerProcess | None = None
        if loaded is None:
            self._process = self.process()
            loaded = self._process.loaded
        self._more = kind, loaded
        self.no_parameters, self.max_workers = kind.no_parameters, kind.max_workers
        self.max_corridors, self.code = loaded.max_corridors, paths_of(loaded)

    def with_log(self, log: Path) -> Self:
        """Return the same controller with another log, and hand the process over to it.

        Args:
            log: file to which its output is added.
        """
        other = super().with_log(log)
        other._process, self._process = self._process, None
        if other._process is not None:
            other._process.output.log = log
        return other

    def driver(self, corridors: int, _simulation: object) -> Driver:
        """Return a driver that asks the process.

        Args:
            corridors: number of corridors.
            _simulation: not used.
        """
        return HostedDriver(corridors, self)

    def process(self, *, again: bool = True) -> ControllerProcess:
        """Hand over the process in which the controller is loaded, or start a new one.

        Args:
            again: whether it is started again if it dies, as it may have been killed from outside.

        Raises:
            UserError: if the controller cannot be loaded.
        """
        if self._process is not None:
            process, self._process = self._process, None
            return process
        try:
            return ControllerProcess(self.spec, self.options, self._kind)
        except ProcessDiedError:
            if again:
                return self.process(again=False)
            raise

    def release(self) -> None:
        """End a process that no driver has taken."""
        if self._process is not None:
            self._process.kill()
        self._process = None


class HostedDriver(ControllerDriver):
    """Passes each step on to the child process of a controller.

    A process that dies, or sends nothing in time, is an `EpisodesLostError`, and so is a request
    that fails as a whole. `Rollout.begin_again` then runs the running episodes again, one at a
    time: at a second loss it is clear by which case. A process that has ended is started again with
    the next request. The error of a call is a reason of the reply: `ControllerArray` says how it
    travels.
    """

    def __init__(self, corridors: int, kind: HostedKind) -> None:
        """Make the controllers in their process.

        Args:
            corridors: number of corridors.
            kind: the controller.

        Raises:
            UserError: if they cannot be made.
        """
        super().__init__(corridors)
        self._kind = kind
        self._starts: list[tuple[int, Start]] = []
        self._files: set[Path] = set()
        self._process = self._new_process()

    def reset(self, corridor: int, start: Start) -> None:
        """Note that an episode begins; the next request has its start.

        Args:
            corridor: index of the corridor.
            start: first observation of the episode.
        """
        self._starts.append((corridor, start))

    def act(self, scene: Scene) -> FloatArray:
        """Return the answers of the controllers, (K,), m/s2; NaN where there is a reason.

        Args:
            scene: the state of all corridors.

        Raises:
            EpisodesLostError: if the process died, cannot be started again after that, or could not
                carry out the request.
        """
        request = HostRequest("act", starts=self._starts, scene=scene)
        self._starts = []
        try:
            if not self._process.alive:
                self._process = self._new_process()
            reply = self._process.request(request)
        except UserError as error:  # such as `ProcessDiedError`
            raise EpisodesLostError(str(error)) from None
        self._files.update(paths_of(reply))
        self._reasons, self._signals = reply.reasons, {}
        for corridor, left in reply.signals.items():
            self._signals[corridor] = valid_signals(left)  # the process may send any text
        answers, merge_requests = np.array(reply.accelerations_mps2), None
        if reply.merge_requests is not None:
            merge_requests = np.array(reply.merge_requests, dtype=np.int8)
        for column in (answers, merge_requests):
            if column is not None and len(column) != self.corridors:
                self._process.kill()
                raise EpisodesLostError(BROKEN)
        self._merge_requests = merge_requests
        return answers

    def parameters(self) -> Mapping[str, float]:
        """Return the parameters of the first controller, as they were when it was made."""
        return self._parameters

    def files(self) -> tuple[Path, ...]:
        """Return the files of code that were loaded so far."""
        return tuple(sorted(self._files))

    def close(self) -> None:
        """Close the controllers, and end their process."""
        self._process.close()

    def _new_process(self) -> ControllerProcess:
        """Return a process in which the controllers are made."""
        process = self._kind.process()
        self._files.update(paths_of(process.loaded))
        self._parameters = process.make(self.corridors).parameters
        return process


def paths_of(reply: HostReply) -> tuple[Path, ...]:
    """Return the files of a reply.

    Args:
        reply: a reply of the process.
    """
    return tuple(map(Path, map(os.fsdecode, reply.files)))
