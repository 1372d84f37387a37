"""The child process that serves TraCI clients by a second SUMO, and its handle in the parent.

The parent passes on the connections of clients, and the states of the vehicles step by step.
"""

from __future__ import annotations

import math
import os
import socket
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from multiprocessing.reduction import recv_handle, send_handle
from pathlib import Path
from time import monotonic
from typing import Any

import msgspec

from merge_sumo.controllers.process import ENDING_S, ChildProcess, parent_connection
from merge_sumo.controllers.traci.protocol import (
    CLOSE,
    STEP,
    Command,
    ProtocolError,
    Reader,
    commands_of,
    message,
    message_length,
    status,
)
from merge_sumo.controllers.traci.session import NotFiniteError, Session
from merge_sumo.errors import UserError
from merge_sumo.road.road import Road
from merge_sumo.scenario.scenario import Scenario
from merge_sumo.sumo.binding import sumo_environment
from merge_sumo.sumo.mirror import VUT_ID, MirrorSimulation, State, write_files

FAREWELL_STEPS = 10
"""Steps on an empty road, with no vehicle to come, in which a client may end by itself."""
MOST_MEMORY_BYTES = 4 << 30
MOST_FILE_BYTES = 16 << 20
ROUNDING_S = 1e-9


class Reply(msgspec.Struct, omit_defaults=True):
    """The reply of the serving process to a request.

    Attributes:
        v_mps: the speed that SUMO gives the VUT for the step; None beyond the end of the net.
        merge: whether the VUT requests to leave the acceleration lane.
        by_sumo: whether SUMO's own driver chose the speed.
        fault: the client's fault; "" without one.
        closed: whether the client has closed its connection while the VUT was not on the road.
        refused: why the process cannot carry out the request; "" if it did.
        in_vain: commands of the episode that changed nothing.
    """

    v_mps: float | None = None
    merge: bool = False
    by_sumo: bool = False
    fault: str = ""
    closed: bool = False
    refused: str = ""
    in_vain: list[str] = []


class FaultError(Exception):
    """A fault of the client, in words."""


class GoodbyeError(FaultError):
    """The client has closed the connection while the VUT was not on the road."""


class ServerProcess(ChildProcess):
    """The serving process, with the road and the vehicles of a scenario."""

    def __init__(self, road: Road, scenario: Scenario) -> None:
        """Start the process.

        Args:
            road: the road of the vehicles.
            scenario: their number, lengths and limits.

        Raises:
            UserError: if it cannot be started.
        """
        if os.name != "posix":
            raise UserError("a TraCI controller needs Linux or macOS")
        no_warnings = Path(os.devnull)
        super().__init__(f"{__name__}:{main.__name__}", {}, sumo_environment(), no_warnings)
        write_files(Path(self.folder.name), road, scenario)

    def request(
        self, action: str, patience_s: float, client: socket.socket | None = None, **values: Any
    ) -> Reply:
        """Return the reply to a request.

        Args:
            action: name of a method of `Server`.
            patience_s: time for the reply.
            client: a connection to pass on.
            values: other arguments of the method.

        Raises:
            ProcessDiedError: if no reply comes in time, or the process has ended.
            UserError: if the process cannot do it.
        """
        self.send(msgspec.msgpack.encode((action, values)))
        if client is not None:
            with suppress(OSError):  # the process is gone
                send_handle(self._socket, client.fileno(), self._process.pid)
        content = self.receive(patience_s, "took too long to answer")
        reply = msgspec.msgpack.decode(content, type=Reply)
        if reply.refused:
            self.kill()
            lines = self.output.lines()
            raise UserError(lines[0].removeprefix("Error: ") if lines else reply.refused)
        return reply


def main(settings: Mapping[str, Any]) -> None:
    """Serve clients, one after the other, until the parent ends.

    Args:
        settings: those of `ServerProcess`.
    """
    limits = {"RLIMIT_DATA": MOST_MEMORY_BYTES, "RLIMIT_FSIZE": MOST_FILE_BYTES}
    connection, server = parent_connection(settings, **limits), Server(Path(settings["folder"]))
    os.chdir(settings["folder"])
    with suppress(EOFError, OSError):
        while True:
            action, values = msgspec.msgpack.decode(connection.recv_bytes())
            if action == "serve":
                values["client"] = socket.socket(fileno=recv_handle(connection))
            connection.send_bytes(msgspec.msgpack.encode(server.reply(action, values)))


