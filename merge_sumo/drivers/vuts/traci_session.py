"""What a TraCI client may do: it asks, commands the VUT and subscribes, and gets answers.

The session has no socket and does not decide when a step is made. What there is to see is in
`traci_simulation.py`, what can be asked of it in `traci_variables.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Final

from merge_sumo.drivers.vuts import traci_protocol as tp
from merge_sumo.drivers.vuts.traci_protocol import Command, ProtocolError, Reader
from merge_sumo.drivers.vuts.traci_simulation import VUT, RefusedError, Simulation
from merge_sumo.drivers.vuts.traci_variables import GET_VEHICLE, GETTERS
from merge_sumo.values.scenario import DT_S, VEHICLES

API_VERSION: Final = 22
"""Of the TraCI of SUMO 1.28."""

GET_VERSION: Final = 0x00
SIMULATION_STEP: Final = 0x02
SET_ORDER: Final = 0x03
CLOSE: Final = 0x7F

SET_VEHICLE: Final = 0xC4
GETTERS_TO_SUBSCRIPTIONS: Final = 0x30
GETTERS_TO_CONTEXTS: Final = -0x20
TO_RESPONSE: Final = 0x10
"""Identifiers of the kinds of command lie these distances apart, for every domain."""

SLOW_DOWN, SET_SPEED, SET_ACCELERATION = 0x14, 0x40, 0x72
SPEED_MODE, LANE_CHANGE_MODE, COLOUR, PARAMETER = 0xB3, 0xB6, 0x45, 0x7E
ACCEPTED: Final = frozenset({SPEED_MODE, LANE_CHANGE_MODE, COLOUR, PARAMETER})
"""Commands on the VUT that change nothing: eq. (4) and the limits of acceleration hold anyway."""
FOR_EVER: Final = -1073741824.0


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


@dataclass
class Session(Simulation):
    """The simulation as one client sees it, and what it has asked for."""

    wish: SpeedWish = field(default_factory=SpeedWish)
    subscriptions: dict[tuple[int, str, int | None], Subscription] = field(default_factory=dict)

    def clear(self, *, more: bool) -> None:
        """Advance by a step, to an empty road; `more` vehicles may come."""
        super().clear(more=more)
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
        if identifier in GETTERS:
            return tp.status(identifier) + self._get(identifier, reader)
        if identifier == SET_VEHICLE:
            self._set(reader)
            return tp.status(identifier)
        if identifier - GETTERS_TO_SUBSCRIPTIONS in GETTERS:
            return self._subscribe(identifier, reader)
        if identifier - GETTERS_TO_CONTEXTS in GETTERS:
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
        answer = GETTERS[getter].get(variable)
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
        around = self.around(object_id, subscription.range_m)
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
