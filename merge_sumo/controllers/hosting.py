"""A user's controller in a process of its own, so that its faults end no other process.

Each step is a request to that process and its reply. A process that dies, or does not reply in
time, is killed; the running episodes begin again one by one (`simulation/rollout.py`), so that a
second death is that of one case.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from merge_sumo.controllers.controller import ControllerDriver, Start
from merge_sumo.controllers.host import HostReply, HostRequest, decode_reply, encode
from merge_sumo.controllers.process import BROKEN, ChildProcess, ProcessDiedError
from merge_sumo.controllers.spec import ControllerKind, ControllerOptions, ControllerSpec
from merge_sumo.drivers.base import ControllerDiedError, Driver, Scene
from merge_sumo.errors import ControllerError, UserError
from merge_sumo.files import ScratchFolder
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.signals import StepSignals, as_signals

SUPPORTED = os.name == "posix"
"""Elsewhere a controller runs in this process."""
GRACE = 1.5
GRACE_S = 1.25
"""The process is killed after GRACE deadlines and GRACE_S seconds: by then it should have ended the
call by itself."""


class ControllerProcess(ChildProcess):
    """The process of a controller, which is loaded in it.

    Attributes:
        loaded: properties of the controller.
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
        self._patience_s = GRACE * options.deadline_s + GRACE_S
        self._late = f"took longer than the deadline of {options.deadline_s:g} s"
        settings = {
            "kind": f"{kind.__module__}:{kind.__qualname__}",
            "spec": msgspec.to_builtins(spec),
            "deadline_s": options.deadline_s,
            "memory_gib": options.memory_gib,
        }
        # A process that is killed leaves its temporary files: they are in a folder of ours.
        folder = ScratchFolder()
        # The order of sets must not be another one in each run.
        environment = {**os.environ, "PYTHONHASHSEED": "0", "TMPDIR": folder.name}
        super().__init__(
            "merge_sumo.controllers.host:main", settings, folder, environment, log=options.log
        )
        self.loaded = self._opened()

    def make(self, corridors: int) -> HostReply:
        """Make the controllers of some corridors; raises as the constructor does."""
        self.send(encode(HostRequest("make", corridors=corridors)))
        return self._opened()

    def request(self, request: HostRequest) -> HostReply:
        """Return the reply to another request.

        Raises:
            ProcessDiedError: if there is none in time, or it is invalid; the process is killed.
            UserError: if the request failed, for the controller's reason.
        """
        self.send(encode(request))
        return self._reply(self._patience_s, self._late)

    def close(self) -> None:
        """Let the controllers close, then end the process."""
        if self.alive:
            with suppress(ProcessDiedError, UserError):
                self.request(HostRequest("close"))
                self.exit_code()
        self.kill()

    def _opened(self) -> HostReply:
        """Return the reply when the controller is loaded or made."""
        try:
            return self._reply(self._connect_s, f"took longer than {self._connect_s:g} s")
        except ProcessDiedError as died:
            line = self.output.last_line()
            printed = f" (it printed: {line})" if line else ""
            reason = f"opening the VUT {self._spec} {died}{printed}: look into the VUT"
            raise ProcessDiedError(reason, hung=died.hung) from died

    def _reply(self, patience_s: float, late: str) -> HostReply:
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
    """A controller whose code runs in a process of its own; the first driver takes that process."""

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
            loaded: its properties.

        Raises:
            UserError: if it cannot be loaded.
        """
        super().__init__(spec, options)
        self._kind = kind
        self.no_parameters = kind.no_parameters
        self._process: ControllerProcess | None = None
        if loaded is None:
            self._process = self.process()
            loaded = self._process.loaded
        self._loaded = loaded
        self.max_corridors, self.max_workers = loaded.max_corridors, kind.max_workers
        self.code = paths_of(loaded)

    def __reduce__(self) -> tuple[Callable[..., ControllerKind], tuple[Any, ...]]:
        """Travel without the process."""
        load, arguments = super().__reduce__()
        return load, (*arguments, self._kind, self._loaded)

    def _changed(self, spec: ControllerSpec, options: ControllerOptions) -> HostedKind:
        other = HostedKind(spec, options, self._kind, self._loaded)
        other.files = self.files
        if spec == self.spec and self._process is not None:
            other._process, self._process = self._process, None
            other._process.output.log = options.log
        return other

    def driver(self, corridors: int, _simulation: object) -> Driver:
        """Return a driver that asks the process."""
        return HostedDriver(corridors, self)

    def process(self, *, again: bool = True) -> ControllerProcess:
        """Return the process in which the controller is loaded, or a new one.

        Args:
            again: whether it is started again if it dies, as it may have been killed from outside.

        Raises:
            UserError: if there is none.
        """
        if self._process is not None:
            process, self._process = self._process, None
            return process
        try:
            return ControllerProcess(self.spec, self.options, self._kind)
        except ProcessDiedError as died:
            if again and not died.hung:
                return self.process(again=False)
            raise ControllerError(str(died)) from died

    def release(self) -> None:
        """End a process that no driver has taken."""
        self._process = None


class HostedDriver(ControllerDriver):
    """Passes each step on to the process of a controller."""

    def __init__(self, corridors: int, kind: HostedKind) -> None:
        """Make the controllers in their process; `UserError` where that fails."""
        super().__init__(corridors)
        self._kind = kind
        self._starts: list[tuple[int, Start]] = []
        self._reply = HostReply()
        self._files: set[Path] = set()
        self._process = self._opened()

    def reset(self, corridor: int, start: Start) -> None:
        """Note that an episode begins; the next request has its start."""
        self._starts.append((corridor, start))

    def act(self, scene: Scene) -> FloatArray:
        """Return the answers of the controllers; NaN where there is a reason.

        Raises `ControllerDiedError` where the process died.
        """
        request = HostRequest("act", starts=self._starts, scene=scene)
        self._starts = []
        try:
            if not self._process.alive:
                self._process = self._opened()
        except UserError as error:  # its files have changed since
            reason = f"started again: {error}"
            self._reply = HostReply(reasons=dict.fromkeys(range(self.corridors), reason))
            return np.full(self.corridors, np.nan)
        try:
            self._reply = reply = self._process.request(request)
        except (ProcessDiedError, UserError) as error:
            raise ControllerDiedError(str(error)) from None
        self._files.update(paths_of(reply))
        answers, merge_requests = np.array(reply.accelerations_mps2), reply.merge_requests
        self._merge_requests = (
            None if merge_requests is None else np.array(merge_requests, dtype=np.int8)
        )
        if (
            not len(answers)
            == self.corridors
            == len(answers if merge_requests is None else merge_requests)
        ):
            self._process.kill()
            raise ControllerDiedError(BROKEN)
        return answers

    def signals(self) -> Mapping[int, StepSignals]:
        """Return the signals of the last answers, by corridor."""
        signals: dict[int, StepSignals] = {}
        for corridor, left in self._reply.signals.items():
            signals[corridor] = as_signals(left)
        return signals

    def parameters(self) -> Mapping[str, float]:
        """Return the parameters of the controller, as they were when it was made."""
        return self._parameters

    def reason(self, corridor: int) -> str | None:
        """Return the error of the controller of a corridor."""
        return self._reply.reasons.get(corridor)

    def files(self) -> tuple[Path, ...]:
        """Return the files of code that were loaded so far."""
        return tuple(sorted(self._files))

    def close(self) -> None:
        """Close the controllers, and end their process."""
        self._process.close()

    def _opened(self) -> ControllerProcess:
        """Return a process in which the controllers are made."""
        process = self._kind.process()
        self._files.update(paths_of(process.loaded))
        try:
            self._parameters = process.make(self.corridors).parameters
        except ProcessDiedError as died:
            raise ControllerError(str(died)) from died
        return process


def paths_of(reply: HostReply) -> tuple[Path, ...]:
    """Return the files of a reply."""
    return tuple(map(Path, map(os.fsdecode, reply.files)))
