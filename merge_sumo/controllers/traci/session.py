"""Questions and commands of a TraCI client: libsumo's functions of the same names answer.

The session has no socket and does not decide when a step is made. Time runs on over the episodes:
in each the vehicles depart, and when it ends they arrive. A client gets the values of its
subscriptions with the answer to every step. SUMO's own results are those before the vehicles are
put where those of the campaign are, so every value is read again.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from contextlib import suppress
from enum import Enum
from functools import cache
from typing import Any, NamedTuple

from merge_sumo.controllers.traci.protocol import (
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
    ProtocolError,
    Reader,
    command,
    pack,
    packed,
    status,
    string,
    version_answer,
)
from merge_sumo.scenario.scenario import DT_S, VEHICLES
from merge_sumo.sumo.mirror import VUT_ID, MirrorSimulation, RefusedError, State
from merge_sumo.sumo.traci_names import functions, name_of

QUESTIONS = frozenset({*range(0x24, 0x2C), *range(0xA0, 0xB0)})
"""Identifiers of questions, one for each domain."""
SET, SUBSCRIBE, CONTEXT, RESPONSE = 0x20, 0x30, -0x20, 0x10
"""Offsets from the questions of a domain to its commands, subscriptions and context subscriptions,
and from questions and subscriptions to their answers."""
SERVED_BY = {
    "trafficlight.getNemaPhaseCalls": "trafficlight.getParameter",
    "vehicle.couldChangeLane": "vehicle.getLaneChangeState",
    "vehicle.getLeftFollowers": "vehicle.getNeighbors",
}
"""Of several functions that read one variable, by the first: the one that SUMO's server calls."""
DISTANCES = ("simulation.getDistance2D", "vehicle.getDrivingDistance")
WITH_PARAMETER = ("getLeader", "getFollower", "getParameter", "getParameterWithKey")
"""Functions whose variables have a parameter in a subscription."""
OWN_TYPE = f"{VUT_ID}@{VUT_ID}"
"""What SUMO calls the type of a vehicle that has numbers of its own."""
STAYED = (
    "vut came to the end of the acceleration lane without a lane change: it departs in lane change "
    "mode 0, in which changeLane merges it at once; in 1621, SUMO's own, SUMO merges it"
)
OFF_THE_LANE_M = 2.0
"""A vehicle that its own model moves is on a lane up to here: half of the width of a wide one."""
COMING = 2
"""Vehicles that are expected between two episodes."""


class Effect(Enum):
    """Effect of a command on the simulation."""

    CARRIED_OUT = "Carried out by SUMO, on the VUT and its type"
    ON_A_LANE = "Carried out by SUMO on a road with an acceleration lane; elsewhere changes nothing"
    REACHED = "Taken as what a vehicle model of the controller's own reaches in the step"
    OWN_KEYS = "Carried out by SUMO on the VUT, for keys without a dot"
    LOOKS = "Accepted, changes nothing"
    IN_VAIN = "Accepted, changes nothing here but would in SUMO"
    REFUSED = "Refused: the scenario and the campaign decide it"


SPEEDS = "setSpeed slowDown setAcceleration setSpeedMode"
MODEL = (
    "setMaxSpeed setAccel setDecel setEmergencyDecel setApparentDecel setTau setMinGap "
    "setImperfection setSpeedFactor"
)
"""Numbers of SUMO's car-following model."""
REACHED = "setPreviousSpeed moveToXY"
EFFECTS = {
    Effect.CARRIED_OUT: f"{SPEEDS} {MODEL} openGap setStop resume setLaneChangeMode",
    Effect.ON_A_LANE: "changeLane changeLaneRelative",
    Effect.REACHED: REACHED,
    Effect.LOOKS: "setColor setSignals setShapeClass setWidth setHeight setLine highlight "
    "setEmissionClass setBoardingDuration",
    Effect.IN_VAIN: "setMass setLateralAlignment setMaxSpeedLat setMinGapLat changeSublane "
    "setImpatience setSpeedDeviation setRoutingMode setAdaptedTraveltime setEffort setVia "
    "updateBestLanes rerouteTraveltime rerouteEffort setParameter",
}
"""Commands on vehicles and their types by their effect; others are refused."""
ONLY_SEEN = ("gui", "poi", "polygon")
"""Domains of objects that are only looked at."""


