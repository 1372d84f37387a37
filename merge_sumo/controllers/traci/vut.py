"""A VUT behind TraCI: a controller written for SUMO, in any language, drives the vehicle `vut`.

A process with a second SUMO serves it (`child.py`), in which its commands mean what they mean in
SUMO. A client makes a step by `simulationStep`, so client and rollout go in lockstep: the speed
that SUMO gives the VUT in that step becomes the acceleration of eq. (4), the lane on which SUMO has
it says whether it wants to merge, and the step is answered when the rollout has made it. Between
two episodes the road is empty for one step.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np

from merge_sumo.controllers.process import (
    ENDING_S,
    ProcessDiedError,
    Program,
    append,
    code_of,
    split_command,
)
from merge_sumo.controllers.spec import ControllerKind, ControllerOptions, ControllerSpec
from merge_sumo.controllers.traci.child import HOST, START_S, WORK_S, Answer, Child, FaultError
from merge_sumo.drivers.actuation import ROUNDING_MPS2
from merge_sumo.drivers.base import MERGE, STAY, Driver, Scene, VutLostError
from merge_sumo.drivers.lane import END_MARGIN_M, stopping_mps
from merge_sumo.errors import UserError
from merge_sumo.files import check_code
from merge_sumo.road.corridor import Corridor
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S, VEHICLES, VUT, Scenario
from merge_sumo.sumo.world import World

DEFAULT_PORT = 8813
"""Port of TraCI clients that are given no other."""
LOOK_S = 0.1
"""Time between two looks whether a program that is waited for has ended."""


class TraciKind(ControllerKind):
    """`traci`, `traci:PORT` or `traci:COMMAND`.

    A command gets its port as an argument: any free one will do, and several can run at a time.
    """

    form = "traci:COMMAND or traci[:PORT]"
    what = (
        "a program in any language that drives `vut` by TraCI; started by you where no command is "
        "given"
    )
    example = '--vut "traci:python my_controller.py {port}"'
    has_parameters, files_are_known = False, False
    no_parameters = "a TraCI client is a program with parameters of its own"
    max_corridors = 1
    no_pov = (
        "a TraCI client drives the vehicle named vut and no other; bring the POV as Python, an "
        "FMU, a network or sumo:MODEL"
    )

    def __init__(self, spec: ControllerSpec, options: ControllerOptions) -> None:
        """Read the port or the command.

        Raises `UserError` for an invalid port or command, and for code that others may write.
        """
        super().__init__(spec, options)
        self._command, self._port = None, 0
        if is_port(spec.argument):
            self._port = int(spec.argument or DEFAULT_PORT)
            if not 1 <= self._port <= 65535:
                raise UserError(f"{spec}: the port is a number from 1 to 65535")
            self.max_workers = 1
        else:
            self._command = split_command(spec.argument)
            self.code = code_of(self._command)
        for file in self.code:
            check_code(file)

    @classmethod
    def waits(cls, argument: str) -> bool:
        """Return whether an argument names the port at which a user's client is waited for."""
        return is_port(argument)

    def driver(self, _corridors: int, world: object) -> Driver:
        """Return a driver in a world of SUMO."""
        if not isinstance(world, World):
            raise UserError(f"{self.spec} drives in a SUMO world only")
        road, scenario = world.road, world.scenario
        return TraciVut(road, scenario, self._port, self._command, self.options)


def is_port(argument: str) -> bool:
    """Return whether an argument names the port at which the user's client is waited for."""
    return not argument or argument.isdecimal()


