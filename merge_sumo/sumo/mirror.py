"""A second SUMO with the original net, in which a TraCI client sees and commands vehicles.

It decides the motion that follows from commands to the VUT; after each of its steps the vehicles
are put where those of the campaign are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

import msgspec
from lxml import etree

from merge_sumo.errors import UserError
from merge_sumo.road.road import LanePath, LanePoint, Road
from merge_sumo.road.xml_input import harmless_net, to_bytes
from merge_sumo.scenario.scenario import DT_S, VEHICLES, VUT, Scenario
from merge_sumo.sumo.binding import SPEED_MODE_COMMANDED, SUMO_OPTIONS, load_libsumo

NET = "road.net.xml"
TYPES = "types.add.xml"
ROAD = "road.json"
OPTIONS = (*SUMO_OPTIONS, "--collision.action", "warn")
"""SUMO reports collisions, which change nothing."""
DEPARTURE_SPEED_MODE = 38
"""Speed mode in which the VUT departs: its limits of acceleration act, SUMO's safety checks not."""
FASTEST_MPS = 45.0
"""Least maximum speed of a vehicle, where the road allows less; the limit of the shipped road."""
VUT_ID = VEHICLES[VUT]
SPEED_MARGIN_MPS = 2.0
"""More than a vehicle gains in a step, unless a controller commands it without any limit."""

State = Sequence[float]
"""Position along the lanes in m, M = 0; speed in m/s; acceleration of the last step in m/s2."""


class RefusedError(Exception):
    """A question or command that is answered by an error, as SUMO would; the connection stays."""


def write_files(folder: Path, road: Road, scenario: Scenario) -> None:
    """Write the files that a `MirrorSimulation` loads.

    Args:
        folder: where they are written.
        road: both paths, with the net that they are in.
        scenario: gives the vehicles, their lengths and limits.

    Raises:
        UserError: if the net cannot be read.
    """
    (folder / NET).write_bytes(to_bytes(harmless_net(road.path)))
    (folder / TYPES).write_bytes(_types(road, scenario))
    (folder / ROAD).write_bytes(msgspec.json.encode(road, enc_hook=str))


