"""The shadow SUMO: it has the net as it is in its file, and decides what commands to the VUT mean.

Ours hosts copies of two lanes under other names. This one has all of the road by the ids of the
file. After each of its steps the vehicles are put where ours has them. It runs as libsumo in a
process of its own (`child.py`), so no port is open.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import msgspec
from lxml import etree

from merge_sumo.errors import UserError
from merge_sumo.road import allowed, received
from merge_sumo.road.corridor import Corridor, LanePath, LanePoint
from merge_sumo.scenario.colours import rgb
from merge_sumo.scenario.scenario import DT_S, VEHICLES, VUT, Scenario
from merge_sumo.sumo.binding import SPEED_MODE_COMMANDED, SUMO_OPTIONS, load_libsumo

NET: Final = "road.net.xml"
TYPES: Final = "types.add.xml"
SETUP: Final = "setup.json"
SHADOW_OPTIONS: Final = (*SUMO_OPTIONS, "--collision.action", "warn")
"""It tells controllers of collisions, which change nothing."""
COMMANDED_VUT: Final = 38
"""Speed mode of the VUT as it departs: its limits of acceleration act, SUMO's checks do not."""
COLOURS: Final = (*rgb("pov"), 255), (*rgb("vut"), 255)
"""Of the cars of the mainline, and of the VUT."""
FASTEST_MPS: Final = 45.0
"""Speed that a car can drive wherever the road allows less; the limit of the shipped road."""
WIDTH_M: Final = 1.8
HEIGHT_M: Final = 1.5
NAME_OF_VUT: Final = VEHICLES[VUT]
ID_COUNT: Final = 0x01
"""The variable of `getIDCount` in every domain."""
SPEED_MARGIN_MPS: Final = 2.0
"""More than a vehicle gains in a step, unless a controller commands it without any limit."""

State = tuple[float, float, float]
"""Position along the lanes in m, M = 0; speed in m/s; acceleration of the last step in m/s2."""


class _Setup(msgspec.Struct, frozen=True):
    """The input of a shadow SUMO besides its net."""

    road: Corridor
    names: tuple[str, ...]


def write_files(folder: Path, road: Corridor, scenario: Scenario) -> None:
    """Write what a shadow SUMO loads; `UserError` for a net that cannot be read."""
    net = allowed.road_net(received.read_net(road.path), road.path)
    (folder / NET).write_bytes(received.serialize(net))
    (folder / TYPES).write_bytes(_types(road, scenario))
    setup = _Setup(road, VEHICLES[: scenario.vehicles])
    (folder / SETUP).write_bytes(msgspec.json.encode(setup, enc_hook=str))