@cache
def effect_of(names: tuple[str, ...]) -> Effect:
    """Return the effect of the commands that share a number."""
    domain = names[0].partition(".")[0] if names else ""
    own = {name.partition(".")[2] for name in names}
    if "vehicle.setParameter" in names:
        return Effect.OWN_KEYS
    if domain in ("vehicle", "vehicletype"):
        for effect, accepted in EFFECTS.items():
            if not own.isdisjoint(accepted.split()):
                return effect
    elif domain in ONLY_SEEN or "setParameter" in own:
        return Effect.LOOKS
    return Effect.REFUSED


def is_answered(names: tuple[str, ...]) -> bool:
    """Return whether SUMO is asked the question that has these names.

    Not of its window, without which SUMO may end, and not of trains, of programs of traffic lights
    and of routes to find, which a merge does not need.
    """
    name = names[0] if names else "gui."
    return not name.startswith(("gui.", "simulation.find")) and not any(
        part in name for part in ("Constraint", "ProgramLogics", "ControlledLinks")
    )


class NotFiniteError(Exception):
    """A command with a number that is not finite; the text is the command."""


class Subject(NamedTuple):
    """An object of a domain whose values, or the objects around it, are subscribed to.

    Attributes:
        getter: identifier of the questions of its domain.
        name: its id.
        around: identifier of the questions of the objects around it, and their largest distance in
            m; None where its own values are subscribed to.
    """

    getter: int
    name: str
    around: tuple[int, float] | None = None


class _Place(NamedTuple):
    """Where a client moves the VUT to: along its lanes, in the plane, on the mainline or not."""

    x_m: float
    point: tuple[float, float]
    on_mainline: bool


