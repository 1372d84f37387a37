"""A VUT behind TraCI: a controller written for SUMO, in any language, drives the vehicle `vut`.

This process is the server. A client makes a step by `simulationStep`, so client and rollout go in
lockstep: its step is answered when ours has been made, and the speed that it commanded before
becomes the acceleration of eq. (4). Between two episodes the road is empty for one step.
"""

from __future__ import annotations

import math
import socket
import sys
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from time import monotonic
from typing import Final, TypeVar

import numpy as np

from merge_sumo.drivers.base import Driver, Scene
from merge_sumo.drivers.vuts import traci_protocol as tp
from merge_sumo.drivers.vuts.base import Seen, Vut, VutOptions, seen_in
from merge_sumo.drivers.vuts.process import GRACE_S, Program, split_command
from merge_sumo.drivers.vuts.traci_protocol import Command, ProtocolError, Reader
from merge_sumo.drivers.vuts.traci_session import CLOSE, SIMULATION_STEP, Session
from merge_sumo.drivers.vuts.traci_simulation import VUT
from merge_sumo.errors import UserError
from merge_sumo.sumo.corridor import Corridor
from merge_sumo.sumo.road import road_of
from merge_sumo.sumo.world import World
from merge_sumo.values.case import Case, FloatArray
from merge_sumo.values.scenario import DT_S, POV, US23, Scenario

T = TypeVar("T")

HOST: Final = "127.0.0.1"
DEFAULT_PORT: Final = 8813
"""Where TraCI clients connect when they are not told otherwise."""
FAREWELL_STEPS: Final = 10
"""Steps on an empty road, with nobody to come, in which a client may end by itself."""


def traci_vut(argument: str, options: VutOptions) -> Vut:
    """Return the VUT of `traci` or `traci:PORT`; `UserError` for a port or command that is none."""
    if argument and not (argument.isdecimal() and 1 <= int(argument) <= 65535):
        raise UserError(f"--vut traci:{argument}: the port is a number from 1 to 65535")
    # A command is told its port, so that any free one does and several can run at a time.
    port = int(argument) if argument else (0 if options.command else DEFAULT_PORT)
    command = None if options.command is None else split_command(options.command)

    def make(corridors: int, world: World | None) -> Driver:
        road, scenario = (road_of(), US23) if world is None else (world.road, world.scenario)
        return TraciVut(corridors, road, scenario, port, command, options)

    files = [Path(word) for word in command or () if Path(word).is_file()]
    return Vut(
        make=make,
        max_corridors=1,
        max_workers=None if port == 0 else 1,
        files=tuple(files),
        named_only=True,
    )


class FaultError(Exception):
    """What the client did wrong."""


class ClosedError(Exception):
    """The client said goodbye while no vehicle was on the road."""


