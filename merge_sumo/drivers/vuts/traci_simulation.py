"""The simulation that a TraCI client sees: time, the vehicles on the road, and its lanes.

Time runs on over the episodes. In each the vehicles depart, and when it ends they arrive. The road
has the lanes and edges of both paths, by their ids in the net file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

from merge_sumo.drivers.vuts import traci_protocol as tp
from merge_sumo.drivers.vuts.base import Seen
from merge_sumo.sumo.corridor import Corridor, LanePath, LanePoint, Piece
from merge_sumo.values.scenario import DT_S, US23, VEHICLES, Scenario
from merge_sumo.values.scenario import VUT as ROW_OF_VUT

VUT: Final = VEHICLES[ROW_OF_VUT]
WIDTH_M: Final = 1.8
HEIGHT_M: Final = 1.5


class RefusedError(Exception):
    """A command that is answered by an error, as SUMO would; the connection goes on."""

    def __init__(self, text: str, result: int = tp.ERROR) -> None:
        """Say why, with the result that TraCI has for it."""
        super().__init__(text)
        self.result = result


@dataclass(slots=True)
class Vehicle:
    """State of a vehicle, and when it departed."""

    x_m: float
    v_mps: float
    a_mps2: float
    departure_s: float


@dataclass
class Simulation:
    """What there is to see."""

    road: Corridor
    scenario: Scenario = US23
    steps: int = 0
    expected: bool = True
    """Whether more vehicles may come."""
    vehicles: dict[str, Vehicle] = field(default_factory=dict)
    departed: list[str] = field(default_factory=list)
    arrived: list[str] = field(default_factory=list)

    @property
    def time_s(self) -> float:
        """Simulation time."""
        return self.steps / round(1.0 / DT_S)

    def answered(self) -> None:
        """Forget who departed and arrived: the client has been told."""
        self.departed.clear()
        self.arrived.clear()

    def show(self, seen: Seen) -> None:
        """Advance by a step, to a state with both vehicles."""
        self.steps += 1
        for name, (x_m, v_mps) in zip(VEHICLES, seen.vehicles, strict=False):
            before = self.vehicles.get(name)
            if before is None:
                self.departed.append(name)
                self.vehicles[name] = Vehicle(x_m, v_mps, 0.0, self.time_s - DT_S)
            else:
                a_mps2 = (v_mps - before.v_mps) / DT_S
                self.vehicles[name] = Vehicle(x_m, v_mps, a_mps2, before.departure_s)

    def clear(self, *, more: bool) -> None:
        """Advance by a step, to an empty road; `more` vehicles may come."""
        self.steps += 1
        self.expected = more
        self.arrived += self.vehicles
        self.vehicles.clear()

    def around(self, name: str, range_m: float) -> list[str]:
        """Return the vehicles within a distance of one of them, itself included, as SUMO does."""
        x, y = self.point(name)[2:4]
        return [
            other for other in self.vehicles if math.dist((x, y), self.point(other)[2:4]) <= range_m
        ]

    def vehicle(self, name: str) -> Vehicle:
        """Return a vehicle that is on the road; raises `RefusedError` for others."""
        found = self.vehicles.get(name)
        if found is None:
            raise RefusedError(f"Vehicle '{name}' is not known.")
        return found

    def point(self, name: str) -> LanePoint:
        """Return where a vehicle is."""
        return self.road.lane_point(self.vehicle(name).x_m, on_ramp=name == VUT)

    def length_m(self, name: str) -> float:
        """Return the length of a vehicle."""
        return self.scenario.vut_length_m if name == VUT else self.scenario.pov_length_m

    def path(self, name: str) -> LanePath:
        """Return the lanes that a vehicle drives on."""
        return self.road.ramp if name == VUT else self.road.mainline

    def lanes(self) -> dict[str, Piece]:
        """Return the lanes of both paths by their ids: before M, then those that follow."""
        pieces = [*self.road.mainline.pieces, *self.road.ramp.pieces]
        return {piece.lane: piece for piece in sorted(pieces, key=lambda p: p.start_m >= 0.0)}

    def lane(self, name: str) -> Piece:
        """Return a lane; raises `RefusedError` for one that there is not."""
        found = self.lanes().get(name)
        if found is None:
            raise RefusedError(f"Lane '{name}' is not known.")
        return found

    def edges(self) -> list[str]:
        """Return the edges of all lanes."""
        return list(dict.fromkeys(map(edge_of, self.lanes())))

    def leader(self, name: str) -> tuple[str, float]:
        """Return who drives ahead on the lanes that a vehicle will use, and the gap between."""
        me = self.vehicle(name)
        ahead = [
            (state.x_m, other)
            for other, state in self.vehicles.items()
            # Before M the VUT is on a lane of its own.
            if (state.x_m >= 0.0 or VUT not in (name, other)) and state.x_m > me.x_m
        ]
        if not ahead:
            return "", -1.0
        x_m, other = min(ahead)
        return other, x_m - self.length_m(other) - me.x_m


def edge_of(lane: str) -> str:
    """Return the edge of a lane, by its id."""
    return lane.rpartition("_")[0]
