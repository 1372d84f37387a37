"""A user's controller in a process of its own, so that it can end nothing but itself.

Each step is a request to that process and its answer. A process that dies, or does not answer in
time, is killed; the running episodes begin again one by one (`simulation/rollout.py`), so that a
second death is that of one case.
"""

from __future__ import annotations

import multiprocessing
import os
import select
import signal
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final, TypeVar

import msgspec
import numpy as np

from merge_sumo.controllers.base import ControllerKind, VutOptions, VutSpec
from merge_sumo.controllers.controller import ControllerDriver, Start
from merge_sumo.controllers.messages import (
    MOST_BYTES,
    Act,
    Acted,
    Alive,
    Close,
    Failed,
    ListFiles,
    Loaded,
    Made,
    Make,
    Message,
    Ready,
    decode_answer,
    encode,
    packed,
)
from merge_sumo.controllers.process import Echo, Output
from merge_sumo.drivers.base import Driver, Scene, VutLostError
from merge_sumo.errors import UserError
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.signals import Left
from merge_sumo.scratch import ScratchFolder
from merge_sumo.spawning import python_command

M = TypeVar("M", bound=Message)

SUPPORTED: Final = os.name == "posix"
"""Elsewhere a controller runs in this process."""
GRACE: Final = 1.5
GRACE_S: Final = 1.25
"""The process is killed after GRACE deadlines and GRACE_S seconds: by then it should have ended the
call by itself."""
ENDING_S: Final = 2.0
"""Time to close the controllers, and to end."""


class ProcessDiedError(Exception):
    """The process of a controller ended, for a reason; `hung` if it was killed for its silence."""

    def __init__(self, reason: str, *, hung: bool = False) -> None:
        super().__init__(reason)
        self.hung = hung


