"""What a TraCI client sees and may do: questions and commands go to the shadow SUMO.

The session has no socket and does not decide when a step is made. Time runs on over the episodes:
in each the vehicles depart, and when it ends they arrive.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Final, TypeVar

from merge_sumo.sumo.binding import SUMO_VERSION
from merge_sumo.sumo.shadow_sumo import NAME_OF_VUT, RefusedError, ShadowSumo, State
from merge_sumo.sumo.traci_names import name_of, named
from merge_sumo.values.scenario import VEHICLES
from merge_sumo.vuts.traci import protocol as tp
from merge_sumo.vuts.traci.answers import packed
from merge_sumo.vuts.traci.calls import (
    OF_OTHERS,
    Kind,
    asked_of,
    kind_of,
    reason_against,
    told_by,
)
from merge_sumo.vuts.traci.protocol import Command, ProtocolError, Reader

T = TypeVar("T")

API_VERSION: Final = 22
"""Of the TraCI of SUMO 1.28."""

GET_VERSION: Final = 0x00
SIMULATION_STEP: Final = 0x02
SET_ORDER: Final = 0x03
CLOSE: Final = 0x7F

ASKS: Final = frozenset({*range(0x24, 0x2C), *range(0xA0, 0xB0)})
"""Identifiers of the commands that ask, one for each domain."""
SETTERS_TO_GETTERS: Final = 0x20
GETTERS_TO_SUBSCRIPTIONS: Final = 0x30
GETTERS_TO_CONTEXTS: Final = -0x20
TO_RESPONSE: Final = 0x10
"""Identifiers of the kinds of command lie these distances apart, for every domain."""

GET_VEHICLE, GET_SIMULATION, SET_VEHICLE, SET_VEHICLETYPE = 0xA4, 0xAB, 0xC4, 0xC5
LANE_CHANGE_MODE: Final = 0xB6
LANE_CHANGE_BITS: Final = 0xFFF
PARAMETER: Final = 0x7E
LOAD, ADD_FILTER = 0x01, 0x7E
REASONS: Final = {
    LOAD: "the campaign runs the simulation",
    ADD_FILTER: "subscribe to all that is around, and choose from it",
}
"""Why a command on no variable is refused."""
OWN_TYPE: Final = f"{NAME_OF_VUT}@{NAME_OF_VUT}"
"""What SUMO calls the type of a vehicle that has numbers of its own."""
FOR_EVER: Final = -1073741824.0
EXPECTED: Final = 2
"""Vehicles that are expected between two episodes."""


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

    @property
    def of(self) -> tuple[int, str, int | None]:
        """What it is about."""
        return self.getter, self.object_id, self.domain

    def with_variables(self, variables: list[tuple[int, bytes]]) -> Subscription:
        """Return the same on other variables."""
        return replace(self, variables=variables)


@dataclass
class Session:
    """The simulation as one client sees it, and what it has subscribed to."""

    sumo: ShadowSumo
    subscriptions: list[Subscription] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    """Sentences on what a command does less than in SUMO, once each."""
    expected: bool = True
    """Whether more vehicles may come."""
    departed: list[str] = field(default_factory=list)
    arrived: list[str] = field(default_factory=list)
    lane_change_mode: int = 0

    @property
    def time_s(self) -> float:
        """Simulation time."""
        return self.sumo.time_s

    @property
    def driving(self) -> bool:
        """Whether the vehicles of an episode are on the road."""
        return bool(self.sumo.at_m)

    def answered(self) -> None:
        """Forget who departed and arrived: the client has been told."""
        self.departed.clear()
        self.arrived.clear()

    def enter(self, states: Mapping[str, State]) -> None:
        """Make a step in which the vehicles depart."""
        self.sumo.enter(states)
        self.departed += states
        self.lane_change_mode = 0

    def step(self) -> float | None:
        """Make a step; return the speed that SUMO gives the VUT by what was commanded."""
        return self._noting_arrivals(self.sumo.step)

    def put(self, states: Mapping[str, State]) -> None:
        """Put the vehicles where they are after the step."""
        self._noting_arrivals(lambda: self.sumo.put(states))

    def clear(self) -> None:
        """End the episode: all vehicles arrive, and what was subscribed of them ends."""
        self._noting_arrivals(self.sumo.clear)
        self.subscriptions = [
            subscription
            for subscription in self.subscriptions
            if subscription.getter != GET_VEHICLE or subscription.object_id not in VEHICLES
        ]

    def _noting_arrivals(self, change: Callable[[], T]) -> T:
        before = list(self.sumo.at_m)
        result = change()
        self.arrived += [name for name in before if name not in self.sumo.at_m]
        return result

    def handle(self, command: Command) -> bytes:
        """Return the answer to any command but a step or a close; raises `ProtocolError`."""
        identifier, reader = command.identifier, Reader(command.payload)
        try:
            return self._handle(identifier, reader)
        except RefusedError as refused:
            code = tp.NOT_IMPLEMENTED if identifier in REASONS else tp.ERROR
            return tp.status(identifier, code, str(refused))

    def _handle(self, identifier: int, reader: Reader) -> bytes:
        if identifier in ASKS:
            return tp.status(identifier) + self._get(identifier, reader)
        if identifier - SETTERS_TO_GETTERS in ASKS:
            self._set(identifier, reader)
            return tp.status(identifier)
        if identifier - GETTERS_TO_SUBSCRIPTIONS in ASKS:
            return self._subscribe(identifier, reader)
        if identifier - GETTERS_TO_CONTEXTS in ASKS:
            return self._subscribe_context(identifier, reader)
        if identifier == GET_VERSION:
            return tp.status(identifier) + version_answer()
        if identifier == SET_ORDER:
            reader.integer()
            return tp.status(identifier)
        reason = REASONS.get(identifier, "it is made for SUMO as a program")
        raise RefusedError(f"merge-sumo does not carry out {name_of(identifier)}: {reason}")

    def _get(self, identifier: int, reader: Reader) -> bytes:
        variable, object_id = reader.ubyte(), reader.string()
        value = self._value(identifier, variable, object_id, reader)
        head = bytes((identifier + TO_RESPONSE, variable)) + tp.raw_string(object_id)
        return tp.command(head + value)

    def _value(self, getter: int, variable: int, object_id: str, reader: Reader) -> bytes:
        """Return the typed value of a variable; raises `RefusedError` where there is none."""
        own = OWN_ANSWERS.get((getter, variable))
        if own is not None and (getter == GET_SIMULATION or object_id in self.sumo.at_m):
            return own(self, object_id)
        found = named().get((getter, variable))
        if found is None:
            raise RefusedError(f"merge-sumo does not answer {name_of(getter, variable)}")
        function, arguments = asked_of(found.functions, object_id, reader)
        return packed(function, self.sumo.call(function, *arguments))

    def _set(self, command: int, reader: Reader) -> None:
        """Have a command carried out, or note that it changes nothing, or refuse it."""
        variable, object_id = reader.ubyte(), reader.string()
        found = named().get((command, variable))
        functions: tuple[str, ...] = () if found is None else found.functions
        name, kind = name_of(command, variable), kind_of(functions)
        if kind is Kind.REFUSED:
            reason = reason_against(functions)
            raise RefusedError(f"merge-sumo does not carry out {name}: {reason}")
        if command == SET_VEHICLE and object_id not in self.sumo.at_m:
            raise RefusedError(f"Vehicle '{object_id}' is not known.")
        mine = object_id in (NAME_OF_VUT, OWN_TYPE)
        if kind is Kind.CARRIED_OUT and mine:
            function, arguments = told_by(functions, object_id, reader)
            self.sumo.call(function, *arguments)
            return
        if kind is Kind.CARRIED_OUT and OF_OTHERS.isdisjoint(functions):
            what = "vehicle" if command == SET_VEHICLE else "type"
            raise RefusedError(f"the {what} '{object_id}' is not the controller's to command")
        if command == SET_VEHICLE and mine and variable == LANE_CHANGE_MODE:
            mode = reader.typed()
            if not isinstance(mode, int):
                raise RefusedError("a mode is an integer")
            self.lane_change_mode = mode & LANE_CHANGE_BITS
        self._note_once(f"{name} is accepted and changes nothing here")

    def _note_once(self, sentence: str) -> None:
        if sentence not in self.notes:
            self.notes.append(sentence)

    def _subscribe(self, identifier: int, reader: Reader) -> bytes:
        getter = identifier - GETTERS_TO_SUBSCRIPTIONS
        begin_s, end_s, object_id = reader.double(), reader.double(), reader.string()
        variables = []
        for _ in range(reader.ubyte()):
            variable = reader.ubyte()
            variables.append((variable, _parameter(getter, variable, reader)))
        return self._keep(identifier, Subscription(getter, object_id, variables, begin_s, end_s))

    def _subscribe_context(self, identifier: int, reader: Reader) -> bytes:
        getter = identifier - GETTERS_TO_CONTEXTS
        begin_s, end_s, object_id = reader.double(), reader.double(), reader.string()
        domain, range_m = reader.ubyte(), reader.double()
        variables = [(reader.ubyte(), b"") for _ in range(reader.ubyte())]
        wanted = Subscription(getter, object_id, variables, begin_s, end_s, domain, range_m)
        return self._keep(identifier, wanted)

    def _keep(self, identifier: int, wanted: Subscription) -> bytes:
        """Keep a subscription; return the answer.

        As in SUMO it adds to one that differs in its variables alone; one without variables ends
        all of the object, whatever their range.
        """
        if not wanted.variables:
            self.subscriptions = [s for s in self.subscriptions if s.of != wanted.of]
            return tp.status(identifier)
        same = [s for s in self.subscriptions if s.with_variables([]) == wanted.with_variables([])]
        before = same[0].variables if same else []
        new = [variable for variable in wanted.variables if variable not in before]
        added = wanted.with_variables([*before, *new])
        answer = self._result(added)
        if same:
            self.subscriptions[self.subscriptions.index(same[0])] = added
        else:
            self.subscriptions.append(added)
        return tp.status(identifier) + answer

    def results(self) -> bytes:
        """Return the answer to a step behind its status: the subscribed values."""
        answers, now_s = [], self.time_s
        for subscription in self.subscriptions:
            over = now_s > subscription.end_s != FOR_EVER
            if now_s < subscription.begin_s or over:
                continue
            # Of what SUMO cannot tell any more there is no answer.
            with suppress(RefusedError):
                answers.append(self._result(subscription))
        return tp.raw_integer(len(answers)) + b"".join(answers)

    def _result(self, subscription: Subscription) -> bytes:
        object_id = subscription.object_id
        if subscription.getter == GET_VEHICLE and object_id and object_id not in self.sumo.at_m:
            raise RefusedError(f"Vehicle '{object_id}' is not known.")
        name, count = tp.raw_string(object_id), bytes((len(subscription.variables),))
        if subscription.domain is None:
            head = bytes((subscription.getter + GETTERS_TO_SUBSCRIPTIONS + TO_RESPONSE,))
            return tp.command(head + name + count + self._values(subscription, object_id))
        around = self._around(subscription)
        head = bytes((subscription.getter + GETTERS_TO_CONTEXTS + TO_RESPONSE,))
        head += name + bytes((subscription.domain,)) + count + tp.raw_integer(len(around))
        items = (tp.raw_string(other) + self._values(subscription, other) for other in around)
        return tp.command(head + b"".join(items))

    def _around(self, subscription: Subscription) -> list[str]:
        """Return the objects of a subscription's domain that are near its object."""
        getter, domain, object_id = subscription.getter, subscription.domain, subscription.object_id
        if getter == domain == GET_VEHICLE:
            me = self.sumo.point(object_id)
            points = {other: self.sumo.point(other) for other in self.sumo.at_m}
            return [
                other
                for other, at in points.items()
                if math.dist(me[2:4], at[2:4]) <= subscription.range_m
            ]
        mine = _domain_of(getter)
        given = object_id, domain, subscription.range_m
        self.sumo.call(f"{mine}.subscribeContext", *given, [ID_COUNT])
        try:
            found = self.sumo.call(f"{mine}.getContextSubscriptionResults", object_id)
        finally:
            self.sumo.call(f"{mine}.unsubscribeContext", *given)
        return list(found)

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