class Session:
    """The simulation as one client sees it.

    Attributes:
        notes: sentences on commands that do less than in SUMO, once each.
        in_vain: commands of this episode that change nothing here, and would in SUMO.
        expected: whether more vehicles may come.
        subscriptions: variables, each with its parameter as it was sent.
    """

    def __init__(self, sumo: MirrorSimulation) -> None:
        self.sumo = sumo
        self.subscriptions: dict[Subject, dict[int, bytes]] = {}
        self.notes: list[str] = []
        self.in_vain: set[str] = set()
        self.expected = True
        self._reached_mps: dict[str, float] = {}
        """Speeds at the end of the coming step, by the commands that gave them."""
        self._moved: _Place | None = None
        """Where the client moved the VUT to in the last step."""
        self._moves: _Place | None = None
        """Where it moves it to in the coming one."""
        self._commands_speeds = False  # in this episode
        self._knows_of_the_lane = False  # it has commanded anything of lanes
        self.answered()

    def answered(self) -> None:
        """Forget the departures and arrivals that the client has read."""
        self.sumo.departed.clear()
        self.sumo.arrived.clear()

    def enter(self, states: Mapping[str, State], seed: int = 0) -> None:
        """Make a step in which the vehicles depart; `seed` is a parameter of the VUT."""
        self._moved, self._moves, self._reached_mps = None, None, {}
        self._commands_speeds = False
        self.in_vain.clear()
        self.sumo.enter(states)
        self.sumo.call("vehicle.setParameter", VUT_ID, "seed", str(seed))

    def step(self) -> float | None:
        """Make a step; return the speed that the VUT has reached, or that SUMO gives it."""
        v_mps = self.sumo.step()
        if v_mps is not None and self._reached_mps:
            # setPreviousSpeed goes before moveToXY: a place does not say how fast it is passed.
            _, v_mps = max(self._reached_mps.items())
            self.sumo.by_sumo = False
            self.sumo.wants_to_merge |= self._moves is not None and self._moves.on_mainline
        if self.sumo.was_forced and not self._knows_of_the_lane:
            self._note(STAYED)
        return v_mps

    def put(self, states: Mapping[str, State], *, merged: bool = False) -> None:
        """Put the vehicles into their states after the step; `merged` is of the VUT."""
        self.sumo.put(states, merged=merged)
        if self._reached_mps and not self._commands_speeds and VUT_ID in self.sumo.at_m:
            # As from its departure on, it keeps its speed where nothing is commanded.
            self.sumo.call("vehicle.setSpeed", VUT_ID, states[VUT_ID][1])

    def clear(self) -> None:
        """End the episode: all vehicles arrive, and subscriptions to them end."""
        self.sumo.clear()
        for subject in list(self.subscriptions):
            if subject.getter == GET_VEHICLE and subject.name in VEHICLES:
                del self.subscriptions[subject]

    def results(self) -> bytes:
        """Return the answer to a step without its status: the subscribed values."""
        self._moved, self._moves, self._reached_mps = self._moves, None, {}
        answers = []
        for subject, variables in self.subscriptions.items():
            with suppress(RefusedError):  # SUMO has it no more
                answers.append(self._result(subject, variables))
        return struct.pack("!i", len(answers)) + b"".join(answers)

    def handle(self, request: Command) -> bytes:
        """Return the answer to any command but a step or a close; raises `ProtocolError`."""
        identifier, reader = request.identifier, Reader(request.payload)
        try:
            return status(identifier) + self._answer(identifier, reader)
        except RefusedError as refused:
            return status(identifier, ERROR, str(refused))

    def _answer(self, identifier: int, reader: Reader) -> bytes:
        """Return the answer without its status."""
        if identifier in QUESTIONS:
            variable, name = reader.number("B"), reader.string()
            value = self._value(identifier, variable, name, reader)
            return command(bytes((identifier + RESPONSE, variable)) + string(name) + value)
        if identifier - SET in QUESTIONS:
            self._command(identifier, reader)
            return b""
        if identifier - SUBSCRIBE in QUESTIONS:
            return self._subscribe(Subject(identifier - SUBSCRIBE, _subscribed(reader)), reader)
        if identifier - CONTEXT in QUESTIONS:
            name, around = _subscribed(reader), (reader.number("B"), reader.number("d"))
            return self._subscribe(Subject(identifier - CONTEXT, name, around), reader)
        if identifier == VERSION:
            return version_answer()
        if identifier == SET_ORDER:
            return b""
        raise RefusedError(f"merge-sumo does not carry out {name_of(identifier)}")

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
            if function in DISTANCES:
                function, arguments = self._distance(function, name, reader)
            else:
                of_all = not name or function.endswith(("getIDList", "getIDCount"))
                arguments = [*([] if of_all else [name]), *reader.arguments()]
            return packed(function, self.sumo.call(function, *arguments))
        except (ProtocolError, TypeError, ValueError, IndexError, AttributeError) as error:
            raise RefusedError(f"merge-sumo does not answer {function}: {error}") from error

    def _own_answer(self, function: str, name: str) -> Any:
        """Return an answer that SUMO cannot know here; None where it knows."""
        if name in self.sumo.at_m:
            # SUMO's own answers to these are those before the vehicle was put back.
            if function == "vehicle.getPosition":
                return self.position(name)
            if function == "vehicle.getPosition3D":
                return (*self.position(name), 0.0)
            if function == "vehicle.getAngle":
                return self.sumo.point(name).angle_deg
        # Several of SUMO's steps may pass in one of the client's, and an episode may end in it.
        if function == "simulation.getMinExpectedNumber":
            return max(len(self.sumo.at_m), COMING * self.expected)
        departed, arrived = tuple(self.sumo.departed), tuple(self.sumo.arrived)
        for event, names in {"Loaded": departed, "Departed": departed, "Arrived": arrived}.items():
            if function in (f"simulation.get{event}IDList", f"simulation.get{event}Number"):
                return names if function.endswith("List") else len(names)
        return None

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
            raise ProtocolError(f"there are no coordinates {target}")
        return pack(letter, self.sumo.call(f"simulation.{function}", *arguments))

    def _distance(self, function: str, name: str, reader: Reader) -> tuple[str, list[Any]]:
        """Return the function for a distance to a position, and its arguments."""
        ends = [reader.typed() for _ in range(reader.count() - 1)]
        driving = bool(reader.number("B"))
        points = [value for end in ends for value in end.place[:2]]
        on_earth = any(end.kind == LON_LAT for end in ends)
        if all(end.kind == ROAD for end in ends):
            if not name:
                return "simulation.getDistanceRoad", [*points, driving]
            return function, [name, *points, *(end.place[2] for end in ends)]
        if driving or name:
            for end in ends:  # where there is no road, SUMO would end
                v_class = "passenger" if name else "ignoring"
                self.sumo.call("simulation.convertRoad", *end.place[:2], on_earth, v_class)
        if name:
            return f"{function}2D", [name, *points]
        return function, [*points, on_earth, driving]

    def position(self, name: str) -> tuple[float, ...]:
        """Return where a vehicle is in the plane; as in SUMO, the VUT is where it was moved to."""
        if name == VUT_ID and self._moved is not None:
            return self._moved.point
        return self.sumo.point(name)[2:4]

    # Subscriptions

    def _subscribe(self, subject: Subject, reader: Reader) -> bytes:
        """Add to the subscriptions of a subject; return the first values.

        A subscription without variables ends those of the subject.
        """
        of = subject.around[0] if subject.around else subject.getter
        variables = dict(self.subscriptions.get(subject, {}))
        count = reader.number("B")
        for _ in range(count):
            variable = reader.number("B")
            name = functions().get((of, variable), ("",))[-1].partition(".")[2]
            takes_parameter = subject.around is None and name in WITH_PARAMETER
            variables[variable] = reader.typed_bytes() if takes_parameter else b""
        if not count:
            self.subscriptions.pop(subject, None)
            return b""
        answer = self._result(subject, variables)
        self.subscriptions[subject] = variables
        return answer

    def _result(self, subject: Subject, variables: Mapping[int, bytes]) -> bytes:
        getter, name, around = subject
        if getter == GET_VEHICLE and (name or around):
            self._check_vehicle(name)
        count = bytes((len(variables),))
        if around is None:
            head = bytes((getter + SUBSCRIBE + RESPONSE,)) + string(name) + count
            return command(head + self._values(getter, name, variables))
        of, range_m = around
        found = self._around(getter, name, of, range_m)
        content = bytes((getter + CONTEXT + RESPONSE,)) + string(name) + bytes((of,)) + count
        content += struct.pack("!i", len(found))
        for other in found:
            content += string(other) + self._values(of, other, variables)
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

    def _around(self, getter: int, name: str, of: int, range_m: float) -> list[str]:
        """Return the objects of a domain that are at most `range_m` away from an object."""
        if getter == GET_VEHICLE:
            point = self.position(name)
        elif getter == GET_JUNCTION:
            point = self.sumo.call("junction.getPosition", name)
        else:
            raise RefusedError("there are context subscriptions of vehicles and junctions")
        if of != GET_VEHICLE:
            return self.sumo.around(point, of, range_m)
        # SUMO may still have them where they were before they were put back.
        names = sorted(self.sumo.at_m)
        return [other for other in names if math.dist(point, self.position(other)) <= range_m]

    # Commands

    def _command(self, setter: int, reader: Reader) -> None:
        """Have a command carried out, or note that it changes nothing, or refuse it."""
        variable, target = reader.number("B"), reader.string()
        names = functions().get((setter, variable), ())
        name, effect = name_of(setter, variable), effect_of(names)
        if effect is Effect.REFUSED:
            raise RefusedError(
                f"merge-sumo does not carry out {name}: the scenario and the campaign decide it"
            )
        if setter == SET_VEHICLE:
            self._check_vehicle(target)
        self._knows_of_the_lane |= "Lane" in name
        if effect is Effect.OWN_KEYS:
            key, *value = reader.arguments() or [""]
            if target == VUT_ID and "." not in str(key):  # such keys are of devices and models
                self.sumo.call("vehicle.setParameter", target, key, *value)
                return
            effect = Effect.IN_VAIN
        if effect is Effect.ON_A_LANE and not self.sumo.has_lane:
            effect = Effect.IN_VAIN
        if effect in (Effect.LOOKS, Effect.IN_VAIN):
            self._note(f"{name} is accepted and changes nothing here")
            if effect is Effect.IN_VAIN:
                self.in_vain.add(name)
            return
        if target not in (VUT_ID, OWN_TYPE):
            raise RefusedError(f"{target!r} is not the controller's to command")
        self._drive(names[-1], target, reader.arguments())

    def _drive(self, function: str, target: str, arguments: list[Any]) -> None:
        """Carry out a command on the VUT or its type.

        Raises:
            RefusedError: for a value that SUMO's models cannot have.
            NotFiniteError: for another number that is not finite: the VUT would drive on as if
                nothing was commanded.
        """
        name = function.partition(".")[2]
        numbers = [value for value in arguments if isinstance(value, float)]
        for number in numbers if name in MODEL.split() else ():
            if not 0.0 <= number < math.inf or (name, number) == ("setMaxSpeed", 0.0):
                raise RefusedError(f"Invalid value {number:g} of {function}.")
        if not all(map(math.isfinite, numbers)):
            raise NotFiniteError(f"{function}({', '.join(f'{n:g}' for n in numbers)})")
        if name in REACHED.split():
            self._reach(function, numbers)
            return
        self._commands_speeds |= name in SPEEDS.split()
        if function == "vehicle.changeLaneRelative":
            lane, duration_s, *relative = arguments
            arguments = [lane, duration_s]
            if not relative:  # a third value marks an offset
                function = "vehicle.changeLane"
                self._check_lane(target, lane)
        elif function == "vehicle.openGap" and arguments[:2] == [-1.0, -1.0]:
            function, arguments = "vehicle.deactivateGapControl", []
        self.sumo.call(function, target, *arguments)

    def _reach(self, function: str, numbers: Sequence[float]) -> None:
        """Take the speed, or the place (x, y), that the VUT has at the end of the coming step."""
        if len(numbers) < (2 if function == "vehicle.moveToXY" else 1):
            raise RefusedError(f"{function} was given no number")
        if function == "vehicle.setPreviousSpeed":
            if numbers[0] < 0.0:
                raise RefusedError("Previous speed must not be negative.")
            self._reached_mps[function] = numbers[0]
            return
        paths = [self.sumo.path(VUT_ID), self.sumo.road.mainline][: 1 + self.sumo.has_lane]
        x, y = numbers[:2]
        away_m, x_m, number = min((*path.nearest(x, y), i) for i, path in enumerate(paths))
        if not away_m <= OFF_THE_LANE_M:
            raise RefusedError(
                f"{function} takes points up to {OFF_THE_LANE_M} m from the lane of the VUT: "
                f"this one is {away_m:.4g} m away"
            )
        # By eq. (4) the VUT has this speed from the end of the step on, and comes elsewhere.
        before_m = self._moved.x_m if self._moved else self.sumo.at_m[VUT_ID]
        self._moves = _Place(x_m, (x, y), number > 0)
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


def _subscribed(reader: Reader) -> str:
    """Return the id of the object of a subscription, which holds from now on until it is ended."""
    reader.raw(16)  # its begin and its end
    return reader.string()
