"""Questions and commands of a TraCI client, which libsumo's functions of the same names answer."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from contextlib import suppress
from enum import Enum
from functools import cache
from typing import Any, NamedTuple

from merge_sumo.controllers.traci.protocol import (
    API_VERSION,
    ERROR,
    GET_JUNCTION,
    GET_VEHICLE,
    LON_LAT,
    OK,
    PLACES,
    ROAD,
    SET_ORDER,
    SET_VEHICLE,
    VERSION,
    Command,
    Position,
    ProtocolError,
    Reader,
    command,
    packed,
    status,
    string,
)
from merge_sumo.scenario.scenario import DT_S
from merge_sumo.sumo.binding import SUMO_VERSION
from merge_sumo.sumo.mirror import VUT_ID, MirrorSimulation, RefusedError, State
from merge_sumo.sumo.traci_names import functions, name_of, pack

QUESTIONS = frozenset({*range(0x24, 0x2C), *range(0xA0, 0xB0)})
"""Identifiers of questions, one for each domain."""
SET, SUBSCRIBE, CONTEXT, RESPONSE = 0x20, 0x30, -0x20, 0x10
"""Offsets from the questions of a domain to its commands, subscriptions and context subscriptions;
and from questions and subscriptions to their answers."""
SERVED_BY = {
    "trafficlight.getNemaPhaseCalls": "trafficlight.getParameter",
    "vehicle.couldChangeLane": "vehicle.getLaneChangeState",
    "vehicle.getLeftFollowers": "vehicle.getNeighbors",
}
"""Where several functions read one variable: by the first, the one that SUMO's server calls."""
WITH_PARAMETER = ("getLeader", "getFollower", "getParameter", "getParameterWithKey")
"""Functions whose variables have a parameter in a subscription."""
OWN_TYPE = f"{VUT_ID}@{VUT_ID}"
"""SUMO's name of the type of a VUT that has numbers of its own."""
OFF_THE_LANE_M = 2.0
"""A vehicle that its own model moves is on a lane up to this distance: half of a wide lane."""
COMING = 2
"""Number of expected vehicles between two episodes."""


class Effect(Enum):
    """Effect of a command on the simulation."""

    CARRIED_OUT = "Carried out by SUMO, on the VUT and its type"
    ON_A_LANE = "Carried out by SUMO on a road with an acceleration lane, without effect elsewhere"
    REACHED = "Sets the speed or position that the controller's vehicle model reaches in the step"
    OWN_KEYS = "Carried out by SUMO on the VUT, for keys without a dot"
    LOOKS = "Accepted without effect"
    IN_VAIN = "Accepted without effect; in SUMO it has one"
    REFUSED = "Refused, because the scenario or the campaign sets it"


SPEEDS = "setSpeed slowDown setAcceleration setSpeedMode"
MODEL = (
    "setMaxSpeed setAccel setDecel setEmergencyDecel setApparentDecel setTau setMinGap "
    "setImperfection setSpeedFactor"
)
"""Numbers of SUMO's car-following model."""
EFFECTS = {
    Effect.CARRIED_OUT: f"{SPEEDS} {MODEL} openGap setStop resume setLaneChangeMode",
    Effect.ON_A_LANE: "changeLane changeLaneRelative",
    Effect.REACHED: "setPreviousSpeed moveToXY",
    Effect.LOOKS: "setColor setSignals setShapeClass setWidth setHeight setLine highlight "
    "setEmissionClass setBoardingDuration",
    Effect.IN_VAIN: "setMass setLateralAlignment setMaxSpeedLat setMinGapLat changeSublane "
    "setImpatience setSpeedDeviation setRoutingMode setAdaptedTraveltime setEffort setVia "
    "updateBestLanes rerouteTraveltime rerouteEffort setParameter",
}
"""Commands on vehicles and their types by their effect; others are refused."""
ONLY_SEEN = ("gui", "poi", "polygon")
"""Domains of objects that are only drawn."""