ID_COUNT: Final = 0x01


def _domain_of(getter: int) -> str:
    """Return what a domain is called, by the identifier of its questions."""
    for (command, _), found in named().items():
        if command == getter:
            return found.functions[0].partition(".")[0]
    raise RefusedError(f"there is no domain 0x{getter:02x}")


def version_answer() -> bytes:
    """Return the answer to the question for the version, behind its status."""
    text = tp.raw_string(f"SUMO {SUMO_VERSION}, hosted by merge-sumo")
    return tp.command(bytes((GET_VERSION,)) + tp.raw_integer(API_VERSION) + text)


def _expected(session: Session, _: str) -> bytes:
    return tp.integer(max(len(session.sumo.at_m), EXPECTED * session.expected))


def _position(session: Session, name: str, *height_m: float) -> bytes:
    return tp.position(*session.sumo.point(name)[2:4], *height_m)


OWN_ANSWERS: Final[dict[tuple[int, int], Callable[[Session, str], bytes]]] = {
    # SUMO's own answers to these are those before the vehicle was put where it is.
    (GET_VEHICLE, 0x42): _position,  # getPosition
    (GET_VEHICLE, 0x39): lambda s, name: _position(s, name, 0.0),  # getPosition3D
    (GET_VEHICLE, 0x43): lambda s, name: tp.double(s.sumo.point(name)[4]),  # getAngle
    (GET_VEHICLE, LANE_CHANGE_MODE): lambda s, name: tp.integer(
        s.lane_change_mode if name == NAME_OF_VUT else 0
    ),
    # Several of SUMO's steps may pass in one of the client's, and an episode may end in it.
    (GET_SIMULATION, 0x73): lambda s, _: tp.integer(len(s.departed)),
    (GET_SIMULATION, 0x74): lambda s, _: tp.strings(s.departed),
    (GET_SIMULATION, 0x71): lambda s, _: tp.integer(len(s.departed)),  # loaded
    (GET_SIMULATION, 0x72): lambda s, _: tp.strings(s.departed),
    (GET_SIMULATION, 0x79): lambda s, _: tp.integer(len(s.arrived)),
    (GET_SIMULATION, 0x7A): lambda s, _: tp.strings(s.arrived),
    (GET_SIMULATION, 0x7D): _expected,  # getMinExpectedNumber
}
"""What is answered here and not by SUMO, by the numbers of domain and variable."""

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
