"""What a TraCI client may ask: the variables of each domain, by their numbers in the protocol."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from merge_sumo.drivers.vuts import traci_protocol as tp
from merge_sumo.drivers.vuts.traci_protocol import Reader
from merge_sumo.drivers.vuts.traci_simulation import (
    HEIGHT_M,
    VUT,
    WIDTH_M,
    RefusedError,
    Simulation,
    Vehicle,
    edge_of,
)
from merge_sumo.sumo.corridor import LanePath, Piece
from merge_sumo.values.scenario import DT_S

GET_LANE, GET_VEHICLE, GET_SIMULATION = 0xA3, 0xA4, 0xAB
GET_EDGE, GET_JUNCTION = 0xAA, 0xA9
ID_LIST, ID_COUNT = 0x00, 0x01

Getter = Callable[[Simulation, str, Reader], bytes]


def _of_vehicle(value: Callable[[Simulation, str, Vehicle], bytes]) -> Getter:
    return lambda simulation, name, _: value(simulation, name, simulation.vehicle(name))


def _constant(value: bytes) -> Getter:
    return _of_vehicle(lambda _s, _n, _v: value)


def _leader(simulation: Simulation, name: str, reader: Reader) -> bytes:
    reader.typed_double()
    other, gap_m = simulation.leader(name)
    return tp.compound(tp.string(other), tp.double(gap_m))


def _follower(simulation: Simulation, name: str, reader: Reader) -> bytes:
    reader.typed_double()
    for other in simulation.vehicles:
        ahead, gap_m = simulation.leader(other)
        if ahead == name:
            return tp.compound(tp.string(other), tp.double(gap_m))
    return tp.compound(tp.string(""), tp.double(-1.0))


def _index_of(lane: str) -> int:
    return int(lane.rpartition("_")[2])


def _route(path: LanePath) -> list[str]:
    return [edge_of(piece.lane) for piece in path.pieces if not piece.is_internal]


def _route_index(path: LanePath, x_m: float) -> int:
    """Return the number of the edge; inside of a junction it is that of the edge before."""
    begun = [p for p in path.pieces if p.start_m <= x_m and not p.is_internal]
    return max(len(begun) - 1, 0)


_VEHICLE: Final[dict[int, Getter]] = {
    ID_LIST: lambda s, _n, _r: tp.strings(list(s.vehicles)),
    ID_COUNT: lambda s, _n, _r: tp.integer(len(s.vehicles)),
    0x40: _of_vehicle(lambda _s, _n, v: tp.double(v.v_mps)),  # getSpeed
    0x72: _of_vehicle(lambda _s, _n, v: tp.double(v.a_mps2)),  # getAcceleration
    0x56: _of_vehicle(lambda s, n, _v: tp.double(s.point(n)[1])),  # getLanePosition
    0x42: _of_vehicle(lambda s, n, _v: tp.position(*s.point(n)[2:4])),  # getPosition
    0x39: _of_vehicle(lambda s, n, _v: tp.position(*s.point(n)[2:4], 0.0)),  # getPosition3D
    0x43: _of_vehicle(lambda s, n, _v: tp.double(s.point(n)[4])),  # getAngle
    0x51: _of_vehicle(lambda s, n, _v: tp.string(s.point(n)[0])),  # getLaneID
    0x50: _of_vehicle(lambda s, n, _v: tp.string(edge_of(s.point(n).lane))),  # getRoadID
    0x52: _of_vehicle(lambda s, n, _v: tp.integer(_index_of(s.point(n).lane))),  # getLaneIndex
    0xB8: _constant(tp.double(0.0)),  # getLateralLanePosition
    0x32: _constant(tp.double(0.0)),  # getLateralSpeed
    0x36: _constant(tp.double(0.0)),  # getSlope
    0x4F: _of_vehicle(lambda _s, n, _v: tp.string(n)),  # getTypeID
    0x53: _of_vehicle(lambda _s, n, _v: tp.string(f"route.{n}")),  # getRouteID
    0x54: _of_vehicle(lambda s, n, _v: tp.strings(_route(s.path(n)))),  # getRoute
    0x69: _of_vehicle(lambda s, n, v: tp.integer(_route_index(s.path(n), v.x_m))),  # getRouteIndex
    0x44: _of_vehicle(lambda s, n, _v: tp.double(s.length_m(n))),  # getLength
    0x4D: _constant(tp.double(WIDTH_M)),  # getWidth
    0xBC: _constant(tp.double(HEIGHT_M)),  # getHeight
    0x4C: _constant(tp.double(0.0)),  # getMinGap
    0x41: _of_vehicle(lambda s, _n, _v: tp.double(s.road.speed_limit_mps)),  # getMaxSpeed
    0xB7: _of_vehicle(
        lambda s, n, v: tp.double(s.path(n).piece(v.x_m).speed_limit_mps)  # getAllowedSpeed
    ),
    0x5E: _constant(tp.double(1.0)),  # getSpeedFactor
    0x46: _of_vehicle(lambda s, _n, _v: tp.double(s.scenario.a_max_mps2)),  # getAccel
    0x47: _of_vehicle(lambda s, _n, _v: tp.double(-s.scenario.a_min_mps2)),  # getDecel
    0x7B: _of_vehicle(lambda s, _n, _v: tp.double(-s.scenario.a_min_mps2)),  # getEmergencyDecel
    0x7C: _of_vehicle(lambda s, _n, _v: tp.double(-s.scenario.a_min_mps2)),  # getApparentDecel
    0x49: _constant(tp.string("passenger")),  # getVehicleClass
    0x4B: _constant(tp.string("passenger/sedan")),  # getShapeClass
    0x45: _of_vehicle(
        lambda _s, n, _v: tp.colour(26, 89, 230) if n == VUT else tp.colour(230, 64, 38)
    ),
    0xB3: _constant(tp.integer(32)),  # getSpeedMode
    0xB6: _constant(tp.integer(0)),  # getLaneChangeMode
    0x5B: _constant(tp.integer(0)),  # getSignals
    0xB5: _constant(tp.integer(0)),  # getStopState
    0x7A: _constant(tp.double(0.0)),  # getWaitingTime
    0x3A: _of_vehicle(lambda _s, _n, v: tp.double(v.departure_s)),  # getDeparture
    0x68: _leader,
    0x78: _follower,
}

_SIMULATION: Final[dict[int, Getter]] = {
    0x66: lambda s, _n, _r: tp.double(s.time_s),  # getTime
    0x70: lambda s, _n, _r: tp.integer(round(s.time_s * 1000)),  # getCurrentTime
    0x7B: lambda _s, _n, _r: tp.double(DT_S),  # getDeltaT
    0x73: lambda s, _n, _r: tp.integer(len(s.departed)),
    0x74: lambda s, _n, _r: tp.strings(s.departed),
    0x71: lambda s, _n, _r: tp.integer(len(s.departed)),  # loaded
    0x72: lambda s, _n, _r: tp.strings(s.departed),
    0x79: lambda s, _n, _r: tp.integer(len(s.arrived)),
    0x7A: lambda s, _n, _r: tp.strings(s.arrived),
    0x7D: lambda s, _n, _r: tp.integer(max(len(s.vehicles), 2 * s.expected)),  # getMinExpected
    **{n: lambda _s, _n, _r: tp.strings(()) for n in (0x76, 0x78, 0x81)},  # teleports, collisions
    **{n: lambda _s, _n, _r: tp.integer(0) for n in (0x75, 0x77, 0x80)},
}


def _on_lane(simulation: Simulation, lane: str) -> list[str]:
    simulation.lane(lane)
    return [name for name in simulation.vehicles if simulation.point(name)[0] == lane]


def _of_lane(value: Callable[[Piece], bytes]) -> Getter:
    return lambda simulation, name, _: value(simulation.lane(name))


_LANE: Final[dict[int, Getter]] = {
    0x44: _of_lane(lambda lane: tp.double(lane.length_m)),  # getLength
    0x41: _of_lane(lambda lane: tp.double(lane.speed_limit_mps)),  # getMaxSpeed
    0x31: _of_lane(lambda lane: tp.string(edge_of(lane.lane))),  # getEdgeID
    0x4E: _of_lane(lambda lane: tp.polygon([(x, y) for x, y, _ in lane.shape])),  # getShape
    0x10: lambda s, n, _r: tp.integer(len(_on_lane(s, n))),  # getLastStepVehicleNumber
    0x12: lambda s, n, _r: tp.strings(_on_lane(s, n)),  # getLastStepVehicleIDs
}


def _on_edge(simulation: Simulation, edge: str) -> list[str]:
    if edge not in simulation.edges():
        raise RefusedError(f"Edge '{edge}' is not known.")
    return [name for name in simulation.vehicles if edge_of(simulation.point(name).lane) == edge]


_EDGE: Final[dict[int, Getter]] = {
    0x10: lambda s, n, _r: tp.integer(len(_on_edge(s, n))),
    0x12: lambda s, n, _r: tp.strings(_on_edge(s, n)),
}


GETTERS: Final = {
    GET_VEHICLE: _VEHICLE,
    GET_SIMULATION: _SIMULATION,
    GET_LANE: _LANE,
    GET_EDGE: _EDGE,
}
