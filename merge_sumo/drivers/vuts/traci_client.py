"""A connected TraCI client: its messages, its deadline, and the steps that it waits for."""

from __future__ import annotations

import math
import socket
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from time import monotonic
from typing import Final, TypeVar

from merge_sumo.drivers.vuts import traci_protocol as tp
from merge_sumo.drivers.vuts.base import Seen
from merge_sumo.drivers.vuts.process import GRACE_S, Program
from merge_sumo.drivers.vuts.traci_protocol import Command, ProtocolError, Reader
from merge_sumo.drivers.vuts.traci_session import CLOSE, SIMULATION_STEP, Session
from merge_sumo.drivers.vuts.traci_simulation import VUT

T = TypeVar("T")

FAREWELL_STEPS: Final = 10
"""Steps on an empty road, with nobody to come, in which a client may end by itself."""


class FaultError(Exception):
    """What the client did wrong."""


class LateError(FaultError):
    """The client made no step in time."""


class ClosedError(Exception):
    """The client said goodbye while no vehicle was on the road."""


class Client:
    """A connected client: its socket, its session, and the commands that it has not been told."""

    def __init__(
        self,
        connection: socket.socket,
        session: Session,
        deadline_s: float,
        program: Program | None,
    ) -> None:
        """Take a connection, and what answers it."""
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket, self._session, self._program = connection, session, program
        self._deadline_s = deadline_s
        self._commands: deque[Command] = deque()
        self._reply = bytearray()
        self._until_step: float | None = None
        """Time up to which the client asked to step, if it waits for a step; 0 for one step."""

    def acceleration_mps2(self) -> float:
        """Return what it asks for in the coming step."""
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
        """Drop it, and the SUMO beside."""
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
                raise (FaultError if half else LateError)(
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
