"""Ours and a real SUMO next to each other, for a client's questions: who answers what."""

from __future__ import annotations

import inspect
import math
import os
import socket
import struct
import subprocess
import warnings
from collections.abc import Iterator
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import traci
from traci.connection import Connection
from traci.storage import Storage

from merge_sumo.controllers.traci import protocol as tp
from merge_sumo.controllers.traci.session import Session
from merge_sumo.road.loader import road_of
from merge_sumo.road.road import Road
from merge_sumo.scenario.scenario import DT_S, US23, Scenario
from merge_sumo.sumo.binding import sumo_environment, sumo_program
from merge_sumo.sumo.mirror import (
    DEPARTURE_SPEED_MODE,
    NET,
    OPTIONS,
    TYPES,
    MirrorSimulation,
    edges_of,
    write_files,
)

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


def _options(folder: Path) -> list[str]:
    files = ("--net-file", str(folder / NET), "--additional-files", str(folder / TYPES))
    return [*files, *OPTIONS]


def open_program(folder: Path) -> tuple[subprocess.Popen[bytes], Any]:
    """Start a real SUMO behind its own TraCI server; return it and a client's connection.

    Its port is open to all of this machine and beyond, so it may touch no file but in its folder.
    """
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    process = subprocess.Popen(
        [sumo_program("sumo"), *_options(folder), "--remote-port", str(port)],
        env=sumo_environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        cwd=folder,
    )
    try:
        with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere):
            return process, traci.connect(port, 240, proc=process, waitBetweenRetries=0.05)
    except BaseException:
        end_program(process)
        raise


def end_program(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()


_mirrors: list[MirrorSimulation] = []
"""libsumo holds one simulation per process."""


def mirror(folder: Path, scenario: Scenario = US23, road: Road | None = None) -> MirrorSimulation:
    """Return the mirror simulation of this process, with an empty road at time 0."""
    road = road or road_of()
    write_files(folder, road, scenario)
    sumo = MirrorSimulation(folder)
    sumo._started = bool(_mirrors)
    sumo.load()
    _mirrors[:] = [sumo]
    return sumo


def close_mirror() -> None:
    if _mirrors:
        _mirrors.pop()._libsumo.close()


class Pair:
    """A session and a SUMO program in the same state: both cars on their way to M."""

    def __init__(
        self,
        folder: Path,
        pov: tuple[float, float] = (-300.0, 30.0),
        change_mps: float = 0.05,
        steps: int = 30,
    ) -> None:
        """Let both drive some steps from `pov`, x and v, on, and change their speeds in each."""
        road = road_of()
        self.session = Session(mirror(folder))
        self.process, self.real = open_program(folder)
        vehicle = self.real.vehicle
        changes_mps = {"vut": change_mps, "pov": -change_mps}
        before_mps: dict[str, float] = {}
        starts = {"pov": (road.mainline, *pov), "vut": (road.ramp, -182.0, 18.0)}
        for name, (path, x_m, v_mps) in starts.items():
            self.real.route.add(f"route.{name}", edges_of(path))
            point = path.point(x_m)
            place = {"departPos": str(point.position_m), "departSpeed": str(v_mps)}
            place["departLane"] = point.lane.rpartition("_")[2]
            vehicle.add(name, f"route.{name}", typeID=name, **place)
            before_mps[name] = v_mps
        for step in range(steps):
            self.session.answered()
            self.real.simulationStep()
            states = {}
            for name, (path, *_) in starts.items():
                vehicle.setSpeedMode(name, DEPARTURE_SPEED_MODE if name == "vut" else 32)
                vehicle.setLaneChangeMode(name, 0)
                vehicle.setSpeed(name, vehicle.getSpeed(name) + changes_mps[name])
                lane, v_mps = vehicle.getLaneID(name), vehicle.getSpeed(name)
                (begin_m,) = [piece.start_m for piece in path.pieces if piece.lane == lane]
                x_m = begin_m + vehicle.getLanePosition(name)
                states[name] = x_m, v_mps, (v_mps - before_mps[name]) / DT_S
                before_mps[name] = v_mps
            if step:
                self.session.sumo.call("vehicle.setSpeed", "vut", states["vut"][1])
                self.session.step()
                self.session.put(states)
            else:
                self.session.enter(states)
        self.ours = ToSession(self.session)

    def close(self) -> None:
        close_mirror()
        end_program(self.process)


class Drive:
    """A session and a SUMO program in which the VUT drives as it is commanded, step by step.

    The session's VUT is moved by eq. (4) and the scenario's limits. Both start again in `begin`.
    """

    def __init__(self, folder: Path) -> None:
        self.road, self.folder = road_of(), folder
        write_files(folder, self.road, US23)
        self.process: subprocess.Popen[bytes] | None = None

    def begin(self, pov: tuple[float, float] = (-250.0, 30.0)) -> None:
        """Let the vehicles depart; `pov` is (x in m, v in m/s) of the session's POV."""
        self.restart(pov)
        # A program of its own for each test: one that ends takes no other test with it.
        self._end_program()
        self.process, self.real = open_program(self.folder)
        self.real.route.add("route.vut", edges_of(self.road.ramp))
        vehicle = self.real.vehicle
        vehicle.add("vut", "route.vut", typeID="vut", departSpeed="18")
        self.real.simulationStep()
        vehicle.setSpeedMode("vut", DEPARTURE_SPEED_MODE)
        vehicle.setLaneChangeMode("vut", 0)
        vehicle.setSpeed("vut", 18.0)

    def restart(self, pov: tuple[float, float] = (-250.0, 30.0)) -> None:
        """Let the vehicles depart in a new session."""
        self.session = Session(mirror(self.folder))
        self.ours = ToSession(self.session)
        x_m, v_mps = pov
        self.x_m, self.v_mps = [x_m, -182.0], [v_mps, 18.0]
        self.session.enter(self._states(0.0))

    def step(self) -> None:
        wanted_mps = self.session.step()
        assert wanted_mps is not None
        a_mps2 = (wanted_mps - self.v_mps[1]) / DT_S
        a_mps2 = min(max(a_mps2, US23.a_min_mps2), US23.a_max_mps2)
        self.x_m = [x + v * DT_S for x, v in zip(self.x_m, self.v_mps, strict=True)]
        self.v_mps[1] = max(self.v_mps[1] + a_mps2 * DT_S, 0.0)
        self.session.put(self._states(a_mps2))
        self.real.simulationStep()

    def speeds(self) -> tuple[float, float]:
        ours = self.ours.vehicle.getSpeed("vut")
        return ours, self.real.vehicle.getSpeed("vut")

    def _states(self, a_mps2: float) -> dict[str, tuple[float, float, float]]:
        pov, vut = zip(self.x_m, self.v_mps, strict=True)
        return {"pov": (*pov, 0.0), "vut": (*vut, a_mps2)}

    def close(self) -> None:
        close_mirror()
        self._end_program()

    def _end_program(self) -> None:
        if self.process is not None:
            end_program(self.process)
            self.process = None


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