class ShadowSumo:
    """libsumo with the road of a scenario and its vehicles; one a process.

    Attributes:
        road: both paths.
        at_m: positions of the vehicles on the road along their lanes, M = 0.
        merged: whether the VUT has left the acceleration lane of a road with one.
        wants_to_merge: whether SUMO has put the VUT beside that lane in its last step.
        was_forced: whether the VUT came to the end of that lane in it, and was moved beside it.
        by_sumo: whether SUMO's own driver chose the speed of the VUT in it.
    """

    def __init__(self, folder: Path) -> None:
        """Take the folder of `write_files`; `load` starts it."""
        self._libsumo = load_libsumo()
        setup = msgspec.json.decode(
            (folder / SETUP).read_bytes(), type=_Setup, dec_hook=lambda kind, text: kind(text)
        )
        self.road, self._names = setup.road, setup.names
        files = ("--net-file", str(folder / NET), "--additional-files", str(folder / TYPES))
        self._options = [*files, *SHADOW_OPTIONS]
        self._started, self._asked = False, 0
        self.at_m: dict[str, float] = {}
        self.merged = self.wants_to_merge = self.was_forced = self.by_sumo = False
        on_ramp = {piece.lane for piece in self.road.ramp.pieces}
        self._beside = {piece.lane for piece in self.road.mainline.pieces} - on_ramp
        """Lanes of the mainline alone; on those beside an acceleration lane a VUT has merged."""

    @property
    def has_lane(self) -> bool:
        """True where the scenario has an acceleration lane."""
        return self.road.lane_m is not None

    @property
    def time_s(self) -> float:
        """Simulation time."""
        return float(self._libsumo.simulation.getTime())

    def path(self, name: str) -> LanePath:
        """Return the lanes that a vehicle drives on."""
        on_ramp = name == NAME_OF_VUT and not self.merged
        return self.road.ramp if on_ramp else self.road.mainline

    def load(self) -> None:
        """Start with an empty road at time 0; `UserError` where SUMO cannot use the net."""
        libsumo, self.merged = self._libsumo, False
        try:
            if self._started:
                libsumo.load(self._options)
            else:
                libsumo.start(["sumo", *self._options])
                self._started = True
            for name in self._names:
                libsumo.route.add(f"route.{name}", _edges(self.path(name)))
        except libsumo.TraCIException as error:
            raise UserError(str(error)) from error
        self.at_m = {}

    def call(self, function: str, *arguments: Any) -> Any:
        """Call a function of libsumo, named as "vehicle.getSpeed".

        Raises `RefusedError` where SUMO refuses, or has no such function of these arguments.
        """
        domain, _, name = function.partition(".")
        called = getattr(getattr(self._libsumo, domain, None), name, None)
        if called is None:
            raise RefusedError(f"SUMO has no {function} here")
        try:
            return called(*arguments)
        except (self._libsumo.TraCIException, self._libsumo.FatalTraCIError) as error:
            raise RefusedError(str(error)) from error
        except (TypeError, ValueError, OverflowError, NotImplementedError) as error:
            given = ", ".join(f"{argument!r:.40}" for argument in arguments)
            raise RefusedError(f"{function} takes no ({given})") from error

    def around(self, point: tuple[float, ...], domain: int, range_m: float) -> list[str]:
        """Return the objects of a domain, by its number, around a point; raises as `call` does.

        A context subscription finds them. What it found stays up to the next step, so that each has
        a point of interest of its own.
        """
        self._asked += 1
        name = f"around {self._asked}"
        self.call("poi.add", name, *point[:2], COLOURS[0])
        try:
            self.call("poi.subscribeContext", name, domain, range_m, [ID_COUNT])
            found = self.call("poi.getContextSubscriptionResults", name)
            self.call("poi.unsubscribeContext", name, domain, range_m)
        finally:
            self.call("poi.remove", name)
        return sorted(set(found) - {name})

    def enter(self, states: Mapping[str, State]) -> None:
        """Make a step in which the vehicles depart, and put them into their states."""
        vehicle, self.merged = self._libsumo.vehicle, False
        for name, state in states.items():
            start = self._start(name, state)
            vehicle.add(name, f"route.{name}", typeID=name, **start)
            vehicle.setColor(name, COLOURS[name == NAME_OF_VUT])
        self.at_m = {name: x_m for name, (x_m, _, _) in states.items()}
        self.step()
        for name in self.at_m:
            vehicle.setLaneChangeMode(name, 0)
            vehicle.setSpeedMode(
                name, COMMANDED_VUT if name == NAME_OF_VUT else SPEED_MODE_COMMANDED
            )
        if NAME_OF_VUT in self.at_m:
            vehicle.setSpeed(NAME_OF_VUT, states[NAME_OF_VUT][1])
        self.put(states)

    def step(self) -> float | None:
        """Make a step; return the speed that SUMO gives the VUT, None where it is not there.

        A vehicle that comes to the end of the net arrives.
        """
        forced = self._change_lanes()
        self._libsumo.simulation.step()
        left = self._libsumo.vehicle.getIDList()
        self.at_m = {name: x_m for name, x_m in self.at_m.items() if name in left}
        if NAME_OF_VUT not in self.at_m:
            return None
        vehicle = self._libsumo.vehicle
        v_mps = float(vehicle.getSpeed(NAME_OF_VUT))
        self.was_forced = self.has_lane and NAME_OF_VUT in forced
        lane = vehicle.getLaneID(NAME_OF_VUT)
        self.wants_to_merge = self.has_lane and not self.was_forced and lane in self._beside
        own_mps = vehicle.getSpeedWithoutTraCI(NAME_OF_VUT)
        self.by_sumo = bool(own_mps == v_mps) and not self.was_forced
        return v_mps

    def put(self, states: Mapping[str, State], *, merged: bool = False) -> None:
        """Put the vehicles that are on the road into their states.

        Those beyond the end of the net, where paths go on without a road, arrive. `merged` is
        whether the VUT has left the acceleration lane.
        """
        vehicle, self.merged = self._libsumo.vehicle, merged
        for name in list(self.at_m):
            x_m, v_mps, a_mps2 = states[name]
            if x_m >= self.road.drawn_after_m:
                vehicle.remove(name)
                del self.at_m[name]
                continue
            point = self.path(name).point(x_m)
            vehicle.moveTo(name, point.lane, point.position_m)
            vehicle.setPreviousSpeed(name, v_mps, a_mps2)
            if name != NAME_OF_VUT:
                vehicle.setSpeed(name, v_mps)
            self.at_m[name] = x_m

    def clear(self) -> None:
        """Take all vehicles from the road."""
        for name in self.at_m:
            self._libsumo.vehicle.remove(name)
        self.at_m = {}

    def point(self, name: str) -> LanePoint:
        """Return the place of a vehicle; SUMO's own answer is that before it was put there."""
        return self.path(name).point(self.at_m[name])

    def _change_lanes(self) -> list[str]:
        """Move vehicles at the end of a lane that ends to the lane beside it, and return them.

        SUMO would stop them there.
        """
        if not self.road.lane_drop:
            return []
        ends, goes_on = self.road.mainline, self.road.ramp
        if self.road.ramp_approach.yields:
            ends, goes_on = goes_on, ends
        _, end_m = self.road.lane_m or (0.0, 0.0)
        beside = next(piece for piece in reversed(goes_on.pieces) if piece.start_m < end_m)
        moved = []
        for name, x_m in self.at_m.items():
            next_m = (self._libsumo.vehicle.getSpeed(name) + SPEED_MARGIN_MPS) * DT_S
            if self.path(name) is ends and x_m < end_m <= x_m + next_m:
                self._libsumo.vehicle.moveTo(name, beside.lane, beside.length_m + x_m - end_m)
                moved.append(name)
        return moved

    def _start(self, name: str, state: State) -> dict[str, str]:
        """Return the departure of a vehicle, which must be on the first edge of its route."""
        path = self.path(name)
        point = path.point(state[0])
        edge, lane = _edge_of(point.lane), point.lane.rpartition("_")[2]
        # It is told its own speed behind the step; SUMO lets none depart faster than the limit.
        own_mps = self._libsumo.vehicletype.getMaxSpeed(name)
        fastest_mps = min(path.piece(state[0]).speed_limit_mps, own_mps)
        speed = {"departSpeed": str(min(state[1], fastest_mps))}
        if edge != _edges(path)[0]:
            return {"departLane": "best", **speed}
        return {"departLane": lane, "departPos": str(point.position_m), **speed}


