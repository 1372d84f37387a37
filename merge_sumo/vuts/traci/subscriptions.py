"""What a TraCI client has subscribed to: values that it gets with the answer to every step.

SUMO's own results are those before the vehicles are put back, so every value is asked for anew.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final

from merge_sumo.scenario.scenario import VEHICLES
from merge_sumo.sumo.shadow_sumo import RefusedError, ShadowSumo
from merge_sumo.sumo.traci_names import named
from merge_sumo.vuts.traci import protocol as tp
from merge_sumo.vuts.traci.protocol import GET_VEHICLE, PARAMETER, Reader, pack

SUBSCRIBE: Final = 0x30
CONTEXT: Final = -0x20
RESPONSE: Final = 0x10
"""Distances from the identifier of a domain's questions to those of its subscriptions, of its
contexts, and from each of these to that of the answer."""
FOR_EVER: Final = -1073741824.0
ID_COUNT: Final = 0x01
"""A variable that every domain has."""
WITH_PARAMETER: Final = {(GET_VEHICLE, 0x68), (GET_VEHICLE, 0x78), (GET_VEHICLE, PARAMETER)}
"""Domain and variable of getLeader, getFollower and getParameter."""


@dataclass(frozen=True, slots=True)
class Subscription:
    """Variables of an object, or of the objects of a domain around it, sent from begin to end."""

    getter: int  # identifier of the questions of the object's domain
    object_id: str
    variables: tuple[tuple[int, bytes], ...]
    """Numbers of the variables, each with its parameter as it was sent."""
    begin_s: float
    end_s: float
    domain: int | None = None
    """Identifier of the questions of the domain around the object, as far as `range_m`; None for
    the object."""
    range_m: float = 0.0

    @property
    def of(self) -> tuple[int, str, int | None]:
        """What it is about."""
        return self.getter, self.object_id, self.domain


class Subscriptions:
    """The subscriptions of one client, in the order in which they were made."""

    def __init__(
        self, sumo: ShadowSumo, value_of: Callable[[int, int, str, Reader], bytes]
    ) -> None:
        """Take what answers: `value_of` is called with getter, variable, object and parameter."""
        self._sumo, self._value_of = sumo, value_of
        self.all: list[Subscription] = []

    def subscribe(self, getter: int, reader: Reader) -> bytes:
        """Subscribe to variables of an object; return the first values."""
        begin_s, end_s, object_id = reader.double(), reader.double(), reader.string()
        variables = []
        for _ in range(reader.ubyte()):
            variable = reader.ubyte()
            with_parameter = (getter, variable) in WITH_PARAMETER
            variables.append((variable, reader.typed_bytes() if with_parameter else b""))
        return self._keep(Subscription(getter, object_id, tuple(variables), begin_s, end_s))

    def subscribe_context(self, getter: int, reader: Reader) -> bytes:
        """Subscribe to variables of what is around an object; return the first values."""
        begin_s, end_s, object_id = reader.double(), reader.double(), reader.string()
        domain, range_m = reader.ubyte(), reader.double()
        variables = tuple((reader.ubyte(), b"") for _ in range(reader.ubyte()))
        return self._keep(
            Subscription(getter, object_id, variables, begin_s, end_s, domain, range_m)
        )

    def _keep(self, wanted: Subscription) -> bytes:
        """Keep a subscription; return its values.

        As in SUMO it adds to one that differs in its variables alone; one without variables ends
        all of the object, whatever their range.
        """
        if not wanted.variables:
            self.all = [kept for kept in self.all if kept.of != wanted.of]
            return b""
        for place, kept in enumerate(self.all):
            if replace(kept, variables=wanted.variables) == wanted:
                both = dict.fromkeys((*kept.variables, *wanted.variables))
                added = replace(wanted, variables=tuple(both))
                answer = self._result(added)
                self.all[place] = added
                return answer
        answer = self._result(wanted)
        self.all.append(wanted)
        return answer

    def end_of_vehicles(self) -> None:
        """End what was subscribed of the vehicles of an episode."""
        ended = [s for s in self.all if s.getter == GET_VEHICLE and s.object_id in VEHICLES]
        self.all = [kept for kept in self.all if kept not in ended]

    def results(self, now_s: float) -> bytes:
        """Return the values of all subscriptions: the answer to a step behind its status."""
        answers = []
        for subscription in self.all:
            end_s = math.inf if subscription.end_s == FOR_EVER else subscription.end_s
            if subscription.begin_s <= now_s <= end_s:
                # Of what SUMO cannot tell any more, nothing is sent.
                with suppress(RefusedError):
                    answers.append(self._result(subscription))
        return tp.raw_integer(len(answers)) + b"".join(answers)

    def _result(self, subscription: Subscription) -> bytes:
        getter, object_id = subscription.getter, subscription.object_id
        if getter == GET_VEHICLE and object_id and object_id not in self._sumo.at_m:
            raise RefusedError(f"Vehicle '{object_id}' is not known.")
        name, count = tp.raw_string(object_id), bytes((len(subscription.variables),))
        if subscription.domain is None:
            head = bytes((getter + SUBSCRIBE + RESPONSE,)) + name + count
            return tp.command(head + self._values(subscription, getter, object_id))
        objects = self._around(subscription)
        head = bytes((getter + CONTEXT + RESPONSE,)) + name + bytes((subscription.domain,))
        items = (
            tp.raw_string(other) + self._values(subscription, subscription.domain, other)
            for other in objects
        )
        return tp.command(head + count + tp.raw_integer(len(objects)) + b"".join(items))

    def _around(self, subscription: Subscription) -> list[str]:
        """Return the objects of a subscription's domain that are near its object."""
        domain = _domain_of(subscription.getter)
        context = subscription.object_id, subscription.domain, subscription.range_m
        self._sumo.call(f"{domain}.subscribeContext", *context, [ID_COUNT])
        try:
            results = f"{domain}.getContextSubscriptionResults"
            return list(self._sumo.call(results, subscription.object_id))
        finally:
            self._sumo.call(f"{domain}.unsubscribeContext", *context)

    def _values(self, subscription: Subscription, getter: int, object_id: str) -> bytes:
        parts = []
        for variable, parameter in subscription.variables:
            try:
                value, code = self._value_of(getter, variable, object_id, Reader(parameter)), tp.OK
            except RefusedError as refused:
                value, code = pack("s", refused), tp.ERROR
            parts.append(bytes((variable, code)) + value)
        return b"".join(parts)


def _domain_of(getter: int) -> str:
    """Return the name of a domain, by the identifier of its questions."""
    for (command, _), known in named().items():
        if command == getter:
            return known.functions[0].partition(".")[0]
    raise RefusedError(f"there is no domain 0x{getter:02x}")
