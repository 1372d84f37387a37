"""A VUT by TraCI: a controller written for SUMO, in any language, drives the vehicle `vut`.

A child process (`server.py`) serves it by a second SUMO, in which its commands have SUMO's meaning.
"""

from __future__ import annotations

import math
import os
import socket
import sys
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np

from merge_sumo.controllers.controller import ControllerDriver, Start
from merge_sumo.controllers.process import (
    ENDING_S,
    ProcessDiedError,
    Program,
    code_of,
    split_command,
)
from merge_sumo.controllers.spec import ControllerKind
from merge_sumo.controllers.traci.server import FaultError, Reply, ServerProcess
from merge_sumo.drivers.acceleration_lane import speed_to_stop_mps
from merge_sumo.drivers.base import MERGE, STAY, Driver, EpisodesLostError, Scene
from merge_sumo.errors import UserError
from merge_sumo.files import check_code
from merge_sumo.road.road import Road
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import DT_S, VEHICLES, VUT, Scenario
from merge_sumo.sumo.sumo_simulation import SumoSimulation

HOST = "127.0.0.1"
DEFAULT_PORT = 8813
"""Port of TraCI clients by default."""
KNOWS_USERS = sys.platform == "linux"
"""Whether the system tells the user of a connection; on others the first client is served."""
LOOK_S = 0.1
"""Time between two checks whether a program that has not connected has ended."""
START_S = 60.0
"""Time for the serving process to start, also on a slow machine."""
WORK_S = 10.0
"""Time for SUMO to answer a controller in a step, in addition to the deadline."""


class TraciKind(ControllerKind):
    """A TraCI client: `traci`, `traci:PORT` or `traci:COMMAND`.

    A command gets a port of its own, so several can run at a time.

    Attributes:
        command: starts the client; None where the user does.
        port: port at which a client connects; 0 for any free one.
    """

    form = "traci:COMMAND or traci[:PORT]"
    what = "a program in any language that drives `vut` by TraCI; without a command, you start it"
    example = '--vut "traci:python my_controller.py {port}"'
    has_parameters, files_are_known = False, False
    no_parameters = "a TraCI client is a program with parameters of its own"
    max_corridors = 1
    no_pov = (
        "a TraCI client drives only the vehicle vut; choose a POV in Python, an FMU, a network or "
        "sumo:MODEL"
    )

    def load(self) -> None:
        """Read the port or the command.

        Raises:
            UserError: for an invalid port or command, and for code that others may write.
        """
        argument = self.spec.argument
        self.command, self.port = None, 0
        if self.waits(argument):
            self.port = int(argument or DEFAULT_PORT)
            if not 1 <= self.port <= 65535:
                raise UserError(f"{self.spec}: the port must be a number from 1 to 65535")
            self.max_workers = 1
        else:
            self.command = split_command(argument)
            self.code = code_of(self.command)
        for file in self.code:
            check_code(file)

    @classmethod
    def waits(cls, argument: str) -> bool:
        """Return whether the user starts the client: without a command, at most with a port.

        Args:
            argument: argument of a spec.
        """
        return not argument or argument.isdecimal()

    def driver(self, _corridors: int, simulation: object) -> Driver:
        """Return a driver in a simulation of SUMO.

        Args:
            _corridors: 1.
            simulation: a `SumoSimulation`.

        Raises:
            UserError: without one, or if no client connects in time.
        """
        if not isinstance(simulation, SumoSimulation):
            raise UserError(f"{self.spec} drives only in a SUMO simulation")
        return TraciDriver(self, simulation.road, simulation.scenario)


