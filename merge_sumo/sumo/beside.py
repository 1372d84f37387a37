"""A SUMO of its own beside ours, with the net as it is: it answers what a controller may ask.

Ours hosts copies of two lanes under other names. This one has all of the road by the ids of the
file, and the vehicles are put where they are after every step; a question is passed on to it byte
by byte, so the answer is SUMO's.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from typing import Any, Final

from lxml import etree

from merge_sumo.errors import UserError
from merge_sumo.sumo import allowed, received
from merge_sumo.sumo.binding import scratch_folder
from merge_sumo.sumo.client import end_program, load_traci, open_program
from merge_sumo.sumo.corridor import Corridor, LanePath
from merge_sumo.values.scenario import DT_S, VEHICLES, VUT, Scenario

NET: Final = "road.net.xml"
TYPES: Final = "types.add.xml"
OPTIONS: Final = (
    *("--step-length", str(DT_S)),
    *("--collision.action", "none"),
    *("--insertion-checks", "none"),
    *("--time-to-teleport", "-1"),
    *("--default.speeddev", "0"),
    *("--xml-validation", "never"),
    *("--no-step-log", "true"),
    *("--no-warnings", "true"),
    *("--duration-log.disable", "true"),
)
COMMANDED: Final = 32
"""Speed mode without SUMO's own checks."""
PATIENCE_S: Final = 10.0
COLOURS: Final = (230, 64, 38, 255), (26, 89, 230, 255)
"""Of the cars of the mainline, and of the VUT."""
WIDTH_M: Final = 1.8
HEIGHT_M: Final = 1.5

State = tuple[float, float, float]
"""Position along the lanes in m, M = 0; speed in m/s; acceleration of the last step in m/s2."""


class GoneError(Exception):
    """This SUMO is gone: it was asked something that ended it."""


class Beside:
    """A SUMO program with the road of a scenario and its vehicles."""

    def __init__(self, road: Corridor, scenario: Scenario, vehicles: int) -> None:
        """Start it; `UserError` when it does not start on this net."""
        self._road = road
        self._traci = load_traci()
        self._errors = self._traci.TraCIException, self._traci.FatalTraCIError, OSError
        with ExitStack() as opened:
            stage = opened.enter_context(scratch_folder())
            name = f"the net {road.path}"
            content = received.read_bytes(
                road.path, "the net", follow_links=True, limit=received.MAX_NET_BYTES
            )
            (stage / NET).write_bytes(received.cleaned(content, allowed.ROAD_NET, name))
            (stage / TYPES).write_bytes(_types(road, scenario, vehicles))
            files = ("--net-file", str(stage / NET), "--additional-files", str(stage / TYPES))
            process, self._connection = open_program("sumo", [*files, *OPTIONS])
            opened.callback(end_program, process)
            for who in VEHICLES[:vehicles]:
                edges = _edges(self._path(who))
                try:
                    self._connection.route.add(f"route.{who}", edges)
                except self._errors as error:
                    raise UserError(f"SUMO cannot use {name}: {error}") from error
            self._opened = opened.pop_all()
        self._there: set[str] = set()
        self._beyond: set[str] = set()
        self._dead = False

    def show(self, states: Mapping[str, State]) -> None:
        """Make a step, after which the vehicles are in these states; those not named arrive.

        So does who is beyond the end of the net, where paths go on without a road.
        """
        if self._dead:
            return
        vehicle = self._connection.vehicle
        self._beyond &= states.keys()
        try:
            for name in self._there - states.keys():
                vehicle.remove(name)
            for name in states.keys() - self._there - self._beyond:
                vehicle.add(name, f"route.{name}", typeID=name, **self._start(name, states[name]))
                vehicle.setColor(name, COLOURS[name == VEHICLES[VUT]])
            self._there = states.keys() - self._beyond
            self._connection.simulationStep()
            for name in [name for name in states if name in self._there]:
                try:
                    self._place(name, *states[name])
                except self._traci.TraCIException:
                    with suppress(self._traci.TraCIException):  # it may have arrived by itself
                        vehicle.remove(name)
                    self._there.discard(name)
                    self._beyond.add(name)
        except self._errors:
            self._dead = True  # somebody ended it

    def _place(self, name: str, x_m: float, v_mps: float, a_mps2: float) -> None:
        """Put a vehicle where it is."""
        vehicle = self._connection.vehicle
        point = self._road.lane_point(x_m, on_ramp=name == VEHICLES[VUT])
        vehicle.setSpeedMode(name, COMMANDED)
        vehicle.setLaneChangeMode(name, 0)
        vehicle.moveTo(name, point.lane, point.position_m)
        vehicle.setPreviousSpeed(name, v_mps, a_mps2)
        vehicle.setSpeed(name, v_mps)

    def _start(self, name: str, state: State) -> dict[str, str]:
        """Return where a vehicle departs; it can do so on the first edge of its route only."""
        path = self._path(name)
        point = path.point(state[0])
        edge, _, lane = point.lane.rpartition("_")
        # It is told its own speed behind the step; SUMO lets none depart faster than the limit.
        own_mps = self._connection.vehicletype.getMaxSpeed(name)
        fastest_mps = min(path.piece(state[0]).speed_limit_mps, own_mps)
        speed = {"departSpeed": str(min(state[1], fastest_mps))}
        if edge != _edges(path)[0]:
            return {"departLane": "best", **speed}
        return {"departLane": lane, "departPos": str(point.position_m), **speed}

    def ask(self, command: bytes) -> bytes:
        """Return what SUMO answers to one command; raises `GoneError`.

        The command has its own length before it; so have status and answer.
        """
        if self._dead:
            raise GoneError
        wire: Any = self._connection._socket
        try:
            wire.settimeout(PATIENCE_S)
            wire.sendall(struct.pack("!i", len(command) + 4) + command)
            (length,) = struct.unpack("!i", _read(wire, 4))
            return _read(wire, length - 4)
        except (OSError, struct.error) as error:
            self._dead = True
            raise GoneError from error

    def close(self) -> None:
        """End it."""
        self._opened.close()

    def _path(self, who: str) -> LanePath:
        return self._road.ramp if who == VEHICLES[VUT] else self._road.mainline


def _read(wire: socket.socket, count: int) -> bytes:
    content = bytearray()
    while len(content) < count:
        part = wire.recv(count - len(content))
        if not part:
            raise ConnectionError
        content += part
    return bytes(content)


def _edges(path: LanePath) -> list[str]:
    return list(dict.fromkeys(p.lane.rpartition("_")[0] for p in path.pieces if not p.is_internal))


def _types(road: Corridor, scenario: Scenario, vehicles: int) -> bytes:
    root = etree.Element("additional")
    for who in VEHICLES[:vehicles]:
        length_m = scenario.vut_length_m if who == VEHICLES[VUT] else scenario.pov_length_m
        values = {
            "id": who,
            "length": repr(length_m),
            "width": repr(WIDTH_M),
            "height": repr(HEIGHT_M),
            "minGap": "0",
            "maxSpeed": repr(road.speed_limit_mps),
            "accel": repr(scenario.a_max_mps2),
            "decel": repr(-scenario.a_min_mps2),
            "emergencyDecel": repr(-scenario.a_min_mps2),
            "guiShape": "passenger/sedan",
        }
        etree.SubElement(root, "vType", values)
    return etree.tostring(root, xml_declaration=True, encoding="UTF-8")
