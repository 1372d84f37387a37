"""What a TraCI client may do: it asks, commands the VUT and subscribes, and gets answers.

The session has no socket and does not decide when a step is made. What there is to see is in
`traci_simulation.py`, what can be asked of it in `traci_variables.py`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from typing import Final, TypeVar

from merge_sumo.drivers.vuts import traci_protocol as tp
from merge_sumo.drivers.vuts.base import Seen
from merge_sumo.drivers.vuts.traci_commands import (
    LIMITS,
    MODES,
    OF_MODEL,
    OWN_TYPE,
    SET_VEHICLE,
    SET_VEHICLETYPE,
    SPEED_MODE,
    SPEEDS,
    Kind,
    Orders,
    kind_of,
    note_on,
    reason_against,
)
from merge_sumo.drivers.vuts.traci_protocol import Command, ProtocolError, Reader
from merge_sumo.drivers.vuts.traci_simulation import VUT, RefusedError, Simulation
from merge_sumo.drivers.vuts.traci_variables import (
    GET_EDGE,
    GET_LANE,
    GET_VEHICLE,
    GETTERS,
    ID_COUNT,
)
from merge_sumo.errors import UserError
from merge_sumo.sumo.beside import Beside, GoneError, State
from merge_sumo.sumo.traci_names import name_of, named
from merge_sumo.values.scenario import DT_S, VEHICLES

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

PARAMETER: Final = 0x7E
LOAD, ADD_FILTER = 0x01, 0x7E
REASONS: Final = {
    LOAD: "the campaign runs the simulation",
    ADD_FILTER: "subscribe to all that is around, and choose from it",
}
"""Why a command on no variable is refused."""
FOR_EVER: Final = -1073741824.0


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
class Session(Simulation):
    """The simulation as one client sees it, and what it has asked for."""

    orders: Orders = field(init=False)
    subscriptions: list[Subscription] = field(default_factory=list)
    note: Callable[[str], None] = lambda _: None
    """Told in a sentence, once each, what a command does less than in SUMO."""
    noted: set[str] = field(default_factory=set)
    history: list[dict[str, State]] = field(default_factory=list)
    """The states of the episode so far, for a SUMO that is asked for the first time."""
    beside: Beside | None = None
    no_beside: str = ""
    """Why there is no such SUMO."""

    def __post_init__(self) -> None:
        """Begin without orders."""
        self.orders = Orders(self.scenario)

    def show(self, seen: Seen) -> None:
        """Advance by a step, to a state with all vehicles."""
        super().show(seen)
        state = {name: (v.x_m, v.v_mps, v.a_mps2) for name, v in self.vehicles.items()}
        self.history.append(state)
        if self.beside is not None:
            self.beside.show(state)

    def close(self) -> None:
        """End the SUMO beside."""
        if self.beside is not None:
            self.beside.close()
            self.beside = None

    def clear(self, *, more: bool) -> None:
        """Advance by a step, to an empty road; `more` vehicles may come."""
        super().clear(more=more)
        self.orders.forget_vehicle()
        self.history.clear()
        if self.beside is not None:
            self.beside.show({})
        self.subscriptions = [
            subscription
            for subscription in self.subscriptions
            if subscription.getter != GET_VEHICLE or subscription.object_id not in VEHICLES
        ]

    def acceleration_mps2(self) -> float:
        """Return what the last commands on the VUT ask for in the coming step."""
        v_mps = self.vehicles[VUT].v_mps
        return (self.orders.next_mps(v_mps) - v_mps) / DT_S

    def handle(self, command: Command) -> bytes:
        """Return the answer to any command but a step or a close; raises `ProtocolError`."""
        identifier, reader = command.identifier, Reader(command.payload)
        try:
            return self._handle(identifier, reader)
        except RefusedError as refused:
            return tp.status(identifier, refused.result, str(refused))

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
            text = tp.raw_string(f"SUMO {version('libsumo')}, hosted by merge-sumo")
            content = bytes((identifier,)) + tp.raw_integer(API_VERSION) + text
            return tp.status(identifier) + tp.command(content)
        if identifier == SET_ORDER:
            reader.integer()
            return tp.status(identifier)
        reason = REASONS.get(identifier, "it is made for SUMO as a program")
        raise RefusedError(
            f"merge-sumo does not carry out {name_of(identifier)}: {reason}", tp.NOT_IMPLEMENTED
        )

    def _get(self, identifier: int, reader: Reader) -> bytes:
        variable, object_id = reader.ubyte(), reader.string()
        value = self._value(identifier, variable, object_id, reader)
        head = bytes((identifier + TO_RESPONSE, variable)) + tp.raw_string(object_id)
        return tp.command(head + value)

    def _value(self, getter: int, variable: int, object_id: str, reader: Reader) -> bytes:
        """Return the typed value of a variable; raises `RefusedError` where there is none."""
        if getter == GET_VEHICLE and object_id == VUT and VUT in self.vehicles:
            if variable in MODES:
                return tp.integer(self.orders.mode(variable))
            if self.orders.changed(variable):
                return self._from_sumo(getter, variable, object_id, reader.raw(reader.left))
        answer = GETTERS.get(getter, {}).get(variable)
        if answer is not None and self.knows(getter, object_id):
            return answer(self, object_id, reader)
        return self._from_sumo(getter, variable, object_id, reader.raw(reader.left))

    def knows(self, getter: int, object_id: str) -> bool:
        """Return whether an object is one that is answered for here, besides those of the net."""
        if getter == GET_LANE:
            return object_id in self.lanes()
        return getter != GET_EDGE or object_id in self.edges()

    def _from_sumo(self, getter: int, variable: int, object_id: str, parameter: bytes) -> bytes:
        """Return what the SUMO beside answers; raises `RefusedError`."""
        asked = bytes((getter, variable)) + tp.raw_string(object_id) + parameter
        return self._ask_sumo(name_of(getter, variable), asked, tp.value_in)

    def _ask_sumo(self, name: str, command: bytes, read: Callable[[Reader], T]) -> T:
        """Return what is read in SUMO's answer; it is started for the first such question.

        Raises `RefusedError` where it refuses, or where there is none.
        """
        if self.no_beside:
            raise RefusedError(f"{name} is not answered here: {self.no_beside}")
        try:
            if self.beside is None:
                self.beside = Beside(self.road, self.scenario, self.scenario.vehicles)
                for state in self.history:
                    self.beside.show(state)
                for kept in self.orders.all_kept():
                    with suppress(RefusedError):
                        self._tell(kept)
            if self.beside is None:
                raise GoneError  # it was told something that ended it
            return read(tp.accepted(self.beside.ask(tp.command(command))))
        except UserError as error:
            self.no_beside = str(error)
        except (GoneError, ProtocolError):
            self.no_beside = f"SUMO ended when it was asked for {name}"
        except tp.AnsweredError as error:
            raise RefusedError(str(error)) from error
        self.close()
        raise RefusedError(f"{name} is not answered here: {self.no_beside}")

    def _set(self, command: int, reader: Reader) -> None:
        """Carry a command out, or keep it, or note that it changes nothing, or refuse it."""
        variable = reader.ubyte()
        functions: tuple[str, ...]
        if command == SET_VEHICLE and variable in SPEEDS:
            # What comes in every step needs no look at the tables of SUMO's client.
            name, functions = SPEEDS[variable], (SPEEDS[variable],)
        else:
            name, found = name_of(command, variable), named().get((command, variable))
            functions = () if found is None else found.functions
        kind = kind_of(functions)
        if kind is Kind.REFUSED:
            reason = reason_against(functions)
            raise RefusedError(f"merge-sumo does not carry out {name}: {reason}")
        object_id, typed = reader.string(), reader.raw(reader.left)
        if command == SET_VEHICLE:
            self.vehicle(object_id)
        if command in (SET_VEHICLE, SET_VEHICLETYPE):
            mine = object_id in (VUT, OWN_TYPE)
            if mine and (kind is not Kind.NOTHING or variable in MODES):
                v_mps = self.vehicles[VUT].v_mps if VUT in self.vehicles else 0.0
                self.orders.carry_out(command, variable, object_id, typed, v_mps)
                if kind is Kind.KEPT or variable in LIMITS:
                    self._tell(bytes((command, variable)) + tp.raw_string(object_id) + typed)
            moves = kind is Kind.DRIVES or variable in OF_MODEL
            if moves and not mine and variable != SPEED_MODE:
                what = "vehicle" if command == SET_VEHICLE else "type"
                raise RefusedError(f"the {what} '{object_id}' is not the controller's to command")
        self._note_once(note_on(name, variable, kind, typed))

    def _tell(self, command: bytes) -> None:
        """Pass a command on to the SUMO beside, if there is one; raises `RefusedError`."""
        if self.beside is None:
            return
        try:
            tp.accepted(self.beside.ask(tp.command(command)))
        except tp.AnsweredError as error:
            raise RefusedError(str(error)) from error
        except (GoneError, ProtocolError):
            self.no_beside = f"SUMO ended when it was told {name_of(command[0], command[1])}"
            self.close()

    def _note_once(self, said: str) -> None:
        if said and said not in self.noted:
            self.noted.add(said)
            self.note(said)

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
        all of the object, whatever their time and range.
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
        now = self.time_s
        due = [
            subscription
            for subscription in self.subscriptions
            if subscription.begin_s <= now
            and (subscription.end_s == FOR_EVER or now <= subscription.end_s)
        ]
        answers = []
        for subscription in due:
            # Of what SUMO cannot tell any more there is no answer.
            with suppress(RefusedError):
                answers.append(self._result(subscription))
        return tp.raw_integer(len(answers)) + b"".join(answers)

    def _result(self, subscription: Subscription) -> bytes:
        object_id = subscription.object_id
        if subscription.getter == GET_VEHICLE and object_id:
            self.vehicle(object_id)
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
        assert domain is not None, "of what is around"  # noqa: S101
        if getter == domain == GET_VEHICLE:
            return self.around(object_id, subscription.range_m)
        command = getter + GETTERS_TO_CONTEXTS
        asked = bytes((command,)) + struct.pack("!dd", FOR_EVER, FOR_EVER)
        asked += tp.raw_string(object_id) + bytes((domain,))
        asked += struct.pack("!d", subscription.range_m)
        name = name_of(command)
        around = self._ask_sumo(name, asked + bytes((1, ID_COUNT)), tp.objects_in)
        self._ask_sumo(name, asked + bytes((0,)), lambda _: None)
        return around

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
