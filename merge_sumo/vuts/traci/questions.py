"""How a question of a TraCI client is put to SUMO, and how SUMO's answer is packed.

A question carries the numbers of a domain and of a variable; SUMO's own client names the functions
behind them (`traci_names`), and libsumo has the same functions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from operator import attrgetter
from typing import Any, Final, NamedTuple

from merge_sumo.sumo.shadow_sumo import RefusedError
from merge_sumo.vuts.traci.protocol import (
    LON_LAT,
    PLACES,
    ROADMAP,
    ProtocolError,
    Reader,
    compound,
    pack,
    raw_double,
    raw_string,
)


class Call(NamedTuple):
    """A call of libsumo for a client."""

    function: str
    """Named as "vehicle.getSpeed"."""
    arguments: list[Any]
    form: str = ""
    """The letter of `pack` for the answer, where its type in Python does not say it."""
    on_roads: Sequence[Sequence[Any]] = ()
    """What `simulation.convertRoad` must find a road for: where there is none, SUMO ends."""


OF_SHARED_VARIABLES: Final = {
    "trafficlight.getNemaPhaseCalls": "trafficlight.getParameter",
    "vehicle.couldChangeLane": "vehicle.getLaneChangeState",
    "vehicle.getLeftFollowers": "vehicle.getNeighbors",
}
"""Of several functions that read one variable, by the first: the one that SUMO's server calls."""
WITHOUT_OBJECT: Final = (
    *("getIDList", "getIDCount", "getLoadedIDList", "getTeleportingIDList", "getTaxiFleet"),
    "getTaxiReservations",
)
NOT_ANSWERED: Final = {
    *("trafficlight.getConstraints", "trafficlight.getConstraintsByFoe"),
    *("trafficlight.swapConstraints", "person.getWalkingDistance"),
}
"""Questions of trains and of people on foot, which no road of two cars has."""
DRIVING: Final = 1
"""Says of a distance that it is one along roads."""
DISTANCES: Final = ("simulation.getDistance2D", "vehicle.getDrivingDistance")
CONVERSIONS: Final = ("simulation.convert2D",)
"""The first functions of variables whose questions are about places."""


def is_answered(functions: Sequence[str]) -> bool:
    """Return whether SUMO is asked what some functions of its client ask.

    Not of its window: without one, such a question can end SUMO.
    """
    return not functions[0].startswith("gui.") and NOT_ANSWERED.isdisjoint(functions)


def call_of_question(functions: Sequence[str], object_id: str, reader: Reader) -> Call:
    """Return the call that answers what some functions of SUMO's client ask of an object.

    The reader has the parameters of the question. Raises `RefusedError` where none answers it.
    """
    function = OF_SHARED_VARIABLES.get(functions[0], functions[0])
    if not is_answered(functions):
        raise RefusedError(f"merge-sumo does not answer {function}")
    try:
        if function in CONVERSIONS:
            return _of_conversion(reader)
        if function in DISTANCES:
            return _of_distance(function, object_id, reader)
        arguments = reader.arguments()
    except ProtocolError as error:
        raise RefusedError(f"{function} was asked in no form that SUMO has") from error
    domain, _, name = function.partition(".")
    if name in WITHOUT_OBJECT or (domain == "simulation" and not object_id):
        return Call(function, arguments)
    return Call(function, [object_id, *arguments])


def _of_conversion(reader: Reader) -> Call:
    """Return the call that says of a place where it is by other coordinates."""
    more = reader.count() - len(("place", "kind"))
    kind, place = reader.place()
    to = reader.typed()
    letter = dict(enumerate(PLACES)).get(to if isinstance(to, int) else -1, "")
    if letter == "r":
        v_class = [reader.typed() for _ in range(more)]
        function, arguments = "convertRoad", [*place[:2], kind == LON_LAT, *v_class]
    elif kind == ROADMAP and letter:
        function = "convert2D" if letter in "go" else "convert3D"
        arguments = [*place, letter in "gG"]
    elif letter and letter in "go":
        function, arguments = "convertGeo", [*place[:2], PLACES[kind] in "gG"]
    else:
        raise ProtocolError(f"there are no coordinates {to!r}")
    return Call(f"simulation.{function}", arguments, letter)


def _of_distance(function: str, object_id: str, reader: Reader) -> Call:
    """Return the call that measures from a vehicle to a place, or from one place to another."""
    found = [reader.place() for _ in range(reader.count() - 1)]
    kinds = {kind for kind, _ in found}
    on_roads, on_earth = kinds == {ROADMAP}, LON_LAT in kinds
    driving = reader.ubyte() == DRIVING
    arguments = [value for _, place in found for value in place[:2]]
    v_class = "ignoring" if function == DISTANCES[0] else "passenger"
    points = [[*place[:2], on_earth, v_class] for _, place in found]
    if function == DISTANCES[0]:
        if on_roads:
            return Call("simulation.getDistanceRoad", [*arguments, driving])
        return Call(function, [*arguments, on_earth, driving], on_roads=points if driving else ())
    if on_roads:
        lane = [place[2] for _, place in found]
        return Call(function, [object_id, *arguments, *lane])
    return Call(f"{function}2D", [object_id, *arguments], on_roads=points)