class TraciVut(Driver):
    """Drives as a TraCI client commands; one client has one vehicle `vut`, so one corridor."""

    def __init__(
        self,
        road: Corridor,
        scenario: Scenario,
        port: int,
        command: list[str] | None,
        options: ControllerOptions,
    ) -> None:
        """Start the command, or wait for a client.

        Args:
            road: where the vehicles are.
            scenario: their number, lengths and limits.
            port: where a client connects; 0 for any port.
            command: starts the client; None where the user does.
            options: deadlines and the log.

        Raises:
            UserError: if no client connects in time.
        """
        super().__init__(1)
        self._port, self._command, self._options = port, command, options
        self._log = options.log
        self._road, self._scenario = road, scenario
        self._child = Child(road, scenario)
        self._begins_m = np.full(scenario.vehicles, -road.mainline.before_m)
        self._begins_m[VUT] = -road.ramp.before_m
        self._lane_m = scenario.lane_m
        self._limits_mps2 = scenario.a_min_mps2, scenario.a_max_mps2
        self._program: Program | None = None
        self._connected = False
        self._reason: str | None = None
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
        """Return the acceleration that follows from the client's commands, or NaN."""
        if self._reason is None:
            try:
                return np.array([self._acceleration_mps2(scene)])
            except FaultError as error:
                self._reason = str(error)
                self._disconnect()
        return np.array([math.nan])

    def reason(self, corridor: int) -> str | None:
        """Return the fault of the client."""
        return self._reason

    def in_vain(self, corridor: int) -> Collection[str]:
        """Return the commands of the client that changed nothing."""
        return self._in_vain

    def close(self) -> None:
        """Let the client see the last arrival and end; then end it."""
        ends = True
        if self._connected:
            with suppress(FaultError, VutLostError):
                ends = self._ask("farewell").closed
        self._stop_program(grace=ends)
        self._child.kill()

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
        if self._starting:
            self._starting = False
            answer = self._enter(states=states, merged=merged, seed=self._seed)
        else:
            answer = self._ask("step", states=states, merged=merged)
        if self._program is not None and (ended := self._program.ended(0.0)):
            raise FaultError(f"{ended}, and its connection is still open")
        if scene.merged is not None:
            self._wishes = np.array([MERGE if answer.merge else STAY], dtype=np.int8)
        wanted_mps = answer.v_mps
        if wanted_mps is None:  # it is beyond the end of the net: it keeps its speed
            return 0.0
        if self._lane_m is not None and answer.by_sumo and not (merged or answer.merge):
            # As `SumoVut` does: by eq. (4) SUMO's driver would come a little beyond the lane's end.
            room_m = self._lane_m[1] - END_MARGIN_M - (x_m[VUT] + v_mps[VUT] * DT_S)
            stops_mps = stopping_mps(np.array(room_m), -self._limits_mps2[0])
            wanted_mps = min(wanted_mps, float(stops_mps))
        return self._checked((wanted_mps - v_mps[VUT]) / DT_S)

    def _checked(self, acceleration_mps2: float) -> float:
        """Return an acceleration that is finite, and note one outside the limits."""
        if not math.isfinite(acceleration_mps2):
            raise FaultError(f"the controller asked for an acceleration of {acceleration_mps2}")
        low_mps2, high_mps2 = self._limits_mps2
        if not low_mps2 - ROUNDING_MPS2 <= acceleration_mps2 <= high_mps2 + ROUNDING_MPS2:
            self._note(
                f"the speed that the controller reached or set takes an acceleration outside "
                f"{low_mps2:g} to {high_mps2:g} m/s2, the scenario's limits: it is clipped, and "
                "clipped_steps counts such steps up to M"
            )
        return acceleration_mps2

    def _enter(self, **values: Any) -> Answer:
        """Let the vehicles depart, for the client that is connected or for a new one.

        A controller may run once per episode: a goodbye on an empty road is not a fault.
        """
        for _ in range(2):
            if not self._connected:
                self._connect()
            answer = self._ask("step", **values)
            if not answer.closed:
                return answer
            self._connected = False
        raise FaultError("the controller closed the connection before the vehicles departed")

    def _ask(self, action: str, patience_s: float = 0.0, **values: Any) -> Answer:
        """Return the answer of the child process; raises `FaultError` and `VutLostError`."""
        patience_s += self._options.deadline_s + WORK_S
        try:
            answer = self._child.do(action, patience_s, **values)
        except ProcessDiedError as died:
            reason = f"the SUMO that answers the controller {died}"
            if died.hung:
                raise FaultError(reason) from died
            # Killed from outside, or by a question of the client: the case runs again, which shows.
            self._disconnect()
            raise VutLostError(reason) from died
        for note in answer.notes:
            self._note(note)
        self._in_vain.update(answer.in_vain)
        if not answer.fault:
            return answer
        text = answer.fault
        if answer.gone and self._program is not None and (ended := self._program.ended(0.5)):
            text += f"; {ended}"
        raise FaultError(text)

    def _connect(self) -> None:
        """Wait for a client, with a program started again if there is a command.

        A program that closed its connection may connect again, and has as long as for a step.
        """
        patience_s = self._patience_s
        # A client that did not come once is not waited for as long again.
        self._patience_s = min(patience_s, self._options.deadline_s)
        if not self._child.alive:
            self._child = Child(self._road, self._scenario)
        port = self._ask("listen", START_S, port=self._port).port
        if self._program is not None and not self._accept(self._options.deadline_s):
            self._stop_program(grace=True)
        if not self._connected:
            if self._command is not None:
                self._program = Program(self._command, port, self._log)
                self._log = self._log or Path(os.devnull)  # the same text again is not shown
            else:
                sys.stderr.write(
                    f"waiting up to {patience_s:g} s for a TraCI client on {HOST}:{port}\n"
                )
            if not self._accept(patience_s):
                raise FaultError(self._why_none_came(port, patience_s))
        self._patience_s = self._options.connect_s

    def _accept(self, patience_s: float) -> bool:
        """Return whether a client connects; a program that has ended is not waited for."""
        until = monotonic() + patience_s
        while not self._connected:
            wait_s = max(min(LOOK_S, until - monotonic()), 0.001)
            deadline_s = self._options.deadline_s
            answer = self._ask("accept", START_S, wait_s=wait_s, deadline_s=deadline_s)
            self._connected = answer.accepted
            if monotonic() > until or (self._program and self._program.ended(0.0)):
                break
        return self._connected

    def _why_none_came(self, port: int, patience_s: float) -> str:
        """Return why no client is connected, and end what was started."""
        ended = self._program.ended(0.0) if self._program else ""
        self._disconnect()
        if ended:
            return f"{ended} (before it connected)"
        late = f"no TraCI client connected to {HOST}:{port} in {patience_s:g} s"
        if self._command is None:
            return late
        return (
            f"{late}: the command is told the port as {{port}} and in MERGE_SUMO_PORT, for "
            "traci.init(PORT) or traci.start(..., port=PORT)"
        )

    def _note(self, sentence: str) -> None:
        """Add a sentence to the log of the controller, once for all its starts."""
        if sentence in self._noted:
            return
        self._noted.add(sentence)
        if self._options.log is None:
            sys.stderr.write(f"note: {sentence}\n")
        else:
            with suppress(OSError):
                append(self._options.log, f"note: {sentence}\n".encode())

    def _disconnect(self) -> None:
        """End the program, then close the port and the connection.

        In this order: a client that is ended while it waits does not complain of it.
        """
        self._stop_program(grace=False)
        self._connected = False
        with suppress(ProcessDiedError):
            self._child.do("drop", WORK_S)

    def _stop_program(self, *, grace: bool) -> None:
        if self._program is not None:
            self._program.stop(ENDING_S if grace else 0.0)
            self._program = None
