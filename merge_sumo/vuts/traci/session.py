"""What a TraCI client sees and may do: questions and commands go to the shadow SUMO.

The session has no socket and does not decide when a step is made. Time runs on over the episodes:
in each the vehicles depart, and when it ends they arrive. What a client has subscribed to it gets
with the answer to every step; SUMO's own results are those before the vehicles are put back, so
every value is asked for anew.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final, NamedTuple, TypeVar

from merge_sumo.scenario.scenario import DT_S, VEHICLES
from merge_sumo.sumo.shadow_sumo import NAME_OF_VUT, RefusedError, ShadowSumo, State
from merge_sumo.sumo.traci_names import name_of, named
from merge_sumo.vuts.traci import commands
from merge_sumo.vuts.traci import protocol as tp
from merge_sumo.vuts.traci.commands import Effect
from merge_sumo.vuts.traci.protocol import (
    GET_JUNCTION,
    GET_SIMULATION,
    GET_VEHICLE,
    Command,
    Reader,
    pack,
)
from merge_sumo.vuts.traci.questions import call_of_question, packed

T = TypeVar("T")

QUESTIONS: Final = frozenset({*range(0x24, 0x2C), *range(0xA0, 0xB0)})
"""Identifiers of questions, one for each domain."""
SET: Final = 0x20
SUBSCRIBE, AROUND = 0x30, -0x20
RESPONSE: Final = 0x10
"""Distances from there to the identifiers of a domain's commands, of its subscriptions and of its
context subscriptions, and from questions and subscriptions to those of their answers."""
FOR_EVER: Final = -1073741824.0
WITH_PARAMETER: Final = ("getLeader", "getFollower", "getParameter", "getParameterWithKey")
"""Functions whose variables have a parameter in a subscription."""
OWN_TYPE: Final = f"{NAME_OF_VUT}@{NAME_OF_VUT}"
"""What SUMO calls the type of a vehicle that has numbers of its own."""
STAYED: Final = (
    "vut came to the end of the acceleration lane without a lane change: it departs in lane change "
    "mode 0, in which changeLane merges it at once; in 1621, SUMO's own, SUMO merges it"
)
"""Noted of a controller that may not know of the lane."""
OFF_THE_LANE_M: Final = 2.0
"""A vehicle that its own model moves is on a lane up to here: half of the width of a wide one."""
EXPECTED: Final = 2
"""Vehicles that are expected between two episodes."""


@dataclass(frozen=True, slots=True)
class Subscription:
    """Variables of an object, or of those around it, sent from begin to end."""

    getter: int  # identifier of the questions of the object's domain
    object_id: str
    begin_s: float
    end_s: float
    around: tuple[int, float] | None = None
    """Identifier of the questions of those around it, and how far away they are at most, in m."""
    variables: tuple[tuple[int, bytes], ...] = ()
    """Numbers of the variables, each with its parameter as it was sent."""


class _Place(NamedTuple):
    """Where a client moves the VUT to: along its lanes, in the plane, beside the lane that ends."""

    x_m: float
    point: tuple[float, float]
    beside: bool


class Session:
    """The simulation as one client sees it.

    Attributes:
        notes: sentences on what a command does less than in SUMO, once each.
        in_vain: commands of this episode that change nothing here, and would in SUMO.
        expected: whether more vehicles may come.
        departed: vehicles that departed since the client was last answered; and `arrived`.
        subscriptions: in the order in which they were made.
    """

    def __init__(self, sumo: ShadowSumo) -> None:
        self.sumo = sumo
        self.subscriptions: list[Subscription] = []
        self.notes: list[str] = []
        self.in_vain: set[str] = set()
        self.expected = True
        self.departed: list[str] = []
        self.arrived: list[str] = []
        self._reached_mps: dict[str, float] = {}
        """Speeds at the end of the coming step, by the commands of REACHED that told them."""
        self._moved: list[_Place | None] = [None, None]
        """Where the client moved the VUT to in the last step, and in the coming one."""
        self._commands_speeds = False  # by the client, in this episode
        self._knows_of_the_lane = False
        """Whether the client has ever commanded anything of lanes."""

    @property
    def driving(self) -> bool:
        """Whether the vehicles of an episode are on the road."""
        return bool(self.sumo.at_m)

    def answered(self) -> None:
        """Forget which vehicles departed and arrived: the client knows."""
        self.departed.clear()
        self.arrived.clear()

    def enter(self, states: Mapping[str, State], seed: int = 0) -> None:
        """Make a step in which the vehicles depart; `seed` is a parameter of the VUT."""
        self._moved, self._reached_mps = [None, None], {}
        self._commands_speeds = False
        self.in_vain.clear()
        self.sumo.enter(states)
        self.sumo.call("vehicle.setParameter", NAME_OF_VUT, "seed", str(seed))
        self.departed += states

    def position(self, name: str) -> tuple[float, ...]:
        """Return where a vehicle is in the plane; as in SUMO, the VUT is where it was moved to."""
        moved = self._moved[0] if name == NAME_OF_VUT else None
        return moved.point if moved else self.sumo.point(name)[2:4]

    def step(self) -> float | None:
        """Make a step; return the speed that the VUT has reached, or that SUMO gives it."""
        v_mps = self._noting_arrivals(self.sumo.step)
        if v_mps is not None and self._reached_mps:
            # setPreviousSpeed goes before moveToXY: a place does not say how fast it is passed.
            _, v_mps = max(self._reached_mps.items())
            self.sumo.by_sumo = False
            self.sumo.wants_to_merge |= self._moved[1] is not None and self._moved[1].beside
        if self.sumo.was_forced and not self._knows_of_the_lane:
            self._note(STAYED)
        return v_mps

    def put(self, states: Mapping[str, State], *, merged: bool = False) -> None:
        """Put the vehicles into their states after the step; `merged` is of the VUT."""
        self._noting_arrivals(lambda: self.sumo.put(states, merged=merged))
        if self._reached_mps and not self._commands_speeds and NAME_OF_VUT in self.sumo.at_m:
            # As from its departure on, it keeps its speed where nothing is commanded.
            self.sumo.call("vehicle.setSpeed", NAME_OF_VUT, states[NAME_OF_VUT][1])

    def clear(self) -> None:
        """End the episode: all vehicles arrive, and what was subscribed of them ends."""
        self._noting_arrivals(self.sumo.clear)
        self.subscriptions = [
            kept
            for kept in self.subscriptions
            if kept.getter != GET_VEHICLE or kept.object_id not in VEHICLES
        ]

    def _noting_arrivals(self, change: Callable[[], T]) -> T:
        before = list(self.sumo.at_m)
        result = change()
        self.arrived += [name for name in before if name not in self.sumo.at_m]
        return result

    def results(self) -> bytes:
        """Return the answer to a step behind its status: the subscribed values."""
        self._moved, self._reached_mps = [self._moved[1], None], {}
        answers = []
        for subscription in self.subscriptions:
            end_s = math.inf if subscription.end_s == FOR_EVER else subscription.end_s
            if subscription.begin_s <= self.sumo.time_s <= end_s:
                # Of what SUMO cannot tell any more, nothing is sent.
                with suppress(RefusedError):
                    answers.append(self._result(subscription))
        return tp.raw_integer(len(answers)) + b"".join(answers)

    def handle(self, command: Command) -> bytes:
        """Return the answer to any command but a step or a close; raises `ProtocolError`."""
        identifier = command.identifier
        try:
            return tp.status(identifier) + self._answer(identifier, Reader(command.payload))
        except RefusedError as refused:
            return tp.status(identifier, tp.ERROR, str(refused))

    def _answer(self, identifier: int, reader: Reader) -> bytes:
        """Return the answer behind its status."""
        if identifier in QUESTIONS:
            variable, object_id = reader.ubyte(), reader.string()
            value = self._value(identifier, variable, object_id, reader)
            head = bytes((identifier + RESPONSE, variable)) + tp.raw_string(object_id)
            return tp.command(head + value)
        if identifier - SET in QUESTIONS:
            self._set(identifier, reader)
            return b""
        for kind in (SUBSCRIBE, AROUND):
            if identifier - kind in QUESTIONS:
                return self._subscribe(identifier - kind, reader, around=kind == AROUND)
        if identifier == tp.GET_VERSION:
            return tp.version_answer()
        if identifier == tp.SET_ORDER:
            reader.integer()
            return b""
        raise RefusedError(f"merge-sumo does not carry out {name_of(identifier)}")

    def _value(self, getter: int, variable: int, object_id: str, reader: Reader) -> bytes:
        """Return the typed value of a variable; raises `RefusedError` where SUMO has none."""
        own = OWN_ANSWERS.get((getter, variable))
        if own is not None and (getter == GET_SIMULATION or object_id in self.sumo.at_m):
            return own(self, object_id)
        if (getter, variable) not in named():
            raise RefusedError(f"merge-sumo does not answer {name_of(getter, variable)}")
        call = call_of_question(named()[getter, variable], object_id, reader)
        for point in call.on_roads:
            self.sumo.call("simulation.convertRoad", *point)
        return packed(call, self.sumo.call(call.function, *call.arguments))

    def _subscribe(self, getter: int, reader: Reader, *, around: bool) -> bytes:
        """Subscribe to variables of an object, or of those around it; return the first values.

        As in SUMO it adds to one that differs in its variables alone; one without variables ends
        all of the object.
        """
        begin_s, end_s, object_id = reader.double(), reader.double(), reader.string()
        near = (reader.ubyte(), reader.double()) if around else None
        of = near[0] if near else getter
        variables = []
        for _ in range(reader.ubyte()):
            variable = reader.ubyte()
            name = named().get((of, variable), ("",))[-1].partition(".")[2]
            with_parameter = not near and name in WITH_PARAMETER
            variables.append((variable, reader.typed_bytes() if with_parameter else b""))
        wanted = Subscription(getter, object_id, begin_s, end_s, near, tuple(variables))
        if not variables:
            self.subscriptions = [
                kept
                for kept in self.subscriptions
                if replace(kept, begin_s=begin_s, end_s=end_s, variables=()) != wanted
            ]
            return b""
        others = []
        for kept in self.subscriptions:
            if replace(kept, variables=wanted.variables) == wanted:
                both = dict.fromkeys((*kept.variables, *wanted.variables))
                wanted = replace(wanted, variables=tuple(both))
            else:
                others.append(kept)
        answer = self._result(wanted)
        self.subscriptions = [*others, wanted]
        return answer

    def _result(self, subscription: Subscription) -> bytes:
        getter, object_id, near = subscription.getter, subscription.object_id, subscription.around
        if getter == GET_VEHICLE and (object_id or near):
            self._check_vehicle(object_id)
        kind = AROUND if near else SUBSCRIBE
        content = bytes((getter + kind + RESPONSE,)) + tp.raw_string(object_id)
        count = bytes((len(subscription.variables),))
        if near is None:
            return tp.command(content + count + self._values(getter, object_id, subscription))
        of, range_m = near
        found = self._around(getter, object_id, of, range_m)
        content += bytes((of,)) + count + tp.raw_integer(len(found))
        for name in found:
            content += tp.raw_string(name) + self._values(of, name, subscription)
        return tp.command(content)

    def _values(self, getter: int, object_id: str, subscription: Subscription) -> bytes:
        """Return the values of the variables of a subscription for an object of a domain."""
        content = b""
        for variable, parameter in subscription.variables:
            try:
                value, code = self._value(getter, variable, object_id, Reader(parameter)), tp.OK
            except RefusedError as refused:
                value, code = pack("s", refused), tp.ERROR
            content += bytes((variable, code)) + value
        return content

    def _around(self, getter: int, object_id: str, of: int, range_m: float) -> list[str]:
        """Return the objects of a domain that are at most so far away from an object."""
        if getter == GET_VEHICLE:
            point = self.position(object_id)
        elif getter == GET_JUNCTION:
            point = self.sumo.call("junction.getPosition", object_id)
        else:
            raise RefusedError("there are context subscriptions of vehicles and junctions")
        if of != GET_VEHICLE:
            return self.sumo.around(point, of, range_m)
        # SUMO may still have them where they were before they were put back.
        names = sorted(self.sumo.at_m)
        return [name for name in names if math.dist(point, self.position(name)) <= range_m]

    def _set(self, command: int, reader: Reader) -> None:
        """Have a command carried out, or note that it changes nothing, or refuse it."""
        variable, object_id = reader.ubyte(), reader.string()
        functions = named().get((command, variable), ())
        name, effect = name_of(command, variable), commands.effect_of(functions)
        if effect is Effect.REFUSED:
            raise RefusedError(
                f"merge-sumo does not carry out {name}: the scenario and the campaign decide it"
            )
        if command == tp.SET_VEHICLE:
            self._check_vehicle(object_id)
        self._knows_of_the_lane |= "Lane" in name
        if effect is Effect.OWN_KEYS:
            key, *value = reader.arguments() or [""]
            if object_id == NAME_OF_VUT and "." not in str(key):
                self.sumo.call(commands.OWN_KEYS, object_id, key, *value)
                return
            effect = Effect.NOTHING
        if effect is Effect.NOTHING or (effect is Effect.ON_A_LANE and not self.sumo.has_lane):
            self._note(f"{name} is accepted and changes nothing here")
            if commands.is_in_vain(functions):
                self.in_vain.add(name)
            return
        if object_id not in (NAME_OF_VUT, OWN_TYPE):
            raise RefusedError(f"{object_id!r} is not the controller's to command")
        function, arguments, *_ = commands.call_of_command(functions, object_id, reader)
        if effect is Effect.REACHED:
            self._reach(function, [value for value in arguments if isinstance(value, float)])
            return
        self._commands_speeds |= function.partition(".")[2] in commands.SPEEDS
        if function == "vehicle.changeLane":
            self._check_lane(*arguments[:2])
        self.sumo.call(function, *arguments)

    def _reach(self, function: str, numbers: Sequence[float]) -> None:
        """Take the speed, or the place (x, y), that the VUT has at the end of the coming step."""
        if len(numbers) < (2 if function == "vehicle.moveToXY" else 1):
            raise RefusedError(f"{function} was given no number")
        if function == "vehicle.setPreviousSpeed":
            if numbers[0] < 0.0:
                raise RefusedError("Previous speed must not be negative.")
            self._reached_mps[function] = numbers[0]
            return
        paths = [self.sumo.path(NAME_OF_VUT), self.sumo.road.mainline][: 1 + self.sumo.has_lane]
        x, y = numbers[:2]
        away_m, x_m, beside = min((*path.nearest(x, y), i) for i, path in enumerate(paths))
        if not away_m <= OFF_THE_LANE_M:
            raise RefusedError(
                f"{function} takes points up to {OFF_THE_LANE_M} m from the lane of the VUT: "
                f"this one is {away_m:.4g} m away"
            )
        # By eq. (4) the VUT has this speed from the end of the step on, and comes elsewhere.
        before_m = self._moved[0].x_m if self._moved[0] else self.sumo.at_m[NAME_OF_VUT]
        self._moved[1] = _Place(x_m, (x, y), bool(beside))
        self._reached_mps[function] = (x_m - before_m) / DT_S

    def _check_vehicle(self, name: str) -> None:
        if name not in self.sumo.at_m:
            raise RefusedError(f"Vehicle '{name}' is not known.")

    def _check_lane(self, name: str, index: object) -> None:
        """Refuse a lane that the vehicle's edge does not have, as SUMO's server does."""
        road = self.sumo.call("vehicle.getRoadID", name)
        lanes = self.sumo.call("edge.getLaneNumber", road)
        if not (isinstance(index, int) and 0 <= index < lanes):
            raise RefusedError(f"No lane with index '{index}' on road '{road}'.")

    def _note(self, sentence: str) -> None:
        if sentence not in self.notes:
            self.notes.append(sentence)


OWN_ANSWERS: Final[dict[tuple[int, int], Callable[[Session, str], bytes]]] = {
    # SUMO's own answers to these are those before the vehicle was put back.
    (GET_VEHICLE, 0x42): lambda s, name: pack("o", s.position(name)),  # getPosition
    (GET_VEHICLE, 0x39): lambda s, name: pack("O", (*s.position(name), 0.0)),  # in space
    (GET_VEHICLE, 0x43): lambda s, name: pack("d", s.sumo.point(name).angle_deg),
    # Several of SUMO's steps may pass in one of the client's, and an episode may end in it.
    (GET_SIMULATION, 0x73): lambda s, _: pack("i", len(s.departed)),
    (GET_SIMULATION, 0x74): lambda s, _: pack("l", s.departed),
    (GET_SIMULATION, 0x71): lambda s, _: pack("i", len(s.departed)),  # loaded
    (GET_SIMULATION, 0x72): lambda s, _: pack("l", s.departed),
    (GET_SIMULATION, 0x79): lambda s, _: pack("i", len(s.arrived)),
    (GET_SIMULATION, 0x7A): lambda s, _: pack("l", s.arrived),
    (GET_SIMULATION, 0x7D): lambda s, _: pack("i", max(len(s.sumo.at_m), EXPECTED * s.expected)),
}
"""What is answered here and not by SUMO, by the numbers of domain and variable."""
