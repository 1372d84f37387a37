"""The process that serves TraCI clients: it listens at the port, and holds a `MirrorSimulation`.

`Child` is its handle in the process that runs the cases. The two exchange MessagePack, which is
read as data, over a pair of sockets. The child gets the states of the vehicles step by step, and
answers with the speed that SUMO gives the VUT by the client's commands, or with the client's fault.
"""

from __future__ import annotations

import math
import os
import socket
import sys
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from time import monotonic
from typing import Any

import msgspec

from merge_sumo.controllers.process import ENDING_S, ChildProcess, connected
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
from merge_sumo.files import ScratchFolder
from merge_sumo.road.corridor import Corridor
from merge_sumo.scenario.scenario import Scenario
from merge_sumo.sumo.binding import sumo_environment
from merge_sumo.sumo.mirror import VUT_ID, MirrorSimulation, State, write_files

HOST = "127.0.0.1"
KNOWS_USERS = sys.platform == "linux"
"""Whether the system tells the user of a connection; elsewhere the first client is served."""
START_S = 60.0
"""Time that the process has to start, on whatever machine."""
WORK_S = 10.0
"""Time that SUMO has for the questions of a controller in a step, in addition to the deadline."""
FAREWELL_STEPS = 10
"""Steps on an empty road, with no vehicle to come, in which a client may end by itself."""
MOST_MEMORY_BYTES = 4 << 30
MOST_FILE_BYTES = 16 << 20
ROUNDING_S = 1e-9


class Answer(msgspec.Struct, omit_defaults=True):
    """Answer of the child process.

    Attributes:
        v_mps: the speed that the VUT is to have after the step; None beyond the end of the net.
        merge: whether it wants to leave the acceleration lane.
        by_sumo: whether SUMO's own driver chose the speed.
        port: where the child listens.
        accepted: whether a client is connected.
        closed: whether the client has said goodbye while no vehicle was on the road.
        fault: the client's fault; "" for none.
        gone: whether its connection is gone, so that its program may say why.
        refused: why the child cannot carry out the request.
        notes: sentences for the log.
        in_vain: commands of the episode that change nothing here.
    """

    v_mps: float | None = None
    merge: bool = False
    by_sumo: bool = False
    port: int = 0
    accepted: bool = False
    closed: bool = False
    fault: str = ""
    gone: bool = False
    refused: str = ""
    notes: list[str] = []
    in_vain: list[str] = []


class FaultError(Exception):
    """The client's fault; where its connection is `gone`, its program may say why."""

    def __init__(self, text: str, *, gone: bool = False) -> None:
        super().__init__(text)
        self.gone = gone


class ClosedError(Exception):
    """The client said goodbye while no vehicle was on the road."""


class Child(ChildProcess):
    """The serving process, with the road and the vehicles of a scenario."""

    def __init__(self, road: Corridor, scenario: Scenario) -> None:
        """Start the process; `UserError` if it cannot be started."""
        if os.name != "posix":
            raise UserError("a controller by TraCI needs Linux or macOS")
        folder = ScratchFolder()
        write_files(Path(folder.name), road, scenario)
        super().__init__(
            f"{__name__}:{main.__name__}",
            {"folder": folder.name},
            folder,
            sumo_environment(),
            cwd=folder.name,
            log=Path(os.devnull),  # SUMO's warnings
        )

    def do(self, action: str, patience_s: float = START_S, **values: Any) -> Answer:
        """Have the process do something.

        Args:
            action: name of a method of `Server`.
            patience_s: time that the process has.
            values: arguments of the method.

        Raises:
            ProcessDiedError: if there is no answer in time, or the process is gone.
            UserError: if it cannot do it.
        """
        self.send(msgspec.msgpack.encode((action, values)))
        content = self.receive(patience_s, "took too long for a question")
        answer = msgspec.msgpack.decode(content, type=Answer)
        if answer.refused:
            self.kill()
            lines = self.output.lines()
            raise UserError(lines[0].removeprefix("Error: ") if lines else answer.refused)
        return answer