class TraciDriver(ControllerDriver):
    """Drives as a TraCI client commands; one client has one vehicle `vut`, so one corridor.

    Each `simulationStep` of the client is a step of the rollout. The speed that SUMO gives the VUT
    becomes the acceleration of eq. (4), and the lane of the VUT in SUMO becomes the merge request.
    Between two episodes the road is empty for one step.
    """

    def __init__(self, kind: TraciKind, road: Road, scenario: Scenario) -> None:
        """Start the command, or wait for a client.

        Args:
            kind: the command or the port, deadlines and the log.
            road: the road of the vehicles.
            scenario: their number, lengths and limits.

        Raises:
            UserError: if no client connects in time.
        """
        super().__init__(1)
        self._kind, self._options = kind, kind.options
        self._road, self._scenario = road, scenario
        self._server = ServerProcess(road, scenario)
        self._begins_m = np.full(scenario.vehicles, -road.mainline.before_m)
        self._begins_m[VUT] = -road.ramp.before_m
        self._listener: socket.socket | None = None
        self._client: socket.socket | None = None
        self._program: Program | None = None
        self._in_vain: set[str] = set()
        self._before_mps: dict[str, float] = {}
        """Speeds of the vehicles a step ago."""
        self._seed: int | None = None
        """Seed of an episode that begins."""
        self._patience_s = self._options.connect_s
        try:
            self._connect()
        except BaseException as error:
            self.close()
            if isinstance(error, FaultError | EpisodesLostError):
                raise UserError(str(error)) from error
            raise

    def reset(self, corridor: int, start: Start) -> None:
        """Note that the next scene is the first of an episode.

        Args:
            corridor: 0.
            start: first observation of the episode.
        """
        self._seed = start.seed
        self._reasons.clear()
        self._before_mps.clear()
        self._in_vain.clear()

    def act(self, scene: Scene) -> FloatArray:
        """Return the acceleration that follows from the client's commands, m/s2, or NaN.

        Args:
            scene: the state of the corridor.

        Raises:
            EpisodesLostError: if the serving process has ended.
        """
        if not self._reasons:
            try:
                return np.array([self._acceleration_mps2(scene)])
            except FaultError as error:
                self._reasons[0] = str(error)
                self._disconnect()
        return np.array([math.nan])

    def in_vain(self, corridor: int) -> Collection[str]:
        """Return the commands of the client that changed nothing in this episode.

        Args:
            corridor: 0.
        """
        return self._in_vain

    def close(self) -> None:
        """Let the client see the last arrival and end; then end it."""
        ends = True
        if self._client is not None:
            with suppress(FaultError, EpisodesLostError):
                ends = self._ask("farewell").closed
        self._disconnect(grace=ends)
        self._server.kill()

    def _acceleration_mps2(self, scene: Scene) -> float:
        """Show the vehicles, and return the acceleration that the client commands."""
        # A car that is not sensed may be shown farther away than the road begins.
        x_m = np.maximum(scene.x_m[:, 0], self._begins_m).tolist()
        v_mps = scene.v_mps[:, 0].tolist()
        states = {}
        for name, x, v in zip(VEHICLES, x_m, v_mps, strict=False):
            states[name] = x, v, (v - self._before_mps.get(name, v)) / DT_S
            self._before_mps[name] = v
        merged = scene.merged is not None and bool(scene.merged[0])
        reply = self._step(self._seed, states=states, merged=merged)
        self._seed = None
        if scene.merged is not None:
            self._merge_requests = np.array([MERGE if reply.merge else STAY], dtype=np.int8)
        wanted_mps = reply.v_mps
        if wanted_mps is None:  # it is beyond the end of the net: it keeps its speed
            return 0.0
        if self._scenario.lane_m is not None and reply.by_sumo and not (merged or reply.merge):
            # As in `SumoDriver`: by eq. (4) SUMO's driver would come a little beyond the end.
            next_m = np.array(x_m[VUT] + v_mps[VUT] * DT_S)
            wanted_mps = min(wanted_mps, float(speed_to_stop_mps(next_m, self._scenario)))
        return float((wanted_mps - v_mps[VUT]) / DT_S)

    def _step(self, seed: int | None, **values: Any) -> Reply:
        """Make a step, by the client that is connected or by a new one.

        A controller may run once per episode: a goodbye on an empty road is not a fault.
        """
        for _ in range(2):
            if self._client is None:
                self._connect()
            reply = self._ask("step", seed=seed, **values)
            if seed is None or not reply.closed:
                return reply
            self._client = None
        raise FaultError("the controller closed the connection before the vehicles departed")

    def _ask(self, action: str, patience_s: float = 0.0, **values: Any) -> Reply:
        """Return the reply of the serving process.

        Raises:
            FaultError: the client made a mistake.
            EpisodesLostError: the process has ended.
        """
        patience_s += self._options.deadline_s + WORK_S
        try:
            reply = self._server.request(action, patience_s, **values)
        except ProcessDiedError as died:
            reason = f"SUMO, which answers the controller, stopped: {died}"
            # Killed from outside, or by a question of the client: the case runs again, which shows.
            self._disconnect()
            raise EpisodesLostError(reason) from died
        self._in_vain.update(reply.in_vain)
        if not reply.fault or reply.closed:
            return reply
        text = reply.fault
        if self._program is not None and (ended := self._program.ended(0.5)):
            text += f"; {ended}"
        raise FaultError(text)

    def _connect(self) -> None:
        """Wait for a client, with a program started again if there is a command.

        A program that closed its connection may connect again, and has as long as for a step.
        """
        patience_s = self._patience_s
        # A client that did not come once is not waited for as long again.
        self._patience_s = min(patience_s, self._options.deadline_s)
        if not self._server.alive:
            self._server = ServerProcess(self._road, self._scenario)
        if self._listener is None:
            try:
                self._listener = socket.create_server((HOST, self._kind.port))
            except OSError as error:
                raise UserError(
                    f"cannot listen on {HOST}:{self._kind.port} ({error.strerror}): choose another "
                    "port, traci:PORT"
                ) from error
        if self._program is not None and not self._accept(self._options.deadline_s):
            self._program.stop(ENDING_S)
        if self._client is None:
            port: int = self._listener.getsockname()[1]
            if self._kind.command is not None:
                self._program = Program(self._kind.command, port, self._options.log)
            else:
                sys.stderr.write(
                    f"waiting up to {patience_s:g} s for a TraCI client on {HOST}:{port}\n"
                )
            if not self._accept(patience_s):
                reason = f"no TraCI client connected to {HOST}:{port} in {patience_s:g} s"
                if self._program is not None:
                    reason += (
                        ": the command receives the port as {port} and in MERGE_SUMO_PORT; pass it "
                        "to traci.init(PORT) or traci.start(..., port=PORT)"
                    )
                    if ended := self._program.ended(0.0):
                        reason = f"{ended} (before it connected)"
                raise FaultError(reason)
        self._patience_s = self._options.connect_s

    def _accept(self, patience_s: float) -> bool:
        """Return whether a client of this user connects; a program that ends is not waited for."""
        assert self._listener is not None, "listening"  # noqa: S101
        self._listener.settimeout(LOOK_S)
        until = monotonic() + patience_s
        while True:
            with suppress(OSError):
                client, _ = self._listener.accept()
                if not KNOWS_USERS or users_of(client) == {os.geteuid()}:
                    client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    self._client = client
                    deadline_s = self._options.deadline_s
                    self._ask("serve", START_S, client=client, deadline_s=deadline_s)
                    return True
                client.close()
            if monotonic() > until or (self._program and self._program.ended(0.0)):
                return False

    def _disconnect(self, *, grace: bool = False) -> None:
        """End the program, then close the port and the connection.

        In this order: a client that is ended while it waits does not complain of it.
        """
        if self._program is not None:
            self._program.stop(ENDING_S if grace else 0.0)
            self._program = None
        if self._client is not None:
            with suppress(OSError):  # it is closed
                self._client.shutdown(socket.SHUT_RDWR)
            self._client = None
        if self._listener is not None:
            self._listener.close()
            self._listener = None


def users_of(client: socket.socket) -> set[int]:
    """Return the users who connect from the port of a client to the port of its server.

    Other addresses of this machine may have the same ports, so there may be several.

    Args:
        client: the connection, as its server has it.

    Returns:
        Their numbers; empty if the client is gone.
    """
    users = set()
    ports = [f"{port:04X}" for _, port in (client.getpeername()[:2], client.getsockname()[:2])]
    for table in ("tcp", "tcp6"):
        with suppress(OSError), Path("/proc/self/net", table).open() as rows:
            for row in rows:
                _, local, remote, *columns = row.split()
                ends = [local.rpartition(":")[2], remote.rpartition(":")[2]]
                if ends == ports and columns[6] != "0":  # its inode
                    users.add(int(columns[4]))
    return users
