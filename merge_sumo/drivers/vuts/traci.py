"""A VUT behind TraCI: a controller written for SUMO, in any language, drives the vehicle `vut`.

This process is the server. A client makes a step by `simulationStep`, so client and rollout go in
lockstep: its step is answered when ours has been made, and the speed that it commanded before
becomes the acceleration of eq. (4). Between two episodes the road is empty for one step.
"""

from __future__ import annotations

import math
import socket
import sys
from contextlib import suppress
from pathlib import Path
from time import monotonic
from typing import Final

import numpy as np

from merge_sumo.drivers.base import Driver, Scene
from merge_sumo.drivers.vuts.base import Seen, Vut, VutOptions, seen_in
from merge_sumo.drivers.vuts.process import Program, split_command
from merge_sumo.drivers.vuts.traci_client import Client, ClosedError, FaultError, LateError
from merge_sumo.drivers.vuts.traci_session import Session
from merge_sumo.errors import UserError
from merge_sumo.sumo.corridor import Corridor
from merge_sumo.sumo.road import road_of
from merge_sumo.sumo.world import World
from merge_sumo.values.case import Case, FloatArray
from merge_sumo.values.scenario import DT_S, POV, US23, Scenario

HOST: Final = "127.0.0.1"
DEFAULT_PORT: Final = 8813
"""Where TraCI clients connect when they are not told otherwise."""


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
        self._client: Client | None = None
        self._reason: str | None = None
        self._noted: set[str] = set()
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
                if isinstance(error, LateError) and self._another_waits():
                    self._reason += "; another client waits, but one at a time is served"
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
                self._client.close()
                self._client = None
                if attempt == 2:
                    raise FaultError(
                        "the controller closed the connection before the vehicles departed"
                    ) from None
            else:
                return

    def _connect(self) -> None:
        """Wait for a client, with a program started anew if there is a command.

        A program that closed its connection may connect again, and has as long as for a step.
        """
        patience_s = self._patience_s
        # Who did not come once is not waited for as long again.
        self._patience_s = min(patience_s, self._options.deadline_s)
        if self._listener is None:
            self._listener = _listen(self._port)
        port = self._listener.getsockname()[1]
        connection = None
        if self._program is not None:
            connection = self._accept(self._listener, self._options.deadline_s)
            if connection is None:
                self._drop_client(grace=True)
        if connection is None:
            if self._command is not None:
                self._program = Program(self._command, port, self._options.log)
            else:
                sys.stderr.write(
                    f"waiting up to {patience_s:g} s for a TraCI client on {HOST}:{port}\n"
                )
            connection = self._accept(self._listener, patience_s)
        if connection is None:
            ended = self._program.ended(0.0) if self._program else ""
            self._disconnect()
            late = f"no TraCI client connected to {HOST}:{port} in {patience_s:g} s"
            if self._command is not None:
                late += (
                    ": --vut-command is told the port as {port} and in MERGE_SUMO_PORT, "
                    "for traci.init(PORT) or traci.start(..., port=PORT)"
                )
            raise FaultError(f"{ended} (before it connected)" if ended else late)
        self._patience_s = self._options.connect_s
        session = Session(self._road, self._scenario, note=self._note)
        self._client = Client(connection, session, self._options.deadline_s, self._program)

    def _accept(self, listener: socket.socket, patience_s: float) -> socket.socket | None:
        """Return the next connection; None when none comes, or the program has ended."""
        until = monotonic() + patience_s
        while True:
            # A program that ended will not connect any more: look every now and then.
            listener.settimeout(max(min(0.1, until - monotonic()), 0.001))
            try:
                return listener.accept()[0]
            except TimeoutError:
                if monotonic() > until or (self._program and self._program.ended(0.0)):
                    return None

    def _note(self, sentence: str) -> None:
        """Add a sentence to what the controller printed, once for all the times it is started."""
        if sentence in self._noted:
            return
        self._noted.add(sentence)
        log = self._options.log
        if log is None:
            sys.stderr.write(f"note: {sentence}\n")
            return
        with suppress(OSError), log.open("a", encoding="utf-8") as file:
            file.write(f"note: {sentence}\n")

    def _another_waits(self) -> bool:
        """Return whether a client has connected besides the one that is served."""
        if self._listener is None:
            return False
        self._listener.settimeout(0.0)
        with suppress(OSError):
            self._listener.accept()[0].close()
            return True
        return False

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