class ControllerProcess:
    """The process of a controller, which is loaded in it.

    Attributes:
        spec: the controller.
        ready: what its kind knows of it.
        alive: whether requests can be sent.
        output: what it prints.
        echo: shows what it prints, where there is no log.
    """

    def __init__(self, spec: VutSpec, options: VutOptions, echo: Echo) -> None:
        """Start the process and load the controller; `UserError` where that fails.

        Args:
            spec: the controller.
            options: how it is hosted.
            echo: shows what it prints, where the options have no log.
        """
        self.spec, self._options, self.echo = spec, options, echo
        self.alive = False
        # A process that is killed leaves its temporary files: they are in a folder of ours.
        self._scratch = ScratchFolder()
        self._connection, theirs = multiprocessing.Pipe()
        their_lifeline, self._lifeline = os.pipe()
        settings = {
            "spec": msgspec.to_builtins(spec),
            "deadline_s": options.deadline_s,
            "memory_gib": options.memory_gib,
            "lifeline": their_lifeline,
            "connection": theirs.fileno(),
        }
        try:
            self._process = subprocess.Popen(
                python_command("merge_sumo.controllers.host:main", settings),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                pass_fds=(their_lifeline, theirs.fileno()),
                # The order of sets must not be another one in each run.
                env={**os.environ, "PYTHONHASHSEED": "0", "TMPDIR": self._scratch.name},
                start_new_session=True,
            )
        except OSError as error:
            self._connection.close()
            os.close(self._lifeline)
            self._scratch.cleanup()
            raise UserError(f"cannot start a process for the VUT: {error.strerror}") from error
        finally:
            theirs.close()
            os.close(their_lifeline)
        self.alive = True
        assert self._process.stdout is not None  # noqa: S101 (piped)
        self.output = Output(self._process.stdout, options.log, echo)
        self._poll = select.poll()
        self._poll.register(self._connection.fileno(), select.POLLIN)
        with self._opening():
            self.ready = self._receive(Ready, options.connect_s)

    def make(self, corridors: int) -> Mapping[str, float]:
        """Make the controllers of a number of corridors; return their parameters."""
        with self._opening():
            return self.ask(Make(corridors), Made, self._options.connect_s).parameters

    def ask(self, request: Message, kind: type[M], patience_s: float | None = None) -> M:
        """Return the answer to a request.

        Args:
            request: the request.
            kind: type of the answer.
            patience_s: time without a sign of life, by default for one call within the deadline.

        Raises:
            ProcessDiedError: there is no such answer; the process is then killed.
            UserError: the request failed, for the controller's reason.
        """
        if patience_s is None:
            patience_s = GRACE * self._options.deadline_s + GRACE_S
        try:
            self._connection.send_bytes(encode(request))
        except OSError:
            raise self._died() from None
        return self._receive(kind, patience_s)

    def kill(self) -> None:
        """End the process, and what it started."""
        if not self.alive:
            return  # what its descriptors were may be others' by now
        self.alive = False
        self._connection.close()
        os.close(self._lifeline)
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self.output.close()
        self._scratch.cleanup()

    def __del__(self) -> None:
        """End the process of a controller that nothing refers to."""
        self.kill()

    def close(self) -> None:
        """Let the controllers close, then end the process."""
        if self.alive:
            with suppress(ProcessDiedError, UserError, subprocess.TimeoutExpired):
                self.ask(Close(), Loaded)
                self._process.wait(ENDING_S)
        self.kill()
        self.echo.close()

    def _receive(self, kind: type[M], patience_s: float) -> M:
        try:
            while self._poll.poll(1e3 * patience_s):
                answer = decode_answer(self._connection.recv_bytes(MOST_BYTES))
                if isinstance(answer, kind):
                    return answer
                if isinstance(answer, Failed):
                    raise UserError(answer.reason)
                if not isinstance(answer, Alive):
                    raise EOFError
            if self._process.poll() is None:
                raise ProcessDiedError(self._late(patience_s), hung=True)
            raise EOFError
        except (EOFError, OSError, msgspec.MsgspecError):
            raise self._died() from None
        except BaseException:  # Ctrl-C, too: the answer is awaited no longer
            self.kill()
            raise

    def _late(self, patience_s: float) -> str:
        if patience_s == self._options.connect_s:
            return f"took longer than {patience_s:g} s"
        return f"took longer than the deadline of {self._options.deadline_s:g} s"

    def _died(self) -> ProcessDiedError:
        """End the process; return how it ended."""
        try:
            code: int | None = self._process.wait(ENDING_S)
        except subprocess.TimeoutExpired:
            code = None  # it closed the connection and goes on
        self.kill()
        return ProcessDiedError(how_it_ended(code))

    @contextmanager
    def _opening(self) -> Iterator[None]:
        """Say in a death that it came while the controller was opened, and what was printed."""
        try:
            yield
        except ProcessDiedError as died:
            line = self.output.last_line()
            printed = f" (it printed: {line})" if line else ""
            reason = f"opening the VUT {self.spec} {died}{printed}: look into the VUT"
            raise ProcessDiedError(reason, hung=died.hung) from died


def how_it_ended(code: int | None) -> str:
    """Describe the end of a process by its exit code; None for a broken connection."""
    if code is None:
        return "broke the channel to its process"
    if code >= 0:
        return f"ended its process with exit code {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:  # a real-time signal
        name = "unknown"
    return f"ended its process by signal {-code} ({name})"


def opened(
    spec: VutSpec, options: VutOptions, echo: Echo, *, again: bool = False
) -> ControllerProcess:
    """Return a process in which a controller is loaded; `UserError` where that fails.

    Args:
        spec: the controller.
        options: how it is hosted.
        echo: shows what it prints, where the options have no log.
        again: whether a process died before; the first may have been killed from outside.
    """
    try:
        return ControllerProcess(spec, options, echo)
    except ProcessDiedError as died:
        if again or died.hung:
            raise UserError(str(died)) from died
        return opened(spec, options, echo, again=True)


