"""The process that serves a TraCI client, with the shadow SUMO that answers it and decides.

It is handed the client's connection and told, step by step, where the vehicles are; it answers with
the speed that SUMO gives the VUT by what the client commanded, or with what the client did wrong.
"""

from __future__ import annotations

import math
import socket
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from time import monotonic
from typing import Any, Final

from merge_sumo.errors import UserError
from merge_sumo.sumo.child import Channel, channel_of
from merge_sumo.sumo.shadow_sumo import NAME_OF_VUT, ShadowSumo, State
from merge_sumo.system.limits import lower_limits
from merge_sumo.vuts.process import GRACE_S
from merge_sumo.vuts.traci import protocol as tp
from merge_sumo.vuts.traci.commands import NotFiniteError
from merge_sumo.vuts.traci.protocol import CLOSE, SIMULATION_STEP, Command, ProtocolError, Reader
from merge_sumo.vuts.traci.session import Session

FAREWELL_STEPS: Final = 10
"""Steps on an empty road, with no vehicle to come, in which a client may end by itself."""
MOST_MEMORY_BYTES: Final = 4 << 30
MOST_FILE_BYTES: Final = 16 << 20


class FaultError(Exception):
    """The client's fault; where its connection is `gone`, its program may say why."""

    def __init__(self, text: str, *, gone: bool = False) -> None:
        super().__init__(text)
        self.gone = gone


class ClosedError(Exception):
    """The client said goodbye while no vehicle was on the road."""


def main(settings: Mapping[str, Any]) -> None:
    """Serve clients, one after the other, until the channel ends."""
    channel, folder = channel_of(settings), Path(settings["folder"])
    lower_limits(RLIMIT_DATA=MOST_MEMORY_BYTES, RLIMIT_FSIZE=MOST_FILE_BYTES, RLIMIT_CORE=0)
    try:
        sumo = ShadowSumo(folder)
        sumo.load()
    except UserError as error:
        channel.send({"refused": str(error)})
        return
    channel.send({})
    with suppress(EOFError, OSError):
        _serve(channel, sumo)


def _serve(channel: Channel, sumo: ShadowSumo) -> None:
    """Do what the parent asks for until its end of the channel closes."""
    client: Client | None = None
    while True:
        message = channel.receive()
        if message["do"] in ("connect", "drop") or client is None:
            if client is not None:
                client.socket.close()
                client = None
            if message["do"] == "connect":
                connection = channel.take()
                sumo.load()
                client = Client(connection, Session(sumo), message["deadline_s"])
            channel.send({})
            continue
        answer: dict[str, Any] = {}
        try:
            if message["do"] == "farewell":
                client.farewell()
            else:
                states, merged = message["states"], message["merged"]
                answer = {"v_mps": client.show(states, merged=merged, seed=message.get("seed"))}
                answer |= {"merge": sumo.wants_to_merge, "by_sumo": sumo.by_sumo}
        except FaultError as fault:
            answer = {"fault": str(fault), "gone": fault.gone}
        except ClosedError:
            answer = {"closed": True}
        session = client.session
        channel.send({**answer, "notes": session.notes, "in_vain": sorted(session.in_vain)})