class RefusedError(Exception):
    """A command that is answered by an error, as SUMO would; the connection goes on."""


def _edge_of(lane: str) -> str:
    return lane.rpartition("_")[0]


def _edges(path: LanePath) -> list[str]:
    return list(dict.fromkeys(_edge_of(p.lane) for p in path.pieces if not p.is_internal))


def _types(road: Corridor, scenario: Scenario) -> bytes:
    root = etree.Element("additional")
    for name in VEHICLES[: scenario.vehicles]:
        length_m = scenario.vut_length_m if name == NAME_OF_VUT else scenario.pov_length_m
        values = {
            "id": name,
            "length": repr(length_m),
            "width": repr(WIDTH_M),
            "height": repr(HEIGHT_M),
            "minGap": "0",
            # Where SUMO's models drive the VUT, an episode must not depend on those before it.
            "sigma": "0",
            "maxSpeed": repr(max(road.speed_limit_mps, FASTEST_MPS)),
            "accel": repr(scenario.a_max_mps2),
            "decel": repr(-scenario.a_min_mps2),
            "emergencyDecel": repr(-scenario.a_min_mps2),
            "guiShape": "passenger/sedan",
        }
        etree.SubElement(root, "vType", values)
    return etree.tostring(root, xml_declaration=True, encoding="UTF-8")
