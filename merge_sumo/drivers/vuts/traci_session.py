"""What a TraCI client sees and may do: a SUMO simulation of two vehicles, `pov` and `vut`.

The session answers commands; it has no socket and does not decide when a step is made. Time runs
on over the episodes. In each the vehicles depart, and when it ends they arrive. The road has the
lanes and edges of both paths, by their ids in the net file, and the junction at M.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Final

from merge_sumo.drivers.vuts import traci_protocol as tp
from merge_sumo.drivers.vuts.base import Seen
from merge_sumo.drivers.vuts.traci_protocol import Command, ProtocolError, Reader
from merge_sumo.sumo.corridor import Corridor, LanePath, LanePoint, Piece
from merge_sumo.values.scenario import DT_S, US23, VEHICLES, Scenario
from merge_sumo.values.scenario import VUT as ROW_OF_VUT

VUT: Final = VEHICLES[ROW_OF_VUT]
WIDTH_M: Final = 1.8
HEIGHT_M: Final = 1.5

API_VERSION: Final = 22
"""Of the TraCI of SUMO 1.28."""

GET_VERSION: Final = 0x00
SIMULATION_STEP: Final = 0x02
SET_ORDER: Final = 0x03
CLOSE: Final = 0x7F

GET_LANE, GET_VEHICLE, GET_SIMULATION = 0xA3, 0xA4, 0xAB
GET_EDGE, GET_JUNCTION = 0xAA, 0xA9
SET_VEHICLE: Final = 0xC4
GETTERS_TO_SUBSCRIPTIONS: Final = 0x30
GETTERS_TO_CONTEXTS: Final = -0x20
TO_RESPONSE: Final = 0x10
"""Identifiers of the kinds of command lie these distances apart, for every domain."""

ID_LIST, ID_COUNT = 0x00, 0x01
SLOW_DOWN, SET_SPEED, SET_ACCELERATION = 0x14, 0x40, 0x72
SPEED_MODE, LANE_CHANGE_MODE, COLOUR, PARAMETER = 0xB3, 0xB6, 0x45, 0x7E
ACCEPTED: Final = frozenset({SPEED_MODE, LANE_CHANGE_MODE, COLOUR, PARAMETER})
"""Commands on the VUT that change nothing: eq. (4) and the limits of acceleration hold anyway."""
FOR_EVER: Final = -1073741824.0


class RefusedError(Exception):
    """A command that is answered by an error, as SUMO would; the connection goes on."""

    def __init__(self, text: str, result: int = tp.ERROR) -> None:
        """Say why, with the result that TraCI has for it."""
        super().__init__(text)
        self.result = result


@dataclass(slots=True)
class SpeedWish:
    """What the last command on the VUT's speed asks for; SUMO's own rule for each command.

    Attributes:
        target_mps: speed to reach; None to keep the present one.
        duration_s: time in which it is reached, from the first step after the command; 0 at once.
        start_mps: speed at that step; None before it.
        elapsed_s: time since.
    """

    target_mps: float | None = None
    duration_s: float = 0.0
    start_mps: float | None = None
    elapsed_s: float = 0.0

    def next_mps(self, v_mps: float) -> float:
        """Return the speed after the coming step; the wish ages by a step."""
        if self.target_mps is None:
            return v_mps
        if self.duration_s == 0.0:
            return self.target_mps
        if self.start_mps is None:
            self.start_mps = v_mps
        if self.elapsed_s > self.duration_s + 1e-9:
            return v_mps
        self.elapsed_s += DT_S
        share = min(self.elapsed_s / max(self.duration_s, DT_S), 1.0)
        return self.start_mps + (self.target_mps - self.start_mps) * share


@dataclass(slots=True)
class Subscription:
    """Variables that a client wants after every step, of an object or of those around it."""

    getter: int
    object_id: str
    variables: list[tuple[int, bytes]]
    begin_s: float
    end_s: float
    domain: int | None = None
    range_m: float = 0.0


@dataclass(slots=True)
class _Vehicle:
    x_m: float
    v_mps: float
    a_mps2: float
    departure_s: float


@dataclass(slots=True)
class Session:
    """The simulation as one client sees it."""

    road: Corridor
    scenario: Scenario = US23
    steps: int = 0
    expected: bool = True
    wish: SpeedWish = field(default_factory=SpeedWish)
    vehicles: dict[str, _Vehicle] = field(default_factory=dict)
    departed: list[str] = field(default_factory=list)
    arrived: list[str] = field(default_factory=list)
    subscriptions: dict[tuple[int, str, int | None], Subscription] = field(default_factory=dict)

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
                self.vehicles[name] = _Vehicle(x_m, v_mps, 0.0, self.time_s)
            else:
                a_mps2 = (v_mps - before.v_mps) / DT_S
                self.vehicles[name] = _Vehicle(x_m, v_mps, a_mps2, before.departure_s)

    def clear(self, *, more: bool) -> None:
        """Advance by a step, to an empty road; `more` vehicles may come."""
        self.steps += 1
        self.expected = more
        self.arrived += self.vehicles
        self.vehicles.clear()
        self.wish = SpeedWish()
        self.subscriptions = {
            key: subscription
            for key, subscription in self.subscriptions.items()
            if subscription.getter != GET_VEHICLE or subscription.object_id not in VEHICLES
        }

    def acceleration_mps2(self) -> float:
        """Return what the last commands on the VUT ask for in the coming step."""
        v_mps = self.vehicles[VUT].v_mps
        return (self.wish.next_mps(v_mps) - v_mps) / DT_S

    def handle(self, command: Command) -> bytes:
        """Return the answer to any command but a step or a close; raises `ProtocolError`."""
        identifier, reader = command.identifier, Reader(command.payload)
        try:
            return self._handle(identifier, reader)
        except RefusedError as refused:
            return tp.status(identifier, refused.result, str(refused))

    def _handle(self, identifier: int, reader: Reader) -> bytes:
        if identifier in _GETTERS:
            return tp.status(identifier) + self._get(identifier, reader)
        if identifier == SET_VEHICLE:
            self._set(reader)
            return tp.status(identifier)
        if identifier - GETTERS_TO_SUBSCRIPTIONS in _GETTERS:
            return self._subscribe(identifier, reader)
        if identifier - GETTERS_TO_CONTEXTS in _GETTERS:
            return self._subscribe_context(identifier, reader)
        if identifier == GET_VERSION:
            text = tp.raw_string(f"SUMO {version('libsumo')}, hosted by merge-sumo")
            content = bytes((identifier,)) + tp.raw_integer(API_VERSION) + text
            return tp.status(identifier) + tp.command(content)
        if identifier == SET_ORDER:
            reader.integer()
            return tp.status(identifier)
        raise RefusedError(f"merge-sumo has no command 0x{identifier:02x}", tp.NOT_IMPLEMENTED)

    def _get(self, identifier: int, reader: Reader) -> bytes:
        variable, object_id = reader.ubyte(), reader.string()
        value = self._value(identifier, variable, object_id, reader)
        head = bytes((identifier + TO_RESPONSE, variable)) + tp.raw_string(object_id)
        return tp.command(head + value)

    def _value(self, getter: int, variable: int, object_id: str, reader: Reader) -> bytes:
        """Return the typed value of a variable; raises `RefusedError` where there is none."""
        answer = _GETTERS[getter].get(variable)
        if answer is None:
            raise RefusedError(
                f"merge-sumo does not know variable 0x{variable:02x} of command 0x{getter:02x}"
            )
        return answer(self, object_id, reader)

    def _set(self, reader: Reader) -> None:
        variable, name = reader.ubyte(), reader.string()
        if name in VEHICLES and name != VUT:
            raise RefusedError(f"the vehicle '{name}' is not the controller's to command")
        self.vehicle(name)
        value = reader.typed()
        if variable == SET_SPEED and isinstance(value, float):
            self.wish = SpeedWish(None if value < 0.0 else value)
        elif variable in (SLOW_DOWN, SET_ACCELERATION) and _two_doubles(value):
            change, duration_s = value
            v_mps = self.vehicles[VUT].v_mps
            target = change if variable == SLOW_DOWN else max(v_mps + change * duration_s, 0.0)
            if duration_s < 0.0:
                raise RefusedError(f"a duration of {duration_s} s is negative")
            self.wish = SpeedWish(target, max(duration_s, DT_S))
        elif variable in (SET_SPEED, SLOW_DOWN, SET_ACCELERATION):
            raise ProtocolError(f"a speed was commanded by {value!r:.60}")
        elif variable not in ACCEPTED:
            raise RefusedError(
                f"merge-sumo does not carry out command 0x{variable:02x} on a vehicle: the VUT is "
                "driven by setSpeed, slowDown and setAcceleration"
            )

    def _subscribe(self, identifier: int, reader: Reader) -> bytes:
        getter = identifier - GETTERS_TO_SUBSCRIPTIONS
        begin_s, end_s, object_id = reader.double(), reader.double(), reader.string()
        variables = []
        for _ in range(reader.ubyte()):
            variable = reader.ubyte()
            variables.append((variable, _parameter(getter, variable, reader)))
        wanted = Subscription(getter, object_id, variables, begin_s, end_s)
        return self._keep(identifier, (getter, object_id, None), wanted)

    def _subscribe_context(self, identifier: int, reader: Reader) -> bytes:
        getter = identifier - GETTERS_TO_CONTEXTS
        begin_s, end_s, object_id = reader.double(), reader.double(), reader.string()
        domain, range_m = reader.ubyte(), reader.double()
        variables = [(reader.ubyte(), b"") for _ in range(reader.ubyte())]
        if getter != GET_VEHICLE or domain != GET_VEHICLE:
            raise RefusedError("merge-sumo has context subscriptions of vehicles around vehicles")
        key = (getter, object_id, domain)
        wanted = Subscription(getter, object_id, variables, begin_s, end_s, domain, range_m)
        return self._keep(identifier, key, wanted)

    def _keep(
        self, identifier: int, key: tuple[int, str, int | None], subscription: Subscription
    ) -> bytes:
        """Keep a subscription, or drop it where it names no variable; return the answer."""
        if not subscription.variables:
            self.subscriptions.pop(key, None)
            return tp.status(identifier)
        answer = self._result(subscription)
        self.subscriptions[key] = subscription
        return tp.status(identifier) + answer

    def results(self) -> bytes:
        """Return the answer to a step behind its status: the subscribed values."""
        now = self.time_s
        due = [
            subscription
            for subscription in self.subscriptions.values()
            if subscription.begin_s <= now
            and (subscription.end_s == FOR_EVER or now <= subscription.end_s)
        ]
        return tp.raw_integer(len(due)) + b"".join(map(self._result, due))

    def _result(self, subscription: Subscription) -> bytes:
        object_id = subscription.object_id
        if subscription.getter == GET_VEHICLE and object_id:
            self.vehicle(object_id)
        name, count = tp.raw_string(object_id), bytes((len(subscription.variables),))
        if subscription.domain is None:
            head = bytes((subscription.getter + GETTERS_TO_SUBSCRIPTIONS + TO_RESPONSE,))
            return tp.command(head + name + count + self._values(subscription, object_id))
        around = self._around(object_id, subscription.range_m)
        head = bytes((subscription.getter + GETTERS_TO_CONTEXTS + TO_RESPONSE,))
        head += name + bytes((subscription.domain,)) + count + tp.raw_integer(len(around))
        items = (tp.raw_string(other) + self._values(subscription, other) for other in around)
        return tp.command(head + b"".join(items))

    def _values(self, subscription: Subscription, object_id: str) -> bytes:
        getter = subscription.domain or subscription.getter
        parts = []
        for variable, parameter in subscription.variables:
            try:
                value = self._value(getter, variable, object_id, Reader(parameter))
                parts.append(bytes((variable, tp.OK)) + value)
            except RefusedError as refused:
                parts.append(bytes((variable, tp.ERROR)) + tp.string(str(refused)))
        return b"".join(parts)

    def _around(self, name: str, range_m: float) -> list[str]:
        """Return the vehicles within a distance of one of them, itself included, as SUMO does."""
        x, y = self.point(name)[2:4]
        return [
            other for other in self.vehicles if math.dist((x, y), self.point(other)[2:4]) <= range_m
        ]

    def vehicle(self, name: str) -> _Vehicle:
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
        return list(dict.fromkeys(map(_edge_of, self.lanes())))

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


def _two_doubles(value: object) -> bool:
    return isinstance(value, tuple) and len(value) == 2 and all(type(v) is float for v in value)


_WITH_PARAMETER: Final = {(GET_VEHICLE, 0x68), (GET_VEHICLE, 0x78), (GET_VEHICLE, PARAMETER)}
"""Variables that take a parameter: getLeader, getFollower, getParameter."""


def _parameter(getter: int, variable: int, reader: Reader) -> bytes:
    """Return the parameter of a subscribed variable as it was sent; b"" where it takes none."""
    if (getter, variable) not in _WITH_PARAMETER:
        return b""
    value = reader.typed()
    if isinstance(value, str):
        return tp.string(value)
    if isinstance(value, float):
        return tp.double(value)
    raise ProtocolError(f"a parameter is {value!r:.40}")


Getter = Callable[[Session, str, Reader], bytes]


def _of_vehicle(value: Callable[[Session, str, _Vehicle], bytes]) -> Getter:
    return lambda session, name, _: value(session, name, session.vehicle(name))


def _constant(value: bytes) -> Getter:
    return _of_vehicle(lambda _s, _n, _v: value)


def _leader(session: Session, name: str, reader: Reader) -> bytes:
    reader.typed_double()
    other, gap_m = session.leader(name)
    return tp.compound(tp.string(other), tp.double(gap_m))


def _follower(session: Session, name: str, reader: Reader) -> bytes:
    reader.typed_double()
    for other in session.vehicles:
        ahead, gap_m = session.leader(other)
        if ahead == name:
            return tp.compound(tp.string(other), tp.double(gap_m))
    return tp.compound(tp.string(""), tp.double(-1.0))


def _edge_of(lane: str) -> str:
    return lane.rpartition("_")[0]


def _index_of(lane: str) -> int:
    return int(lane.rpartition("_")[2])


def _route(path: LanePath) -> list[str]:
    return [_edge_of(piece.lane) for piece in path.pieces if not piece.is_internal]


def _route_index(path: LanePath, x_m: float) -> int:
    """Return the number of the edge; inside of a junction it is that of the edge before."""
    begun = [p for p in path.pieces if p.start_m <= x_m and not p.is_internal]
    return max(len(begun) - 1, 0)


_VEHICLE: Final[dict[int, Getter]] = {
    ID_LIST: lambda s, _n, _r: tp.strings(list(s.vehicles)),
    ID_COUNT: lambda s, _n, _r: tp.integer(len(s.vehicles)),
    0x40: _of_vehicle(lambda _s, _n, v: tp.double(v.v_mps)),  # getSpeed
    0xB1: _of_vehicle(lambda _s, _n, v: tp.double(v.v_mps)),  # getSpeedWithoutTraCI
    0x72: _of_vehicle(lambda _s, _n, v: tp.double(v.a_mps2)),  # getAcceleration
    0x56: _of_vehicle(lambda s, n, _v: tp.double(s.point(n)[1])),  # getLanePosition
    0x42: _of_vehicle(lambda s, n, _v: tp.position(*s.point(n)[2:4])),  # getPosition
    0x39: _of_vehicle(lambda s, n, _v: tp.position(*s.point(n)[2:4], 0.0)),  # getPosition3D
    0x43: _of_vehicle(lambda s, n, _v: tp.double(s.point(n)[4])),  # getAngle
    0x51: _of_vehicle(lambda s, n, _v: tp.string(s.point(n)[0])),  # getLaneID
    0x50: _of_vehicle(lambda s, n, _v: tp.string(_edge_of(s.point(n).lane))),  # getRoadID
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


def _on_lane(session: Session, lane: str) -> list[str]:
    session.lane(lane)
    return [name for name in session.vehicles if session.point(name)[0] == lane]


def _of_lane(value: Callable[[Piece], bytes]) -> Getter:
    return lambda session, name, _: value(session.lane(name))


_LANE: Final[dict[int, Getter]] = {
    ID_LIST: lambda s, _n, _r: tp.strings(list(s.lanes())),
    ID_COUNT: lambda s, _n, _r: tp.integer(len(s.lanes())),
    0x44: _of_lane(lambda lane: tp.double(lane.length_m)),  # getLength
    0x41: _of_lane(lambda lane: tp.double(lane.speed_limit_mps)),  # getMaxSpeed
    0x31: _of_lane(lambda lane: tp.string(_edge_of(lane.lane))),  # getEdgeID
    0x4E: _of_lane(lambda lane: tp.polygon([(x, y) for x, y, _ in lane.shape])),  # getShape
    0x10: lambda s, n, _r: tp.integer(len(_on_lane(s, n))),  # getLastStepVehicleNumber
    0x12: lambda s, n, _r: tp.strings(_on_lane(s, n)),  # getLastStepVehicleIDs
}


def _on_edge(session: Session, edge: str) -> list[str]:
    if edge not in session.edges():
        raise RefusedError(f"Edge '{edge}' is not known.")
    return [name for name in session.vehicles if _edge_of(session.point(name).lane) == edge]


_EDGE: Final[dict[int, Getter]] = {
    ID_LIST: lambda s, _n, _r: tp.strings(s.edges()),
    ID_COUNT: lambda s, _n, _r: tp.integer(len(s.edges())),
    0x10: lambda s, n, _r: tp.integer(len(_on_edge(s, n))),
    0x12: lambda s, n, _r: tp.strings(_on_edge(s, n)),
}


def _junction(session: Session, name: str, _reader: Reader) -> bytes:
    """Return the position of the junction at M: M itself."""
    if name != session.road.junction_id:
        raise RefusedError(f"Junction '{name}' is not known.")
    at = session.road.lane_point(0.0, on_ramp=False)
    return tp.position(at.x_m, at.y_m)


_JUNCTION: Final[dict[int, Getter]] = {
    ID_LIST: lambda s, _n, _r: tp.strings((s.road.junction_id,)),
    ID_COUNT: lambda _s, _n, _r: tp.integer(1),
    0x42: _junction,  # getPosition
}
_GETTERS: Final = {
    GET_VEHICLE: _VEHICLE,
    GET_SIMULATION: _SIMULATION,
    GET_LANE: _LANE,
    GET_EDGE: _EDGE,
    GET_JUNCTION: _JUNCTION,
}