class TraciVut(Driver):
    """Drives as a TraCI client commands; one client has one vehicle `vut`, so one corridor."""

    def __init__(
        self,
        corridors: int,
        road: Corridor,
        scenario: Scenario,
        port: int,
        command: list[str] | None,
        options: VutOptions,
    ) -> None:
        """Start the command, or wait for a client; `UserError` when none connects in time."""
        if corridors != 1:
            raise ValueError("a TraCI client drives in one corridor")
        super().__init__(corridors)
        self._road, self._scenario, self._port = road, scenario, port
        self._command, self._options = command, options
        self._listener: socket.socket | None = None
        self._program: Program | None = None
        self._client: _Client | None = None
        self._reason: str | None = None
        self._starting = True
        self._patience_s = options.connect_s
        try:
            self._connect()
        except FaultError as error:
            self.close()
            raise UserError(str(error)) from error
        except BaseException:
            self.close()
            raise

    def begin(self, corridor: int, case: Case) -> None:
        """Note that the next scene is the first of an episode."""
        self._reason = None
        self._starting = True

    def act(self, scene: Scene) -> FloatArray:
        """Return the acceleration that follows from what the client commanded, or NaN."""
        if self._reason is None:
            try:
                x_m, v_mps = scene.x_m[:, 0].tolist(), scene.v_mps[:, 0].tolist()
                seen = seen_in(float(scene.step[0]) * DT_S, POV, x_m, v_mps)
                return np.array([self._ask(seen)])
            except FaultError as error:
                self._reason = str(error)
                self._disconnect()
        return np.array([math.nan])

    def reason(self, corridor: int) -> str | None:
        """Return what the client did wrong."""
        return self._reason

    def close(self) -> None:
        """Let the client see the last arrival and end; then end it."""
        if self._client is not None:
            self._client.farewell()
        self._disconnect(grace=True)

    def _ask(self, seen: Seen) -> float:
        if self._starting:
            self._enter(seen)
            self._starting = False
        else:
            assert self._client is not None, "an episode has a client"  # noqa: S101
            self._client.step_to(seen)
        acceleration = self._client.acceleration_mps2() if self._client else math.nan
        if not math.isfinite(acceleration):
            raise FaultError(f"the controller asked for an acceleration of {acceleration}")
        return acceleration

    def _enter(self, seen: Seen) -> None:
        """Let the vehicles depart, for the client that is there or for one that comes anew.

        A controller may run once per episode: a goodbye on an empty road is no fault.
        """
        for attempt in (1, 2):
            if self._client is None:
                self._connect()
            assert self._client is not None, "connected"  # noqa: S101
            try:
                self._client.leave()
                self._client.step_to(seen)
            except ClosedError:
                # The listener stays: the next client may be waiting already.
                self._drop_client(grace=True)
                if attempt == 2:
                    raise FaultError(
                        "the controller closed the connection before the vehicles departed"
                    ) from None
            else:
                return

    def _connect(self) -> None:
        """Wait for a client, with a program started anew if there is a command."""
        patience_s = self._patience_s
        # Who did not come once is not waited for as long again.
        self._patience_s = min(patience_s, self._options.deadline_s)
        if self._listener is None:
            self._listener = _listen(self._port)
        port = self._listener.getsockname()[1]
        if self._command is not None:
            self._program = Program(self._command, port, self._options.log)
        else:
            sys.stderr.write(
                f"waiting up to {patience_s:g} s for a TraCI client on {HOST}:{port}\n"
            )
        until = monotonic() + patience_s
        while True:
            # A program that ended will not connect any more: look every now and then.
            self._listener.settimeout(max(min(0.1, until - monotonic()), 0.001))
            try:
                connection, _ = self._listener.accept()
                break
            except TimeoutError:
                ended = self._program.ended(0.0) if self._program else ""
                if ended or monotonic() > until:
                    self._disconnect()
                    late = f"no TraCI client connected to {HOST}:{port} in {patience_s:g} s"
                    before = f"{ended} (before it connected)" if ended else late
                    raise FaultError(before) from None
        self._patience_s = self._options.connect_s
        session = Session(self._road, self._scenario, note=self._note)
        self._client = _Client(connection, session, self._options.deadline_s, self._program)

    def _note(self, sentence: str) -> None:
        """Add a sentence to what the controller printed."""
        log = self._options.log
        if log is None:
            sys.stderr.write(f"note: {sentence}\n")
            return
        with suppress(OSError), log.open("a", encoding="utf-8") as file:
            file.write(f"note: {sentence}\n")

    def _disconnect(self, *, grace: bool = False) -> None:
        """Drop the client and end its program; nobody of it is left, nor of who waits."""
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        self._drop_client(grace=grace)

    def _drop_client(self, *, grace: bool) -> None:
        """Drop the client and end its program."""
        if self._client is not None:
            self._client.close()
            self._client = None
        if self._program is not None:
            self._program.stop(**({} if grace else {"grace_s": 0.0}))
            self._program = None