class Server:
    """Serves one client at a time.

    The parent requests its methods `serve`, `step` and `farewell` by their names.
    """

    _session: Session
    _client: socket.socket

    def __init__(self, folder: Path) -> None:
        """Take the files; SUMO starts with the first client.

        Args:
            folder: the folder of `write_files`.
        """
        self._folder = folder
        self._sumo: MirrorSimulation | None = None

    def reply(self, action: str, values: Mapping[str, Any]) -> Reply:
        """Return the reply to a request.

        Args:
            action: name of a method.
            values: its arguments by name.
        """
        try:
            reply: Reply = getattr(self, action)(**values)
        except FaultError as fault:
            reply = Reply(fault=str(fault), closed=isinstance(fault, GoodbyeError))
        except UserError as error:
            return Reply(refused=str(error))
        reply.in_vain = sorted(self._session.in_vain)
        return reply

    def serve(self, client: socket.socket, deadline_s: float) -> Reply:
        """Serve a client instead of the last one, on an empty road.

        Args:
            client: its connection.
            deadline_s: its time for each step.
        """
        if self._sumo is None:
            self._sumo = MirrorSimulation(self._folder)
        self._sumo.load()
        self._client, self._session = client, Session(self._sumo)
        self._deadline_s = deadline_s
        self._commands: deque[Command] = deque()
        self._answers = b""
        self._target_s: float | None = None
        """Time in s to which the client steps, 0 for one step; None where it does not step yet."""
        return Reply()

    def step(self, states: Mapping[str, State], *, merged: bool, seed: int | None = None) -> Reply:
        """Show the next state, and serve the client until it makes its next step.

        Args:
            states: states of the vehicles.
            merged: whether the VUT has left the acceleration lane.
            seed: seed of the episode, where this is its first state.

        Raises:
            FaultError: if the client does something wrong, or says goodbye.
        """
        session = self._session
        if seed is None:
            session.put(states, merged=merged)
        else:
            if session.sumo.at_m:
                # The step in which they arrive was made when the client asked for it.
                session.sumo.clear()
                self._answer_step()
            self._serve_until_step()
            session.enter(states, seed)
        self._answer_step()
        self._serve_until_step()
        v_mps, sumo = session.step(), session.sumo
        return Reply(v_mps=v_mps, merge=sumo.requests_merge, by_sumo=sumo.by_sumo)

    def farewell(self) -> Reply:
        """Show the last arrival, with no vehicle to come, and give the client time to close."""
        session = self._session
        session.expected = False
        for _ in range(FAREWELL_STEPS):
            if session.sumo.at_m:
                session.sumo.clear()
            else:
                session.step()
            if self._target_s is not None:
                self._target_s = 0.0  # the time that it asked for will not come
            self._answer_step()
            self._serve_until_step(ENDING_S)
        return Reply()

    def _answer_step(self) -> None:
        """Answer the step that the client waits for, unless it asked to step on further."""
        until_s = self._target_s
        if until_s is None or until_s > self._session.sumo.time_s + ROUNDING_S:
            return
        self._target_s = None
        self._answers += status(STEP) + self._session.results()
        self._flush()

    def _serve_until_step(self, patience_s: float = math.inf) -> None:
        """Answer commands until the client waits for a step."""
        until = monotonic() + min(self._deadline_s, patience_s)
        while self._target_s is None:
            if not self._commands:
                self._commands.extend(self._receive(until))
            command = self._commands.popleft()
            before_s = monotonic()
            try:
                self._do(command)
            except ProtocolError as error:
                raise FaultError(
                    f"the controller sent the invalid TraCI command 0x{command.identifier:02x}: "
                    f"{error}"
                ) from error
            except NotFiniteError as error:
                raise FaultError(f"the controller commanded {error}") from error
            until += monotonic() - before_s  # the client waits for SUMO
            if self._target_s is None:
                self._flush()

    def _do(self, command: Command) -> None:
        """Answer a command, or note up to when the client wants to step.

        A step to a time of the past is answered at once.
        """
        session, sumo = self._session, self._session.sumo
        if command.identifier == CLOSE:
            self._commands.clear()
            self._answers += status(CLOSE)
            self._flush()
            if VUT_ID not in sumo.at_m:
                raise GoodbyeError("the controller closed the connection")
            raise FaultError("the controller closed the connection during the episode")
        if command.identifier != STEP:
            self._answers += session.handle(command)
            return
        target_s = Reader(command.payload).value("d")
        session.answered()
        if target_s == 0.0 or target_s > sumo.time_s + ROUNDING_S:
            self._target_s = target_s
        elif math.isnan(target_s):
            raise FaultError("the controller stepped to time nan")
        else:
            self._answers += status(STEP) + session.results()

    def _flush(self) -> None:
        """Send the answers once all commands of a message have been answered."""
        if self._commands or not self._answers:
            return
        content, self._answers = message(self._answers), b""
        self._client.settimeout(self._deadline_s)
        try:
            self._client.sendall(content)
        except OSError as error:
            raise FaultError(f"the controller did not read the answer: {error}") from error

    def _receive(self, until: float) -> list[Command]:
        """Return the commands of a message that comes before a time."""
        try:
            length = message_length(self._read(4, until, "made no step"))
            return commands_of(self._read(length, until, "sent only a part of a message"))
        except ProtocolError as error:
            raise FaultError(f"the controller sent bytes that are not TraCI: {error}") from error

    def _read(self, count: int, until: float, late: str) -> bytes:
        """Return `count` bytes that come before a time; `late` is the fault if they do not."""
        content = b""
        while len(content) < count:
            left_s, part = until - monotonic(), b""
            try:
                if left_s <= 0.0:
                    raise TimeoutError
                self._client.settimeout(left_s)
                part = self._client.recv(count - len(content))
            except TimeoutError as error:
                raise FaultError(
                    f"the controller {late} within the deadline of {self._deadline_s:g} s"
                ) from error
            except OSError:
                pass  # it has broken the connection
            if not part:
                raise FaultError("the controller closed the connection")
            content += part
        return content