@cache
def effect_of(names: tuple[str, ...]) -> Effect:
    """Return the effect of a command.

    Args:
        names: the functions that send it, as "vehicle.setSpeed".
    """
    if "vehicle.setParameter" in names:
        return Effect.OWN_KEYS
    for name in names:
        domain, _, own = name.partition(".")
        for effect, accepted in EFFECTS.items():
            if domain in ("vehicle", "vehicletype") and own in accepted.split():
                return effect
        if domain in ONLY_SEEN or own == "setParameter":
            return Effect.LOOKS
    return Effect.REFUSED


def is_answered(names: tuple[str, ...]) -> bool:
    """Return whether SUMO is asked a question.

    It is not asked about its window, without which it may end, nor what a merge does not need:
    trains, programs of traffic lights, routes to find, and distances between any two positions.

    Args:
        names: the functions that ask it; the first one decides.
    """
    name = names[0] if names else "gui."
    if name.startswith(("gui.", "simulation.find", "simulation.getDistance")):
        return False
    return not any(map(name.__contains__, ("Constraint", "ProgramLogics", "ControlledLinks")))


class NotFiniteError(Exception):
    """A command with a number that is not finite; the text is the command."""


class Subject(NamedTuple):
    """An object, or the objects around it, whose values a client has subscribed to.

    Attributes:
        getter: identifier of the questions of the object's domain.
        name: id of the object.
        domain: identifier of the questions that are answered.
        range_m: largest distance of the objects around it; None for the object itself.
    """

    getter: int
    name: str
    domain: int
    range_m: float | None = None


class _Place(NamedTuple):
    """The place to which a client moves the VUT in a step.

    Attributes:
        v_mps: the speed of the VUT after the step; eq. (4) moves it by the speed before.
        x_m: distance to M along the lane, negative before M.
        point: the place in the plane, (x, y) in m.
        on_mainline: whether its lane is one of the mainline.
    """

    v_mps: float
    x_m: float
    point: tuple[float, float]
    on_mainline: bool