class HostedKind(ControllerKind):
    """A controller whose code runs in a process of its own; the first driver takes that process."""

    def __init__(self, spec: VutSpec, options: VutOptions, ready: Ready | None = None) -> None:
        """Open the controller, unless it is known what it is; `UserError` where that fails."""
        super().__init__(spec, options)
        self._process = None if ready is not None else opened(spec, options, Echo())
        self._ready = ready = ready or self._process.ready  # type: ignore[union-attr]
        self.max_corridors, self.max_workers = ready.max_corridors, ready.max_workers
        self.files = tuple(Path(os.fsdecode(file)) for file in ready.files)

    def __reduce__(self) -> tuple[type[HostedKind], tuple[VutSpec, VutOptions, Ready]]:
        """Travel without the process."""
        return HostedKind, (self.spec, self.options, self._ready)

    def with_options(self, spec: VutSpec, options: VutOptions) -> ControllerKind:
        """Return the controller with other parameters, or with another log."""
        other = HostedKind(spec, options, self._ready)
        if spec == self.spec and self._process is not None:
            other._process, self._process = self._process, None
            other._process.output.log = options.log
        return other

    def driver(self, corridors: int, _world: object) -> Driver:
        """Return a driver that asks the process."""
        process, self._process = self._process, None
        return HostedDriver(corridors, self.spec, self.options, process)

    def release(self) -> None:
        """End a process that no driver has taken."""
        self._process = None


class HostedDriver(ControllerDriver):
    """Passes each step on to the process of a controller."""

    def __init__(
        self,
        corridors: int,
        spec: VutSpec,
        options: VutOptions,
        process: ControllerProcess | None = None,
    ) -> None:
        """Make the controllers in their process; `UserError` where that fails.

        Args:
            corridors: number of corridors.
            spec: the controller.
            options: how it is hosted.
            process: where it is loaded; None starts a process.
        """
        super().__init__(corridors)
        self._spec, self._options = spec, options
        self._starts: list[tuple[int, Start]] = []
        self._reasons: Mapping[int, str] = {}
        self._signals: Mapping[int, Left] = {}
        self._files: set[Path] = set()
        self._parameters: Mapping[str, float] = {}
        self._process = self._with_controllers(process or opened(spec, options, Echo()))

    def reset(self, corridor: int, start: Start) -> None:
        """Note that an episode begins; the controller is told with the next scene."""
        self._starts.append((corridor, start))

    def act(self, scene: Scene) -> FloatArray:
        """Return the answers of the controllers; NaN where there is a reason.

        Raises `VutLostError` where the process died.
        """
        request = Act(self._starts, packed(scene))
        self._starts = []
        try:
            if not self._process.alive:
                process = opened(self._spec, self._options, self._process.echo)
                self._process = self._with_controllers(process)
        except UserError as error:  # its files have changed since
            self._reasons = dict.fromkeys(range(self.corridors), f"started again: {error}")
            return np.full(self.corridors, np.nan)
        try:
            answer = self._process.ask(request, Acted)
            answers, self._wishes = answer.numbers(self.corridors)
        except (ProcessDiedError, UserError) as error:
            raise VutLostError(str(error)) from None
        except ValueError:
            self._process.kill()
            raise VutLostError(how_it_ended(None)) from None
        self._reasons, self._signals = answer.reasons, answer.checked_signals()
        return answers

    def signals(self) -> Mapping[int, Left]:
        """Return the signals of the last answers, by corridor."""
        return self._signals

    def parameters(self) -> Mapping[str, float]:
        """Return the parameters of the controller, as they were when it was made."""
        return self._parameters

    def reason(self, corridor: int) -> str | None:
        """Return what the controller of a corridor did wrong."""
        return self._reasons.get(corridor)

    def files(self) -> tuple[Path, ...]:
        """Return the files of code that were loaded so far."""
        if self._process.alive:
            with suppress(ProcessDiedError, UserError):
                self._note(self._process.ask(ListFiles(), Loaded).files)
        return tuple(sorted(self._files))

    def close(self) -> None:
        """Close the controllers, and end their process."""
        self._process.close()

    def _with_controllers(self, process: ControllerProcess) -> ControllerProcess:
        """Make the controllers in a process, and return it."""
        self._note(process.ready.files)
        try:
            self._parameters = process.make(self.corridors)
        except ProcessDiedError as died:
            raise UserError(str(died)) from died
        return process

    def _note(self, files: list[bytes]) -> None:
        self._files.update(Path(os.fsdecode(file)) for file in files)