class Client:
    """A connected client: its socket, its session, and the commands that it has not been told."""

    def __init__(self, connection: socket.socket, session: Session, deadline_s: float) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.socket, self.session = connection, session
        self._deadline_s = deadline_s
        self._commands: deque[Command] = deque()
        self._reply = bytearray()
        self._until_step_s: float | None = None
        """Time up to which the client asked to step, if it waits for a step; 0 for one step."""

    def show(
        self, states: Mapping[str, State], *, merged: bool, seed: int | None = None
    ) -> float | None:
        """Show the next state, and serve the client until it makes its next step.

        With the first state of an episode, which has its `seed`, the vehicles of the one before
        arrive; `merged` is whether the VUT has left the acceleration lane. Returns the speed of the
        VUT after that step; None where it is beyond the net. Raises `FaultError` for what the
        client does wrong, and `ClosedError` when it says goodbye before the vehicles depart.
        """
        session = self.session
        if seed is not None:
            if session.driving:
                # The step in which they arrive was made when the client asked for it.
                session.clear()
                self._answer_step()
            self._serve_until_step()
            session.enter(states, seed)
        else:
            session.put(states, merged=merged)
        self._answer_step()
        self._serve_until_step()
        return session.step()

    def farewell(self) -> None:
        """Show the last arrival, with no vehicle to come, and give the client time to close."""
        session = self.session
        session.expected = False
        with suppress(FaultError):
            for _ in range(FAREWELL_STEPS):
                if session.driving:
                    session.clear()
                else:
                    session.step()
                if self._until_step_s is not None:
                    self._until_step_s = 0.0  # the time that it asked for will not come
                self._answer_step()
                self._serve_until_step(GRACE_S)

    def _answer_step(self) -> None:
        """Answer the step that the client waits for, unless it asked to step on further."""
        until_s = self._until_step_s
        if until_s is None or until_s > self.session.sumo.time_s + 1e-9:
            return
        self._until_step_s = None
        self._reply += tp.status(SIMULATION_STEP) + self.session.results()
        self._flush()

    def _serve_until_step(self, patience_s: float = math.inf) -> None:
        """Answer commands until the client waits for a step."""
        until = monotonic() + min(self._deadline_s, patience_s)
        while self._until_step_s is None:
            if not self._commands:
                self._commands.extend(self._receive(until))
            command = self._commands.popleft()
            before_s = monotonic()
            try:
                self._do(command)
            except ProtocolError as error:
                raise FaultError(
                    f"the controller sent command 0x{command.identifier:02x} that is no TraCI: "
                    f"{error}"
                ) from error
            except NotFiniteError as error:
                raise FaultError(f"the controller commanded {error}") from error
            until += monotonic() - before_s  # it waits for us, and not we for it
            if self._until_step_s is None:
                self._flush()

    def _do(self, command: Command) -> None:
        """Answer a command, or note up to when the client wants to step.

        A step to a time of the past is answered at once. Goodbye is a fault where the VUT is on the
        road.
        """
        session = self.session
        if command.identifier == CLOSE:
            self._reply += tp.status(CLOSE)
            self._commands.clear()
            self._flush()
            if NAME_OF_VUT in session.sumo.at_m:
                raise FaultError(
                    "the controller closed the connection during the episode", gone=True
                )
            raise ClosedError
        if command.identifier != SIMULATION_STEP:
            self._reply += session.handle(command)
            return
        target_s = Reader(command.payload).double()
        session.answered()
        if target_s == 0.0 or target_s > session.sumo.time_s + 1e-9:
            self._until_step_s = target_s
        elif math.isnan(target_s):
            raise FaultError("the controller stepped to time nan")
        else:
            self._reply += tp.status(SIMULATION_STEP) + session.results()

    def _flush(self) -> None:
        """Send the reply once all commands of its message have been answered."""
        if self._commands or not self._reply:
            return
        content = tp.message(bytes(self._reply))
        self._reply.clear()
        try:
            self.socket.settimeout(self._deadline_s)
            self.socket.sendall(content)
        except TimeoutError as error:
            raise FaultError(
                f"the controller took no answer within {self._deadline_s:g} s"
            ) from error
        except OSError as error:
            raise FaultError("the controller closed the connection", gone=True) from error

    def _receive(self, until: float) -> list[Command]:
        """Return the commands of a message that comes before a time."""
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
                self.socket.settimeout(left_s)
                part = self.socket.recv(count - len(parts))
            except TimeoutError as error:
                what = "sent half a message and no more" if half else "made no step"
                raise FaultError(
                    f"the controller {what} within the deadline of {self._deadline_s:g} s"
                ) from error
            except OSError as error:
                raise FaultError("the controller broke the connection", gone=True) from error
            if not part:
                what = "closed the connection in a message" if half else "closed the connection"
                raise FaultError(f"the controller {what}", gone=True)
            parts += part
        return bytes(parts)