class MirrorSimulation:
    """libsumo with the road and the vehicles of a scenario; one per process.

    Attributes:
        road: both paths.
        at_m: positions of the vehicles on the road along their lanes, M = 0.
        departed: vehicles that departed since the client last read them.
        arrived: vehicles that arrived since the client last read them.
        merged: whether the VUT has left the acceleration lane of a road with one.
        requests_merge: whether SUMO has put the VUT on the mainline in its last step.
        by_sumo: whether SUMO's own driver chose the speed of the VUT in its last step.
    """

    def __init__(self, folder: Path) -> None:
        """Read the road; `load` starts SUMO.

        Args:
            folder: the folder of `write_files`.
        """
        self._libsumo = load_libsumo()
        self.road = msgspec.json.decode(
            (folder / ROAD).read_bytes(), type=Road, dec_hook=lambda kind, text: kind(text)
        )
        files = ("--net-file", str(folder / NET), "--additional-files", str(folder / TYPES))
        self._options = [*files, *OPTIONS]
        self._started = False
        self.at_m: dict[str, float] = {}
        self.departed: list[str] = []
        self.arrived: list[str] = []
        self.merged = self.requests_merge = self.by_sumo = False
        on_ramp = {piece.lane for piece in self.road.ramp.pieces}
        self._mainline = {piece.lane for piece in self.road.mainline.pieces} - on_ramp
        """Lanes of the mainline alone: there a VUT has left the acceleration lane."""

    @property
    def has_lane(self) -> bool:
        """True where the scenario has an acceleration lane."""
        return self.road.used_lane_m is not None

    @property
    def time_s(self) -> float:
        """Simulation time."""
        return float(self._libsumo.simulation.getTime())

    def path(self, name: str) -> LanePath:
        """Return the lanes on which a vehicle drives.

        Args:
            name: the vehicle.
        """
        on_ramp = name == VUT_ID and not self.merged
        return self.road.ramp if on_ramp else self.road.mainline

    def point(self, name: str) -> LanePoint:
        """Return the place of a vehicle; SUMO's own answer is that before it was put there.

        Args:
            name: the vehicle.
        """
        return self.path(name).point(self.at_m[name])

    def load(self) -> None:
        """Start with an empty road at time 0.

        Raises:
            UserError: if SUMO cannot use the net.
        """
        libsumo, self.merged, self.at_m = self._libsumo, False, {}
        try:
            if self._started:
                libsumo.load(self._options)
            else:
                libsumo.start(["sumo", *self._options])
                self._started = True
            for name in libsumo.vehicletype.getIDList():
                if name in VEHICLES:
                    libsumo.route.add(f"route.{name}", edges_of(self.path(name)))
        except libsumo.TraCIException as error:
            raise UserError(str(error)) from error

    def call(self, function: str, *arguments: Any) -> Any:
        """Return what a function of libsumo returns.

        Args:
            function: its name, as `vehicle.getSpeed`.
            *arguments: its arguments.

        Raises:
            RefusedError: if SUMO refuses, or has no such function of these arguments.
        """
        try:
            return attrgetter(function)(self._libsumo)(*arguments)
        except (self._libsumo.TraCIException, self._libsumo.FatalTraCIError) as error:
            raise RefusedError(str(error)) from error
        except (AttributeError, TypeError, ValueError, OverflowError, NotImplementedError) as error:
            given = ", ".join(f"{argument!r:.40}" for argument in arguments)
            raise RefusedError(f"{function} takes no ({given})") from error

    def enter(self, states: Mapping[str, State]) -> None:
        """Make a step in which the vehicles depart, and put them into their states.

        Args:
            states: by the names of the vehicles.
        """
        vehicle, self.merged = self._libsumo.vehicle, False
        for name, state in states.items():
            vehicle.add(name, f"route.{name}", typeID=name, **self._departure(name, state))
            self.at_m[name] = state[0]
        self.departed += states
        self.step()
        for name in self.at_m:
            vehicle.setLaneChangeMode(name, 0)
            vehicle.setSpeedMode(name, SPEED_MODE_COMMANDED)
        if VUT_ID in self.at_m:
            vehicle.setSpeedMode(VUT_ID, DEPARTURE_SPEED_MODE)
            vehicle.setSpeed(VUT_ID, states[VUT_ID][1])
        self.put(states)

    def step(self) -> float | None:
        """Make a step, in which vehicles that come to the end of the net arrive.

        Returns:
            The speed that SUMO gives the VUT, in m/s; None where it is not on the road.
        """
        vehicle, moved = self._libsumo.vehicle, self._change_lanes()
        self._libsumo.simulation.step()
        left = vehicle.getIDList()
        for name in list(self.at_m):
            if name not in left:
                self._arrive(name)
        if VUT_ID not in self.at_m:
            return None
        v_mps = float(vehicle.getSpeed(VUT_ID))
        on_mainline = self.has_lane and vehicle.getLaneID(VUT_ID) in self._mainline
        is_forced = self.has_lane and VUT_ID in moved
        self.requests_merge = on_mainline and not is_forced
        own_mps = vehicle.getSpeedWithoutTraCI(VUT_ID)
        self.by_sumo = bool(own_mps == v_mps) and not is_forced
        return v_mps

    def put(self, states: Mapping[str, State], *, merged: bool = False) -> None:
        """Put the vehicles that are on the road into their states.

        Those beyond the end of the net, where paths continue without a road, arrive.

        Args:
            states: by the names of the vehicles.
            merged: whether the VUT has left the acceleration lane.
        """
        vehicle, self.merged = self._libsumo.vehicle, merged
        for name in list(self.at_m):
            x_m, v_mps, a_mps2 = states[name]
            if x_m >= self.road.drawn_after_m:
                vehicle.remove(name)
                self._arrive(name)
                continue
            point = self.path(name).point(x_m)
            vehicle.moveTo(name, point.lane, point.position_m)
            vehicle.setPreviousSpeed(name, v_mps, a_mps2)
            if name != VUT_ID:
                vehicle.setSpeed(name, v_mps)
            self.at_m[name] = x_m

    def clear(self) -> None:
        """Take all vehicles from the road."""
        for name in list(self.at_m):
            self._libsumo.vehicle.remove(name)
            self._arrive(name)

    def _arrive(self, name: str) -> None:
        del self.at_m[name]
        self.arrived.append(name)

    def _change_lanes(self) -> list[str]:
        """Move vehicles at the end of a lane that ends to the lane next to it, and return them.

        SUMO would stop them at the end.
        """
        moved: list[str] = []
        if not self.road.lane_drop:
            return moved
        ends, continues = self.road.mainline, self.road.ramp
        if self.road.ramp_approach.yields:
            ends, continues = continues, ends
        _, end_m = self.road.used_lane_m or (0.0, 0.0)
        *_, target = filter(lambda piece: piece.start_m < end_m, continues.pieces)
        for name, x_m in self.at_m.items():
            next_m = x_m + (self._libsumo.vehicle.getSpeed(name) + SPEED_MARGIN_MPS) * DT_S
            if self.path(name) is ends and x_m < end_m <= next_m:
                self._libsumo.vehicle.moveTo(name, target.lane, target.length_m + x_m - end_m)
                moved.append(name)
        return moved

    def _departure(self, name: str, state: State) -> dict[str, str]:
        """Return the departure of a vehicle, which must be on the first edge of its route."""
        path, (x_m, v_mps, _) = self.path(name), state
        point = path.point(x_m)
        edge, _, lane = point.lane.rpartition("_")
        # SUMO lets none depart faster than the limit; it gets its own speed after the step.
        own_mps = self._libsumo.vehicletype.getMaxSpeed(name)
        departure = {"departSpeed": str(min(v_mps, path.piece(x_m).speed_limit_mps, own_mps))}
        if edge == edges_of(path)[0]:
            return {**departure, "departLane": lane, "departPos": str(point.position_m)}
        return {**departure, "departLane": "best"}


def edges_of(path: LanePath) -> list[str]:
    """Return the edges of a path, without those inside junctions.

    Args:
        path: the path.
    """
    edges: list[str] = []
    for piece in path.pieces:
        edge = piece.lane.rpartition("_")[0]
        if not piece.is_internal and edge not in edges:
            edges.append(edge)
    return edges


def _types(road: Road, scenario: Scenario) -> bytes:
    root = etree.Element("additional")
    for name in VEHICLES[: scenario.vehicles]:
        length_m = scenario.lengths_m[name == VUT_ID]
        etree.SubElement(
            root,
            "vType",
            id=name,
            length=repr(length_m),
            minGap="0",
            # Where SUMO's models drive the VUT, an episode must not depend on those before it.
            sigma="0",
            maxSpeed=repr(max(road.speed_limit_mps, FASTEST_MPS)),
            accel=repr(scenario.a_max_mps2),
            decel=repr(-scenario.a_min_mps2),
            emergencyDecel=repr(-scenario.a_min_mps2),
        )
    return to_bytes(root)