def _listen(port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((HOST, port))
        listener.listen(1)
    except OSError as error:
        listener.close()
        raise UserError(
            f"cannot listen on {HOST}:{port} ({error.strerror}): choose another port by "
            "--vut traci:PORT"
        ) from error
    return listener


class _Client:
    """A connected client: its socket, its session, and the commands that it has not been told."""

    def __init__(
        self,
        connection: socket.socket,
        session: Session,
        deadline_s: float,
        program: Program | None,
    ) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket, self._session, self._program = connection, session, program
        self._deadline_s = deadline_s
        self._commands: deque[Command] = deque()
        self._reply = bytearray()
        self._until_step: float | None = None
        """Time up to which the client asked to step, if it waits for a step; 0 for one step."""

    def acceleration_mps2(self) -> float:
        return self._session.acceleration_mps2()

    def leave(self) -> None:
        """End the episode that was, if there was one: its vehicles arrive."""
        if self._session.vehicles:
            self._session.clear(more=True)
            self._answer_step()
        if self._until_step is None:
            self._serve()

    def step_to(self, seen: Seen) -> None:
        """Show the next state, and serve the client until it makes its next step."""
        self._session.show(seen)
        self._answer_step()
        if self._until_step is None:
            self._serve()

    def farewell(self) -> None:
        """Show the last arrival, with nobody to come, and give the client time to close."""
        with suppress(FaultError, ClosedError):
            for _ in range(FAREWELL_STEPS):
                self._session.clear(more=False)
                if self._until_step is not None:
                    self._until_step = 0.0  # the time that it asked for will not come
                self._answer_step()
                self._serve(GRACE_S)

    def close(self) -> None:
        self._socket.close()
        self._session.close()

    def _answer_step(self) -> None:
        """Answer the step that the client waits for, unless it asked to step on further."""
        session = self._session
        if self._until_step is None or self._until_step > session.time_s + 1e-9:
            return
        self._until_step = None
        self._reply += tp.status(SIMULATION_STEP) + session.results()
        self._flush()

    def _serve(self, patience_s: float = math.inf) -> None:
        """Answer commands until the client makes a step."""
        until = monotonic() + min(self._deadline_s, patience_s)
        session = self._session
        while True:
            while self._commands:
                command = self._commands.popleft()
                if command.identifier == SIMULATION_STEP:
                    target = self._checked(lambda c: Reader(c.payload).double(), command)
                    session.answered()
                    if target == 0.0 or target > session.time_s + 1e-9:
                        self._until_step = target
                        return
                    if math.isnan(target):
                        raise FaultError("the controller stepped to time nan")
                    self._reply += tp.status(SIMULATION_STEP) + session.results()
                elif command.identifier == CLOSE:
                    self._reply += tp.status(CLOSE)
                    self._commands.clear()
                    self._flush()
                    if VUT in session.vehicles:
                        raise FaultError(self._gone("closed the connection during the episode"))
                    raise ClosedError
                else:
                    before_s = monotonic()
                    self._reply += self._checked(session.handle, command)
                    until += monotonic() - before_s  # it waits for us, and not we for it
                self._flush()
            self._commands.extend(self._receive(until))

    def _checked(self, function: Callable[[Command], T], command: Command) -> T:
        """Return what a function makes of a command."""
        try:
            return function(command)
        except ProtocolError as error:
            raise FaultError(
                f"the controller sent command 0x{command.identifier:02x} that is no TraCI: {error}"
            ) from error

    def _flush(self) -> None:
        """Send the reply once all commands of its message have been answered."""
        if self._commands or not self._reply:
            return
        content = tp.message(bytes(self._reply))
        self._reply.clear()
        try:
            self._socket.settimeout(self._deadline_s)
            self._socket.sendall(content)
        except TimeoutError as error:
            raise FaultError(
                f"the controller took no answer within {self._deadline_s:g} s"
            ) from error
        except OSError as error:
            raise FaultError(self._gone("closed the connection")) from error

    def _receive(self, until: float) -> list[Command]:
        head = self._read(4, until, begun=False)
        try:
            return tp.commands_of(self._read(tp.message_length(head), until, begun=True))
        except ProtocolError as error:
            raise FaultError(f"the controller sent bytes that are no TraCI: {error}") from error

    def _read(self, count: int, until: float, *, begun: bool) -> bytes:
        """Return `count` bytes that come before a time; `begun` tells a half message from none."""
        parts = bytearray()
        while len(parts) < count:
            left_s = until - monotonic()
            half = begun or bool(parts)
            try:
                if left_s <= 0.0:
                    raise TimeoutError
                self._socket.settimeout(left_s)
                part = self._socket.recv(count - len(parts))
            except TimeoutError as error:
                what = "sent half a message and no more" if half else "made no step"
                raise FaultError(
                    f"the controller {what} within the deadline of {self._deadline_s:g} s"
                ) from error
            except OSError as error:
                raise FaultError(self._gone("broke the connection")) from error
            if not part:
                what = "closed the connection in a message" if half else "closed the connection"
                raise FaultError(self._gone(what))
            parts += part
        return bytes(parts)

    def _gone(self, what: str) -> str:
        """Return why a client is gone: how its program ended, where that is known."""
        ended = self._program.ended(0.5) if self._program is not None else ""
        return f"the controller {what}" + (f"; {ended}" if ended else "")