def main(settings: Mapping[str, Any]) -> None:
    """Serve clients, one after the other, until the parent ends."""
    limits = {"RLIMIT_DATA": MOST_MEMORY_BYTES, "RLIMIT_FSIZE": MOST_FILE_BYTES}
    connection, server = connected(settings, **limits), Server(Path(settings["folder"]))
    with suppress(EOFError, OSError):
        while True:
            action, values = msgspec.msgpack.decode(connection.recv_bytes())
            connection.send_bytes(msgspec.msgpack.encode(server.answer(action, values)))


class Server:
    """Serves one client at a time; its public methods are the requests of the parent."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._sumo: MirrorSimulation | None = None
        self._listener: socket.socket | None = None
        self._client: socket.socket | None = None
        self._notes: list[str] = []

    def answer(self, action: str, values: Mapping[str, Any]) -> Answer:
        """Return the answer to a request."""
        try:
            answer: Answer = getattr(self, action)(**values)
        except FaultError as fault:
            answer = Answer(fault=str(fault), gone=fault.gone)
        except ClosedError:
            answer = Answer(closed=True)
        except UserError as error:
            return Answer(refused=str(error))
        answer.notes, self._notes = self._notes, []
        if self._client is not None:
            answer.notes += self._session.notes
            answer.in_vain = sorted(self._session.in_vain)
        return answer

    def listen(self, port: int) -> Answer:
        """Listen at a port of this machine, 0 for any; `UserError` where that cannot be."""
        if self._listener is None:
            try:
                self._listener = socket.create_server((HOST, port))
            except OSError as error:
                raise UserError(
                    f"cannot listen on {HOST}:{port} ({error.strerror}): choose another port, "
                    "traci:PORT"
                ) from error
        return Answer(port=int(self._listener.getsockname()[1]))

    def accept(self, wait_s: float, deadline_s: float) -> Answer:
        """Wait for a client of this user; it replaces the one before, on an empty road.

        Args:
            wait_s: time to wait.
            deadline_s: time that the client has for each of its steps.
        """
        if self._sumo is None:
            self._sumo = MirrorSimulation(self._folder)
        assert self._listener is not None, "listening"  # noqa: S101
        self._listener.settimeout(wait_s)
        try:
            connection, _ = self._listener.accept()
        except OSError:
            return Answer()
        user = user_of(connection)
        if KNOWS_USERS and user != os.geteuid():
            connection.close()
            self._notes.append(
                f"a process of the user {user} connected to the port of the controller and was "
                "not served"
            )
            return Answer()
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._close_client()
        self._sumo.load()
        self._client, self._session = connection, Session(self._sumo)
        self._deadline_s = deadline_s
        self._commands: deque[Command] = deque()
        self._reply = b""
        self._until_step_s: float | None = None
        """Time up to which the client asked to step, if it waits for a step; 0 for one step."""
        return Answer(accepted=True)

    def drop(self) -> Answer:
        """Close the port and the connection of the client."""
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        self._close_client()
        return Answer()

    def _close_client(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None

    def step(self, states: Mapping[str, State], *, merged: bool, seed: int | None = None) -> Answer:
        """Show the next state, and serve the client until it makes its next step.

        Args:
            states: states of the vehicles.
            merged: whether the VUT has left the acceleration lane.
            seed: seed of the episode, where this is its first state.

        Raises:
            FaultError: if the client does something wrong.
            ClosedError: if it says goodbye before the vehicles depart.
        """
        session = self._session
        if seed is None:
            session.put(states, merged=merged)
        else:
            if session.sumo.at_m:
                # The step in which they arrive was made when the client asked for it.
                session.clear()
                self._answer_step()
            self._serve_until_step()
            session.enter(states, seed)
        self._answer_step()
        self._serve_until_step()
        v_mps, sumo = session.step(), session.sumo
        return Answer(v_mps=v_mps, merge=sumo.wants_to_merge, by_sumo=sumo.by_sumo)

    def farewell(self) -> Answer:
        """Show the last arrival, with no vehicle to come, and give the client time to close."""
        session = self._session
        session.expected = False
        for _ in range(FAREWELL_STEPS):
            if session.sumo.at_m:
                session.clear()
            else:
                session.step()
            if self._until_step_s is not None:
                self._until_step_s = 0.0  # the time that it asked for will not come
            self._answer_step()
            self._serve_until_step(ENDING_S)
        return Answer()

    def _answer_step(self) -> None:
        """Answer the step that the client waits for, unless it asked to step on further."""
        until_s = self._until_step_s
        if until_s is None or until_s > self._session.sumo.time_s + ROUNDING_S:
            return
        self._until_step_s = None
        self._reply += status(STEP) + self._session.results()
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
                    f"the controller sent command 0x{command.identifier:02x} that is not TraCI: "
                    f"{error}"
                ) from error
            except NotFiniteError as error:
                raise FaultError(f"the controller commanded {error}") from error
            until += monotonic() - before_s  # the client waits for SUMO
            if self._until_step_s is None:
                self._flush()

    def _do(self, command: Command) -> None:
        """Answer a command, or note up to when the client wants to step.

        A step to a time of the past is answered at once. Goodbye is a fault where the VUT is on the
        road.
        """
        session, sumo = self._session, self._session.sumo
        if command.identifier == CLOSE:
            self._commands.clear()
            self._reply += status(CLOSE)
            self._flush()
            if VUT_ID in sumo.at_m:
                raise FaultError(
                    "the controller closed the connection during the episode", gone=True
                )
            raise ClosedError
        if command.identifier != STEP:
            self._reply += session.handle(command)
            return
        target_s = Reader(command.payload).number("d")
        session.answered()
        if target_s == 0.0 or target_s > sumo.time_s + ROUNDING_S:
            self._until_step_s = target_s
        elif math.isnan(target_s):
            raise FaultError("the controller stepped to time nan")
        else:
            self._reply += status(STEP) + session.results()

    def _flush(self) -> None:
        """Send the reply once all commands of its message have been answered."""
        if self._commands or not self._reply or self._client is None:
            return
        content, self._reply = message(self._reply), b""
        self._client.settimeout(self._deadline_s)
        try:
            self._client.sendall(content)
        except TimeoutError as error:
            raise FaultError(
                f"the controller took no answer within {self._deadline_s:g} s"
            ) from error
        except OSError as error:
            raise FaultError("the controller closed the connection", gone=True) from error

    def _receive(self, until: float) -> list[Command]:
        """Return the commands of a message that comes before a time."""
        try:
            length = message_length(self._read(4, until, "made no step"))
            return commands_of(self._read(length, until, "sent half a message and no more"))
        except ProtocolError as error:
            raise FaultError(f"the controller sent bytes that are not TraCI: {error}") from error

    def _read(self, count: int, until: float, late: str) -> bytes:
        """Return `count` bytes that come before a time; `late` is the fault if they do not."""
        content = b""
        assert self._client is not None, "accepted"  # noqa: S101
        while len(content) < count:
            left_s = until - monotonic()
            try:
                if left_s <= 0.0:
                    raise TimeoutError
                self._client.settimeout(left_s)
                part = self._client.recv(count - len(content))
            except TimeoutError as error:
                raise FaultError(
                    f"the controller {late} within the deadline of {self._deadline_s:g} s"
                ) from error
            except OSError as error:
                raise FaultError("the controller broke the connection", gone=True) from error
            if not part:
                raise FaultError("the controller closed the connection", gone=True)
            content += part
        return content


def user_of(connection: socket.socket) -> int | None:
    """Return the user of the other end of a local connection; None where it is gone."""
    ends = []
    for host, port in (connection.getpeername(), connection.getsockname()):
        address = int.from_bytes(socket.inet_aton(host), sys.byteorder)
        ends.append((f"{address:08X}", f":{port:04X}"))
    for table, mapped in (("tcp", ""), ("tcp6", f"{0:016X}{socket.htonl(0xFFFF):08X}")):
        local_and_remote = [f"{mapped}{host}{port}" for host, port in ends]
        with suppress(OSError), Path("/proc/self/net", table).open() as rows:
            for row in rows:
                columns = row.split()
                if columns[1:3] == local_and_remote and columns[9] != "0":
                    return int(columns[7])
    return None