class Session:
    """The simulation as one client sees it; `Server` has its socket and makes its steps.

    Time continues over the episodes: the vehicles depart when an episode begins, and arrive when it
    ends. The answer to a step has the values that the client has subscribed to. They are read again
    after each step, because SUMO's own results are those before the vehicles are put where those of
    the campaign are.

    Attributes:
        sumo: the second SUMO.
        in_vain: commands of this episode that changed nothing and would in SUMO.
        expected: whether more vehicles may come.
        subscriptions: by subject, its variables, each with its parameter as it was sent.
    """

    def __init__(self, sumo: MirrorSimulation) -> None:
        """Begin without subscriptions.

        Args:
            sumo: the second SUMO.
        """
        self.sumo = sumo
        self.subscriptions: dict[Subject, dict[int, bytes]] = {}
        self.in_vain: set[str] = set()
        self.expected = True
        self._next_mps: float | None = None
        """Speed at the end of the next step, as commanded."""
        self._last_place: _Place | None = None
        """Place to which the client moved the VUT in the last step."""
        self._next_place: _Place | None = None
        """Place to which it moves the VUT in the next step."""
        self._commands_speeds = False
        """Whether the client has commanded a speed in this episode."""
        self.answered()

    def answered(self) -> None:
        """Forget the departures and arrivals that the client has read."""
        self.sumo.departed.clear()
        self.sumo.arrived.clear()

    def enter(self, states: Mapping[str, State], seed: int = 0) -> None:
        """Make a step in which the vehicles depart.

        Args:
            states: their states.
            seed: seed of the episode, a parameter of the VUT.
        """
        self._last_place = self._next_place = self._next_mps = None
        self._commands_speeds = False
        self.in_vain.clear()
        self.sumo.enter(states)
        self.sumo.call("vehicle.setParameter", VUT_ID, "seed", str(seed))

    def step(self) -> float | None:
        """Make a step.

        Returns:
            The speed in m/s that the client says the VUT has reached, or else that SUMO gives it;
            None where the VUT is not on the road.
        """
        v_mps, moves, reached_mps = self.sumo.step(), self._next_place, self._next_mps
        if moves is not None and reached_mps is None:
            reached_mps = moves.v_mps
        if v_mps is not None and reached_mps is not None:
            v_mps, self.sumo.by_sumo = reached_mps, False
            self.sumo.requests_merge |= moves is not None and moves.on_mainline
        return v_mps

    def put(self, states: Mapping[str, State], *, merged: bool = False) -> None:
        """Put the vehicles into their states after the step.

        Args:
            states: their states.
            merged: whether the VUT has left the acceleration lane.
        """
        self.sumo.put(states, merged=merged)
        is_moved = self._next_place is not None or self._next_mps is not None
        if is_moved and not self._commands_speeds and VUT_ID in self.sumo.at_m:
            # As from its departure on, it keeps its speed where nothing is commanded.
            self.sumo.call("vehicle.setSpeed", VUT_ID, states[VUT_ID][1])

    def results(self) -> bytes:
        """Return the answer to a step without its status: the subscribed values."""
        self._last_place, self._next_place, self._next_mps = self._next_place, None, None
        answers = []
        for subject, variables in self.subscriptions.items():
            with suppress(RefusedError):  # it is not there
                answers.append(self._result(subject, variables))
        return struct.pack("!i", len(answers)) + b"".join(answers)

    def handle(self, request: Command) -> bytes:
        """Return the answer to any command but a step or a close.

        Args:
            request: the command.

        Raises:
            ProtocolError: if its bytes are not TraCI.
            NotFiniteError: for a command with a number that is not finite.
        """
        identifier, reader = request.identifier, Reader(request.payload)
        try:
            return status(identifier) + self._answer(identifier, reader)
        except RefusedError as refused:
            return status(identifier, ERROR, str(refused))

    def _answer(self, identifier: int, reader: Reader) -> bytes:
        """Return the answer without its status."""
        if identifier in QUESTIONS:
            variable, name = reader.value("B"), reader.value("s")
            value = self._value(identifier, variable, name, reader)
            return command(bytes((identifier + RESPONSE, variable)) + string(name) + value)
        if identifier - SET in QUESTIONS:
            self._command(identifier, reader)
            return b""
        if identifier == VERSION:
            version = string(f"SUMO {SUMO_VERSION}, hosted by merge-sumo")
            return command(struct.pack("!Bi", VERSION, API_VERSION) + version)
        if identifier == SET_ORDER:
            return b""
        is_context = identifier - CONTEXT in QUESTIONS
        domain = getter = identifier - (CONTEXT if is_context else SUBSCRIBE)
        if getter not in QUESTIONS:
            raise RefusedError(f"merge-sumo does not support the command 0x{identifier:02x}")
        reader.raw(16)  # its beginning and its end: it holds until it is ended
        name, range_m = reader.value("s"), None
        if is_context:
            domain, range_m = reader.value("B"), reader.value("d")
        return self._subscribe(Subject(getter, name, domain, range_m), reader)

    # Questions

    def _value(self, getter: int, variable: int, name: str, reader: Reader) -> bytes:
        """Return the typed value of a variable; raises `RefusedError` where SUMO has none."""
        names = functions().get((getter, variable), ())
        if not is_answered(names):
            raise RefusedError(f"merge-sumo does not answer {name_of(getter, variable)}")
        function = SERVED_BY.get(names[0], names[0])
        try:
            own = self._own_answer(function, name)
            if own is not None:
                return packed(function, own)
            if function == "simulation.convert2D":
                return self._conversion(reader)
            if function == "vehicle.getDrivingDistance":
                reader.raw(5)  # type and size of the compound; its last byte has no type
                arguments = self._on_road(reader.typed())
            else:
                arguments = reader.arguments()
            if name and not function.endswith(("getIDList", "getIDCount")):
                arguments = [name, *arguments]
            return packed(function, self.sumo.call(function, *arguments))
        except (ProtocolError, TypeError, ValueError, IndexError, AttributeError) as error:
            raise RefusedError(f"merge-sumo does not answer {function}: {error}") from error

    def _own_answer(self, function: str, name: str) -> Any:
        """Return an answer that SUMO cannot know here; None where it knows."""
        own: dict[str, Any] = {}
        if name in self.sumo.at_m:
            # SUMO's own answers to these are those before the vehicle was put back.
            position = self.position(name)
            own["vehicle.getPosition"] = position
            own["vehicle.getPosition3D"] = *position, 0.0
            own["vehicle.getAngle"] = self.sumo.point(name).angle_deg
        elif function.startswith("simulation."):
            # Several of SUMO's steps may pass in one of the client's, and an episode may end in it.
            expected = max(len(self.sumo.at_m), COMING * self.expected)
            own["simulation.getMinExpectedNumber"] = expected
            departed = self.sumo.departed
            events = {"Loaded": departed, "Departed": departed, "Arrived": self.sumo.arrived}
            for event, names in events.items():
                own[f"simulation.get{event}IDList"] = tuple(names)
                own[f"simulation.get{event}Number"] = len(names)
        return own.get(function)

    def _conversion(self, reader: Reader) -> bytes:
        """Return a position in other coordinates."""
        (kind, place), target, *v_class = reader.typed()
        letter = PLACES[target]
        if target == ROAD:
            function, arguments = "convertRoad", [*place[:2], kind == LON_LAT, *v_class]
        elif kind == ROAD:
            function = "convert2D" if letter.islower() else "convert3D"
            arguments = [*place, letter in "gG"]
        elif letter.islower():
            function, arguments = "convertGeo", [*place[:2], PLACES[kind] in "gG"]
        else:
            raise ProtocolError(f"unknown type of coordinates: {target}")
        return pack(letter, self.sumo.call(f"simulation.{function}", *arguments))

    def _on_road(self, position: Position) -> list[Any]:
        """Return the edge of a position, the position along it in m, and the lane."""
        kind, place = position
        if kind == ROAD:
            return place
        is_geo = kind == LON_LAT
        return list(self.sumo.call("simulation.convertRoad", *place[:2], is_geo, "passenger"))

    def position(self, name: str) -> tuple[float, ...]:
        """Return the position of a vehicle in the plane, (x, y) in m.

        As in SUMO, a VUT that the client has moved is at that place.

        Args:
            name: the vehicle.
        """
        if name == VUT_ID and self._last_place is not None:
            return self._last_place.point
        return self.sumo.point(name)[2:4]

    # Subscriptions

    def _subscribe(self, subject: Subject, reader: Reader) -> bytes:
        """Add to the subscriptions of a subject; return the first values.

        A subscription without variables ends those of the subject.
        """
        variables = dict(self.subscriptions.get(subject, {}))
        count = reader.value("B")
        for _ in range(count):
            variable = reader.value("B")
            name = functions().get((subject.domain, variable), ("",))[-1].partition(".")[2]
            takes_parameter = subject.range_m is None and name in WITH_PARAMETER
            variables[variable] = reader.typed_bytes() if takes_parameter else b""
        if not count:
            self.subscriptions.pop(subject, None)
            return b""
        answer = self._result(subject, variables)
        self.subscriptions[subject] = variables
        return answer

    def _result(self, subject: Subject, variables: Mapping[int, bytes]) -> bytes:
        getter, name, domain, range_m = subject
        if getter == GET_VEHICLE and (name or range_m is not None):
            self._check_vehicle(name)
        count = bytes((len(variables),))
        if range_m is None:
            head = bytes((getter + SUBSCRIBE + RESPONSE,)) + string(name) + count
            return command(head + self._values(domain, name, variables))
        found = self._around(subject, range_m)
        content = bytes((getter + CONTEXT + RESPONSE,)) + string(name) + bytes((domain,)) + count
        content += struct.pack("!i", len(found))
        for other in found:
            content += string(other) + self._values(domain, other, variables)
        return command(content)

    def _values(self, getter: int, name: str, variables: Mapping[int, bytes]) -> bytes:
        content = b""
        for variable, parameter in variables.items():
            try:
                value, result = self._value(getter, variable, name, Reader(parameter)), OK
            except RefusedError as refused:
                value, result = pack("s", refused), ERROR
            content += bytes((variable, result)) + value
        return content

    def _around(self, subject: Subject, range_m: float) -> list[str]:
        """Return the vehicles that are at most `range_m` away from an object."""
        if subject.domain != GET_VEHICLE:
            raise RefusedError("merge-sumo supports context subscriptions to vehicles only")
        if subject.getter == GET_VEHICLE:
            point = self.position(subject.name)
        elif subject.getter == GET_JUNCTION:
            point = self.sumo.call("junction.getPosition", subject.name)
        else:
            raise RefusedError(
                "merge-sumo supports context subscriptions of vehicles and junctions"
            )
        # SUMO may still have them where they were before they were put back.
        found = []
        for other in sorted(self.sumo.at_m):
            if math.dist(point, self.position(other)) <= range_m:
                found.append(other)
        return found

    # Commands

    def _command(self, setter: int, reader: Reader) -> None:
        """Have a command carried out, or note that it changes nothing, or refuse it."""
        variable, target = reader.value("B"), reader.value("s")
        names = functions().get((setter, variable), ())
        name, effect = name_of(setter, variable), effect_of(names)
        if effect is Effect.REFUSED:
            raise RefusedError(f"merge-sumo refuses {name}: the scenario and the campaign set it")
        if setter == SET_VEHICLE:
            self._check_vehicle(target)
        arguments = reader.arguments()
        is_in_vain = effect is Effect.IN_VAIN
        if effect is Effect.ON_A_LANE:
            is_in_vain = not self.sumo.has_lane
        elif effect is Effect.OWN_KEYS:  # keys with a dot are of devices and models
            is_in_vain = target != VUT_ID or "." in str(arguments[:1])
        if is_in_vain:
            self.in_vain.add(name)
        if is_in_vain or effect is Effect.LOOKS:
            return
        if target not in (VUT_ID, OWN_TYPE):
            raise RefusedError(f"the controller may not command {target!r}")
        function = names[-1]
        numbers = [value for value in arguments if isinstance(value, float)]
        self._check_numbers(function, numbers)
        if effect is Effect.REACHED:
            self._reach(function, numbers)
            return
        self._commands_speeds |= function.partition(".")[2] in SPEEDS.split()
        if function == "vehicle.changeLaneRelative":
            lane, duration_s, *relative = arguments
            arguments = [lane, duration_s]
            if not relative:  # a third value marks an offset
                function = "vehicle.changeLane"
        elif function == "vehicle.openGap" and arguments[:2] == [-1.0, -1.0]:
            function, arguments = "vehicle.deactivateGapControl", []
        self.sumo.call(function, target, *arguments)

    def _check_numbers(self, function: str, numbers: Sequence[float]) -> None:
        """Check the numbers of a command on the VUT or its type.

        Raises:
            RefusedError: for a value that SUMO's models cannot have.
            NotFiniteError: for a number that is not finite: the VUT would drive on as if nothing
                was commanded.
        """
        name = function.partition(".")[2]
        for number in numbers:
            if not math.isfinite(number):
                shown = ", ".join(map("{:g}".format, numbers))
                raise NotFiniteError(f"{function}({shown})")
            is_valid = number >= 0.0 and (name, number) != ("setMaxSpeed", 0.0)
            if name in MODEL.split() and not is_valid:
                raise RefusedError(f"Invalid value {number:g} of {function}.")

    def _reach(self, function: str, numbers: Sequence[float]) -> None:
        """Take the speed, or the place (x, y), that the VUT has at the end of the coming step."""
        if len(numbers) < (2 if function == "vehicle.moveToXY" else 1):
            raise RefusedError(f"{function} needs a number")
        if function == "vehicle.setPreviousSpeed":
            if numbers[0] < 0.0:
                raise RefusedError("Previous speed must not be negative.")
            self._next_mps = numbers[0]
            return
        paths = [self.sumo.path(VUT_ID), self.sumo.road.mainline][: 1 + self.sumo.has_lane]
        x, y = numbers[:2]
        found = []
        for number, path in enumerate(paths):
            found.append((*path.nearest(x, y), number))
        away_m, x_m, number = min(found)
        if not away_m <= OFF_THE_LANE_M:
            raise RefusedError(
                f"{function} takes points up to {OFF_THE_LANE_M} m from the lane of the VUT: this "
                f"point is {away_m:.4g} m away"
            )
        before_m = self._last_place.x_m if self._last_place else self.sumo.at_m[VUT_ID]
        self._next_place = _Place((x_m - before_m) / DT_S, x_m, (x, y), number > 0)

    def _check_vehicle(self, name: str) -> None:
        if name not in self.sumo.at_m:
            raise RefusedError(f"Vehicle '{name}' is not known.")
