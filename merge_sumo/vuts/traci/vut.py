"""A VUT behind TraCI: a controller written for SUMO, in any language, drives the vehicle `vut`.

This process listens, and looks whose a connection is (`door.py`). A connection that is served is
handed to a process of its own with a shadow SUMO (`server.py`), in which the client's commands mean
what they mean in SUMO. A client makes a step by `simulationStep`, so client and rollout go in
lockstep: the speed that SUMO gives the VUT in that step becomes the acceleration of eq. (4), the
lane on which SUMO has it says whether it wishes to merge, and the step is answered when the rollout
has made it. Between two episodes the road is empty for one step.
"""

from __future__ import annotations

import math
import socket
import sys
from collections.abc import Collection, Mapping
from contextlib import ExitStack, suppress
from time import monotonic
from typing import Any, Final

import numpy as np

from merge_sumo.drivers.actuation import ROUNDING_MPS2
from merge_sumo.drivers.base import MERGE, STAY, Driver, Scene, VutLostError
from merge_sumo.drivers.lane import END_MARGIN_M, stopping_mps
from merge_sumo.errors import UserError
from merge_sumo.road.corridor import Corridor
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S, VEHICLES, VUT, Scenario, lane_of
from merge_sumo.sumo.binding import scratch_folder
from merge_sumo.sumo.child import ChildDiedError, SumoChild
from merge_sumo.sumo.shadow_sumo import write_files
from merge_sumo.sumo.world import World
from merge_sumo.system.trust import check_code
from merge_sumo.vuts.base import Vut, VutKind, VutOptions, VutSpec
from merge_sumo.vuts.process import GRACE_S, Echo, Program, append, code_of, split_command
from merge_sumo.vuts.traci import server
from merge_sumo.vuts.traci.door import HOST, Door
from merge_sumo.vuts.traci.server import FaultError

DEFAULT_PORT: Final = 8813
"""Port of TraCI clients that are given no other."""
START_S: Final = 60.0
"""Time that SUMO has to start, on whatever machine."""
WORK_S: Final = 10.0
"""Time that SUMO has for the questions of a controller in a step, besides the deadline."""


def traci_vut(spec: VutSpec, options: VutOptions) -> Vut:
    """Return the VUT of `traci`, `traci:PORT` or `traci:COMMAND`.

    A command gets its port as an argument: any free one will do, and several can run at a time.
    Raises `UserError` for a port or a command that is none, and for code that others may write.
    """
    command, port = None, 0
    if is_port(spec.argument):
        port = int(spec.argument or DEFAULT_PORT)
        if not 1 <= port <= 65535:
            raise UserError(f"{spec}: the port is a number from 1 to 65535")
    else:
        command = split_command(spec.argument)
    files = code_of(command) if command else ()
    for file in files:
        check_code(file)

    def make(corridors: int, world: object) -> Driver:
        if not isinstance(world, World):
            raise UserError(f"{spec} drives in a SUMO world only")
        return TraciVut(corridors, world.road, world.scenario, port, command, options)

    return Vut(
        make=make,
        max_corridors=1,
        max_workers=None if command else 1,
        files=files,
        no_pov="a TraCI client drives the vehicle named vut and no other; bring the POV as "
        "Python, an FMU, a network or sumo:MODEL",
    )


