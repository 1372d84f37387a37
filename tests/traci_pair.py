"""Ours and a real SUMO side by side, for a client's questions: who answers what."""

from __future__ import annotations

import inspect
import math
import struct
import warnings
from collections.abc import Iterator
from typing import Any

import traci
from traci.connection import Connection
from traci.storage import Storage

from merge_sumo.drivers.vuts import traci_protocol as tp
from merge_sumo.drivers.vuts.base import seen_in
from merge_sumo.drivers.vuts.traci_commands import SPEED_MODE_AT_FIRST
from merge_sumo.drivers.vuts.traci_session import Session
from merge_sumo.sumo.beside import COLOURS, OPTIONS, TYPES, _edges, _types
from merge_sumo.sumo.client import end_program, open_program
from merge_sumo.sumo.road import road_of
from merge_sumo.values.scenario import DT_S, POV, US23

STEPS = 30
IDS = {
    "vehicle": "vut",
    "vehicletype": "vut",
    "route": "route.vut",
    "edge": "ramp",
    "lane": "ramp_0",
    "junction": "M",
}
"""Objects that are asked about, by their domain."""
ARGUMENTS = {
    "typeID": "vut",
    "edgeID": "ramp",
    "edgeID1": "main_in",
    "edgeID2": "main_out",
    "fromEdge": "main_in",
    "toEdge": "main_out",
    "laneID": "ramp_0",
    "toLaneID": "main_out_0",
    "vehID": "vut",
    "key": "k",
    "param": "k",
    "direction": 0,
    "mode": 0,
    "laneIndex": 0,
    "time": 1.0,
    "speed": 20.0,
    "gap": 30.0,
    "leaderSpeed": 20.0,
    "leaderMaxDecel": 4.0,
    "leaderID": "pov",
    "routeEdges": ["main_in", "main_out"],
    "pos": 10.0,
    "pos1": 10.0,
    "pos2": 20.0,
    "edges": ["main_in"],
    "x": 100.0,
    "y": 0.0,
    "x1": 0.0,
    "y1": 0.0,
    "x2": 10.0,
    "y2": 0.0,
}
"""What functions are given, by the names of their arguments."""


OBJECTS = {
    *("vehID", "typeID", "routeID", "edgeID", "laneID", "junctionID", "objID", "objectID", "detID"),
    *("stopID", "loopID", "poiID", "polygonID", "personID", "tlsID", "viewID", "probeID"),
}
"""Names of the first argument where that is the object that is asked about."""


class ToSession(Connection):
    """A client's connection that leads to a session, without a socket."""

    def __init__(self, session: Session) -> None:
        import threading

        self._string = b""
        self._queue: list[Any] = []
        self._subscriptionMapping: dict[Any, Any] = {}
        self._lock = threading.Lock()
        self._session = session
        for domain in traci.domain.DOMAINS:
            domain._register(self, self._subscriptionMapping)

    def _sendExact(self):  # noqa: N802 (TraCI's name)
        (command,) = tp.commands_of(self._string)
        result = Storage(self._session.handle(command))
        self._string, self._queue = b"", []
        _, _, code = result.read("!BBB")
        said = result.readString()
        if code or said:
            raise traci.TraCIException(said, command.identifier, str(code))
        return result


class Pair:
    """A session and a SUMO program in the same state: both cars on their way to M."""

    def __init__(self, folder) -> None:
        road = road_of()
        (folder / TYPES).write_bytes(_types(road, US23, 2))
        files = ("--net-file", str(road.path), "--additional-files", str(folder / TYPES))
        self.process, self.real = open_program("sumo", [*files, *OPTIONS])
        self.notes: list[str] = []
        self.session = Session(road, US23, note=self.notes.append)
        vehicle = self.real.vehicle
        starts = {"pov": (road.mainline, -300.0, 30.0), "vut": (road.ramp, -182.0, 18.0)}
        for name, (path, x_m, v_mps) in starts.items():
            self.real.route.add(f"route.{name}", _edges(path))
            point = path.point(x_m)
            lane = point.lane.rpartition("_")[2]
            place = {"departPos": str(point.position_m), "departSpeed": str(v_mps)}
            vehicle.add(name, f"route.{name}", typeID=name, departLane=lane, **place)
            vehicle.setColor(name, COLOURS[name == "vut"])
        begin = {
            name: {piece.lane: piece.start_m for piece in path.pieces}
            for name, (path, _, _) in starts.items()
        }
        for _ in range(STEPS):
            self.session.answered()
            self.real.simulationStep()
            places_m: list[float] = []
            speeds_mps: list[float] = []
            for name in starts:
                vehicle.setSpeedMode(name, SPEED_MODE_AT_FIRST if name == "vut" else 32)
                vehicle.setLaneChangeMode(name, 0)
                vehicle.setSpeed(name, vehicle.getSpeed(name) + (0.05 if name == "vut" else -0.05))
                places_m.append(
                    begin[name][vehicle.getLaneID(name)] + vehicle.getLanePosition(name)
                )
                speeds_mps.append(vehicle.getSpeed(name))
            self.session.show(seen_in(self.session.steps * DT_S, POV, places_m, speeds_mps))
        self.ours = ToSession(self.session)

    def close(self) -> None:
        self.session.close()
        end_program(self.process)