def packed(call: Call, answer: Any) -> bytes:
    """Return the typed value of what a call of libsumo gave, as SUMO's own server packs it."""
    name = call.function.partition(".")[2]
    if layout := _LAYOUTS.get(call.function) or _LAYOUTS.get(name):
        return layout(answer)
    if call.form:
        return pack(call.form, answer)
    if not isinstance(answer, tuple):
        return pack("s" if isinstance(answer, str) else "id"[isinstance(answer, float)], answer)
    if all(isinstance(item, str) for item in answer):
        return pack("l", answer)
    if len(answer) == 4 and all(isinstance(item, int) for item in answer):
        return pack("c", answer)
    return pack({2: "o", 3: "O"}.get(len(answer), "f"), answer)


def _fields(form: str, values: Iterable[Any]) -> bytes:
    """Return values as one compound."""
    return compound(len(form), pack(form, *values))


def _rows(form: str, rows: Sequence[Iterable[Any]]) -> bytes:
    """Return rows of values as one compound that begins with their number."""
    content = b"".join(pack(form, *row) for row in rows)
    return compound(1 + len(rows) * len(form), pack("i", len(rows)) + content)


def _rows_of(form: str, names: str) -> Callable[[Sequence[Any]], bytes]:
    """Return what packs objects as rows of their attributes."""
    values = attrgetter(*names.split())
    return lambda answer: _rows(form, list(map(values, answer)))


def _one_vehicle(answer: tuple[str, float] | None) -> bytes:
    return _fields("sd", answer or ("", -1.0))


def _links(answer: Sequence[Sequence[Any]]) -> bytes:
    """Pack links: libsumo has the lane inside of the junction at another place than the wire."""
    return _rows("ssBBBssd", [(link[0], link[4], *link[1:4], *link[5:]) for link in answer])


def _neighbours(answer: Sequence[tuple[str, float]]) -> bytes:
    items = (raw_string(name) + raw_double(gap_m) for name, gap_m in answer)
    return compound(len(answer), b"".join(items))


def _controlled_links(answer: Sequence[Sequence[Sequence[str]]]) -> bytes:
    parts = [pack("i", len(answer))]
    for links in answer:
        parts += [pack("i", len(links)), *(pack("l", link) for link in links)]
    return compound(len(parts), b"".join(parts))


def _programs(answer: Sequence[Any]) -> bytes:
    programs = []
    for program in answer:
        phases = []
        for phase in program.getPhases():
            times = pack("dsdd", phase.duration, phase.state, phase.minDur, phase.maxDur)
            following = _fields("i" * len(phase.next), phase.next)
            phases.append(compound(6, times + following + pack("s", phase.name)))
        head = pack("sii", program.programID, program.type, program.currentPhaseIndex)
        more = [pack("l", pair) for pair in program.subParameter.items()]
        parts = (compound(len(part), b"".join(part)) for part in (phases, more))
        programs.append(compound(5, head + b"".join(parts)))
    return compound(len(programs), b"".join(programs))


def _next_lights(answer: Sequence[tuple[str, int, float, str]]) -> bytes:
    return _rows("sidb", [(*light, ord(state)) for *light, state in answer])


def _stage(stage: Any) -> bytes:
    names = "type vType line destStop edges travelTime cost length intended depart departPos"
    names += " arrivalPos description"
    return _fields("isssldddsddds", attrgetter(*names.split())(stage))


def _stages(answer: Sequence[Any]) -> bytes:
    return compound(len(answer), b"".join(map(_stage, answer)))


_STOP: Final = "lane endPos stoppingPlaceID stopFlags duration until"
_LAYOUTS: Final[dict[str, Callable[[Any], bytes]]] = {
    "vehicle.getLeader": _one_vehicle,
    "vehicle.getFollower": _one_vehicle,
    "vehicle.getNeighbors": _neighbours,
    "vehicle.getLaneChangeState": lambda answer: _fields("ii", answer),
    "vehicle.getBestLanes": lambda answer: _rows("sddbBl", answer),
    "vehicle.getJunctionFoes": lambda answer: _rows("sddddssBB", answer),
    "vehicle.getNextLinks": _links,
    "vehicle.getNextStops": _rows_of("sdsidd", _STOP),
    "vehicle.getNextTLS": _next_lights,
    "vehicle.getStops": _rows_of(
        "sdsiddddddsssssd",
        f"{_STOP} startPos intendedArrival arrival depart split join actType tripId line speed",
    ),
    "simulation.findIntermodalRoute": _stages,
    "simulation.findRoute": _stage,
    "simulation.getCollisions": _rows_of(
        "ssssddssd",
        "collider victim colliderType victimType colliderSpeed victimSpeed type lane pos",
    ),
    "trafficlight.getAllProgramLogics": _programs,
    "trafficlight.getControlledLinks": _controlled_links,
    "lane.getLinks": _links,
    **dict.fromkeys(
        ("lane.getShape", "junction.getShape", "polygon.getShape", "simulation.getNetBoundary"),
        lambda answer: pack("p", answer),
    ),
    "getParameterWithKey": lambda answer: _fields("ss", answer),
}
"""Answers whose layout does not follow from their type in Python, by function or by its name."""