def is_port(argument: str) -> bool:
    """Return whether an argument names the port at which a person's client is waited for."""
    return not argument or argument.isdecimal()


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
        self._port, self._command, self._options = port, command, options
        self._shadow = Shadow(road, scenario)
        self._begins_m = np.full(scenario.vehicles, -road.mainline.before_m)
        self._begins_m[VUT] = -road.ramp.before_m
        self._lane_m = lane_of(scenario)
        self._limits_mps2 = scenario.a_min_mps2, scenario.a_max_mps2
        self._door: Door | None = None
        self._program: Program | None = None
        self._client: socket.socket | None = None
        self._reason: str | None = None
        self._echo = Echo()
        self._noted: set[str] = set()
        self._in_vain: set[str] = set()
        self._before_mps: dict[str, float] = {}
        """Speeds of the vehicles a step ago."""
        self._starting, self._seed = True, 0
        self._patience_s = options.connect_s
        try:
            self._connect()
        except (FaultError, VutLostError) as error:
            self.close()
            raise UserError(str(error)) from error
        except BaseException:
            self.close()
            raise

    def begin(self, corridor: int, case: Case) -> None:
        """Note that the next scene is the first of an episode."""
        self._reason = None
        self._starting, self._seed = True, case.told_seed
        self._before_mps.clear()
        self._in_vain.clear()

    def act(self, scene: Scene) -> FloatArray:
        """Return the acceleration that follows from what the client commanded, or NaN."""
        if self._reason is None:
            try:
                return np.array([self._acceleration_mps2(scene)])
            except FaultError as error:
                self._reason = str(error)
                self._disconnect()
        return np.array([math.nan])

    def reason(self, corridor: int) -> str | None:
        """Return what the client did wrong."""
        return self._reason

    def in_vain(self, corridor: int) -> Collection[str]:
        """Return what the client commanded in vain."""
        return self._in_vain

    def close(self) -> None:
        """Let the client see the last arrival and end; then end it."""
        ends = True
        if self._client is not None:
            with suppress(FaultError, VutLostError):
                ends = "closed" in self._ask({"do": "farewell"})
        self._disconnect(grace=ends)
        self._shadow.close()
        self._echo.close()

    def _acceleration_mps2(self, scene: Scene) -> float:
        """Show the vehicles, and return what the client commands for the coming step."""
        # A car that is not sensed may be shown farther away than the road begins.
        x_m = np.maximum(scene.x_m[:, 0], self._begins_m).tolist()
        v_mps = scene.v_mps[:, 0].tolist()
        states = {
            name: (x, v, (v - self._before_mps.get(name, v)) / DT_S)
            for name, x, v in zip(VEHICLES, x_m, v_mps, strict=False)
        }
        self._before_mps = dict(zip(VEHICLES, v_mps, strict=False))
        starting, self._starting = self._starting, False
        merged = scene.merged is not None and bool(scene.merged[0])
        message = {"states": states, "merged": merged}
        answer = self._enter(message) if starting else self._ask({"do": "step", **message})
        if self._program is not None and (ended := self._program.ended(0.0)):
            raise FaultError(f"{ended}, and its connection goes on")
        if scene.merged is not None:
            self._wishes = np.array([MERGE if answer["merge"] else STAY], dtype=np.int8)
        wanted_mps = answer["v_mps"]
        if wanted_mps is None:  # it is beyond the end of the net: it keeps its speed
            return 0.0
        if self._lane_m is not None and not (merged or answer["merge"]) and answer["by_sumo"]:
            # As `SumoVut` does: by eq. (4) SUMO's driver would come a little beyond the lane's end.
            room_m = self._lane_m[1] - END_MARGIN_M - (x_m[VUT] + v_mps[VUT] * DT_S)
            wanted_mps = min(
                wanted_mps, float(stopping_mps(np.array(room_m), -self._limits_mps2[0]))
            )
        acceleration_mps2 = (wanted_mps - v_mps[VUT]) / DT_S
        if not math.isfinite(acceleration_mps2):
            raise FaultError(f"the controller asked for an acceleration of {acceleration_mps2}")
        low_mps2, high_mps2 = self._limits_mps2
        possible_mps2 = min(max(acceleration_mps2, low_mps2), high_mps2)
        if abs(acceleration_mps2 - possible_mps2) > ROUNDING_MPS2:
            self._note(
                f"the speed that the controller reached or set takes an acceleration outside "
                f"{low_mps2:g} to {high_mps2:g} m/s2, the scenario's limits: it is clipped, and "
                "clipped_steps counts such steps up to M"
            )
        return float(acceleration_mps2)

    def _enter(self, message: Mapping[str, Any]) -> dict[str, Any]:
        """Let the vehicles depart, for the client that is connected or for a new one.

        A controller may run once per episode: a goodbye on an empty road is no fault.
        """
        for _ in range(2):
            if self._client is None:
                self._connect()
            answer = self._ask({"do": "enter", "seed": self._seed, **message})
            if "closed" not in answer:
                return answer
            # The door stays open: the next client may be waiting already.
            self._drop_client()
        raise FaultError("the controller closed the connection before the vehicles departed")

    def _ask(self, message: Mapping[str, Any]) -> dict[str, Any]:
        """Return what the serving process answers; raises `FaultError`."""
        try:
            answer = self._shadow.ask(message, self._options.deadline_s + WORK_S)
        except ChildDiedError as died:
            # Killed from outside, or by a question of the client: the case runs again, which shows.
            self._disconnect()
            raise VutLostError(
                f"the SUMO that answers the controller {died}", killed=died.killed
            ) from died
        except TimeoutError as error:
            raise FaultError(
                "the SUMO that answers the controller did not come to an end with what it asked"
            ) from error
        for note in answer.get("notes", ()):
            self._note(note)
        self._in_vain.update(answer.get("in_vain", ()))
        if "fault" not in answer:
            return answer
        text = str(answer["fault"])
        if answer["gone"] and self._program is not None and (ended := self._program.ended(0.5)):
            text += f"; {ended}"
        raise FaultError(text)

    def _connect(self) -> None:
        """Wait for a client, with a program started anew if there is a command.

        A program that closed its connection may connect again, and has as long as for a step.
        """
        patience_s = self._patience_s
        # A client that did not come once is not waited for as long again.
        self._patience_s = min(patience_s, self._options.deadline_s)
        if self._door is None:
            self._door = Door(self._port, self._note)
        connection = None
        if self._program is not None:
            connection = self._accept(self._door, self._options.deadline_s)
            if connection is None:
                self._stop_program(grace=True)
        self._shadow.start()
        if connection is None:
            port = self._door.port
            if self._command is not None:
                self._program = Program(self._command, port, self._options.log, self._echo)
            else:
                sys.stderr.write(
                    f"waiting up to {patience_s:g} s for a TraCI client on {HOST}:{port}\n"
                )
            connection = self._accept(self._door, patience_s)
        if connection is None:
            ended = self._program.ended(0.0) if self._program else ""
            late = f"no TraCI client connected to {HOST}:{self._door.port} in {patience_s:g} s"
            if self._command is not None:
                late += (
                    ": the command is told the port as {port} and in MERGE_SUMO_PORT, for "
                    "traci.init(PORT) or traci.start(..., port=PORT)"
                )
            self._disconnect()
            raise FaultError(f"{ended} (before it connected)" if ended else late)
        self._patience_s = self._options.connect_s
        self._client = connection
        try:
            self._shadow.serve(connection, self._options.deadline_s)
        except (ChildDiedError, TimeoutError) as error:
            self._shadow.close()  # also where it did not get ready
            self._disconnect()
            raise FaultError(f"the SUMO that answers the controller failed: {error}") from error

    def _accept(self, door: Door, patience_s: float) -> socket.socket | None:
        """Return the connection to serve; None when none comes, or the program has ended."""
        until = monotonic() + patience_s
        peer = None if self._program is None else self._program.process
        while True:
            # A program that ended will not connect any more, which is checked in between.
            connection = door.accept(peer, max(min(0.1, until - monotonic()), 0.001))
            if connection is not None:
                return connection
            if monotonic() > until or (self._program and self._program.ended(0.0)):
                return None

    def _note(self, sentence: str) -> None:
        """Add a sentence to what the controller printed, once for all the times it is started."""
        if sentence in self._noted:
            return
        self._noted.add(sentence)
        if self._options.log is None:
            sys.stderr.write(f"note: {sentence}\n")
        else:
            with suppress(OSError):
                append(self._options.log, f"note: {sentence}\n".encode())

    def _disconnect(self, *, grace: bool = False) -> None:
        """Close the door, end the program and drop the client."""
        if self._door is not None:
            self._door.close()
            self._door = None
        # The connection closes last: a client that is ended while it waits says nothing of it.
        self._stop_program(grace=grace)
        self._drop_client()

    def _stop_program(self, *, grace: bool) -> None:
        if self._program is not None:
            self._program.stop(GRACE_S if grace else 0.0)
            self._program = None

    def _drop_client(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None
            with suppress(ChildDiedError, TimeoutError):
                self._shadow.ask({"do": "drop"}, WORK_S)


class Shadow:
    """The process with the shadow SUMO that serves clients; started anew when it has ended."""

    def __init__(self, road: Corridor, scenario: Scenario) -> None:
        """Take what it shows; `start` starts it."""
        self._road, self._scenario = road, scenario
        self._opened = ExitStack()
        self._child: SumoChild | None = None
        self._ready = False

    def start(self) -> None:
        """Start it, if it does not run; it gets ready while the controller starts."""
        if self._child is not None:
            return
        with ExitStack() as opened:
            folder = opened.enter_context(scratch_folder())
            write_files(folder, self._road, self._scenario)
            self._child = SumoChild(f"{server.__name__}:{server.main.__name__}", folder, {})
            opened.callback(self._child.kill)
            self._opened = opened.pop_all()

    def serve(self, connection: socket.socket, deadline_s: float) -> None:
        """Hand a connection over to it; raises `UserError` where SUMO cannot use the net."""
        if not self._ready and self._child is not None:
            message = self._child.receive(START_S)
            if "refused" in message:
                why = self._child.said() or message["refused"]
                raise UserError(f"SUMO cannot use the net {self._road.path}: {why}")
            self._ready = True
        self.ask({"do": "connect", "deadline_s": deadline_s}, WORK_S, connection)

    def ask(
        self,
        message: Mapping[str, Any],
        patience_s: float,
        connection: socket.socket | None = None,
    ) -> dict[str, Any]:
        """Return its answer; raises `ChildDiedError`, or TimeoutError where there is none.

        Without an answer it is ended: a person may stop this process before.
        """
        if self._child is None:
            raise ChildDiedError("is not there")
        try:
            return self._child.ask(message, patience_s, connection)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End it."""
        self._child, self._ready = None, False
        self._opened.close()


KIND: Final = VutKind(
    form="traci:COMMAND or traci[:PORT]",
    what="a program in any language that drives `vut` by TraCI; started by you where no "
    "command is given",
    example='--vut "traci:python my_controller.py {port}"',
    prepare=traci_vut,
    has_parameters=False,
    no_parameters="a TraCI client is a program with parameters of its own",
    files_are_known=False,
    waits=is_port,
)