class Drive:
    """A session and a SUMO program in which the VUT drives as it is commanded, step by step.

    The session's VUT is moved by eq. (4) and the scenario's limits. Both start anew in `begin`, but
    for the programs.
    """

    def __init__(self, folder) -> None:
        self.road = road_of()
        (folder / TYPES).write_bytes(_types(self.road, US23, 2))
        files = ("--net-file", str(self.road.path), "--additional-files", str(folder / TYPES))
        self.process, self.real = open_program("sumo", [*files, *OPTIONS])
        self.real.route.add("route.vut", _edges(self.road.ramp))
        self.notes: list[str] = []
        self.session = Session(self.road, US23, note=self.notes.append)

    def begin(self) -> None:
        before = self.session.beside
        if before is not None:
            before.show({})
            _as_at_first(before._connection)
        self.session = Session(self.road, US23, note=self.notes.append)
        self.session.beside = before
        self.notes.clear()
        self.ours = ToSession(self.session)
        _as_at_first(self.real)
        if "vut" in self.real.vehicle.getIDList():
            self.real.vehicle.remove("vut")
        self.real.vehicle.add("vut", "route.vut", typeID="vut", departSpeed="18")
        self.real.simulationStep()
        self.real.vehicle.setSpeedMode("vut", SPEED_MODE_AT_FIRST)
        self.real.vehicle.setLaneChangeMode("vut", 0)
        self.real.vehicle.setColor("vut", COLOURS[1])
        self.real.vehicle.setSpeed("vut", 18.0)
        self.again()

    def again(self) -> None:
        """Let the vehicles of the session depart, after they have arrived."""
        if self.session.vehicles:
            self.session.clear(more=True)
        self.x_m, self.v_mps = [-250.0, -182.0], [30.0, 18.0]
        self._show()

    def both(self, ask):
        return ask(self.ours), ask(self.real)

    def step(self) -> None:
        a_mps2 = self.session.acceleration_mps2()
        a_mps2 = min(max(a_mps2, US23.a_min_mps2), US23.a_max_mps2)
        self.x_m = [x + v * DT_S for x, v in zip(self.x_m, self.v_mps, strict=True)]
        self.v_mps[1] = max(self.v_mps[1] + a_mps2 * DT_S, 0.0)
        self._show()
        self.real.simulationStep()

    def speeds(self) -> tuple[float, float]:
        ours, real = self.both(lambda c: c.vehicle.getSpeed("vut"))
        return ours, real

    def _show(self) -> None:
        self.session.show(seen_in(self.session.steps * DT_S, POV, self.x_m, self.v_mps))

    def close(self) -> None:
        self.session.close()
        end_program(self.process)


def _as_at_first(connection: Any) -> None:
    """Give the VUT's type the numbers that it had."""
    vehicletype = connection.vehicletype
    vehicletype.setMaxSpeed("vut", road_of().speed_limit_mps)
    vehicletype.setAccel("vut", US23.a_max_mps2)
    vehicletype.setDecel("vut", -US23.a_min_mps2)
    vehicletype.setEmergencyDecel("vut", -US23.a_min_mps2)


def questions() -> Iterator[tuple[str, str, tuple[Any, ...]]]:
    """Yield (domain, function, arguments) of everything that a client can ask."""
    for name, domain in sorted(vars(traci).items()):
        if not isinstance(domain, traci.domain.Domain):
            continue
        for function, call in inspect.getmembers(domain, inspect.ismethod):
            if not function.startswith(("get", "is", "find", "convert", "could", "wants")):
                continue
            if "Subscription" in function:
                continue
            parameters = inspect.signature(call).parameters.values()
            needed = [p.name for p in parameters if p.default is p.empty]
            values = [ARGUMENTS.get(parameter, "x") for parameter in needed]
            of_object = domain is not traci.simulation and needed and needed[0] in OBJECTS
            if of_object:
                values[0] = IDS.get(name, "nothing")
            yield name, function, tuple(values)


def answer(connection: Any, domain: str, function: str, values: tuple[Any, ...]) -> str:
    """Return an answer as text; of a refusal what is said."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return shown(getattr(getattr(connection, domain), function)(*values))
        except traci.TraCIException as error:
            return f"refused: {error}"
        except (TypeError, AttributeError, ValueError, KeyError, struct.error) as error:
            return f"not asked: {type(error).__name__} {error}"
        finally:
            connection._string, connection._queue = b"", []


def shown(value: Any) -> str:
    """Return an answer as text, numbers to 9 digits: state goes by the sum of many steps."""
    if isinstance(value, float):
        return "nan" if math.isnan(value) else f"{value:.9g}"
    if isinstance(value, (tuple, list)):
        return f"({', '.join(map(shown, value))})"
    if isinstance(value, dict):
        return str({key: shown(of) for key, of in value.items()})
    return repr(value) if not hasattr(value, "__dict__") else shown(vars(value))
