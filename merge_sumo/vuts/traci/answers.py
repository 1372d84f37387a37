"""How an answer of SUMO's is packed for a TraCI client, as SUMO's own server does it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

from merge_sumo.vuts.traci import protocol as tp


def _fields(kinds: str, values: Sequence[Any]) -> list[bytes]:
    pack: dict[str, Callable[[Any], bytes]] = {
        "s": lambda value: tp.string(str(value)),
        "d": lambda value: tp.double(float(value)),
        "i": lambda value: tp.integer(int(value)),
        "b": lambda value: tp.byte(ord(value) if isinstance(value, str) else int(value)),
        "u": lambda value: tp.ubyte(int(value)),
        "l": tp.strings,
    }
    return [pack[kind](value) for kind, value in zip(kinds, values, strict=True)]


def _items(kinds: str) -> Callable[[Any], bytes]:
    return lambda found: tp.compound_list([_fields(kinds, item) for item in found])


def _links(found: Any) -> bytes:
    """Pack links: libsumo has the lane inside of the junction at another place than the wire."""
    rows = [(link[0], link[4], *link[1:4], *link[5:]) for link in found]
    return _items("ssuuussd")(rows)


def _one_vehicle(found: Any) -> bytes:
    name, gap_m = ("", -1.0) if found is None else found
    return tp.compound(tp.string(name), tp.double(gap_m))


def _neighbours(found: Any) -> bytes:
    items = b"".join(tp.raw_string(name) + tp.raw_double(gap_m) for name, gap_m in found)
    return bytes((tp.TYPE_COMPOUND,)) + tp.raw_integer(len(found)) + items


STOP: Final = (
    *("lane", "endPos", "stoppingPlaceID", "stopFlags", "duration", "until", "startPos"),
    *("intendedArrival", "arrival", "depart", "split", "join", "actType", "tripId", "line"),
    "speed",
)
STAGE: Final = (
    *("type", "vType", "line", "destStop", "edges", "travelTime", "cost", "length", "intended"),
    *("depart", "departPos", "arrivalPos", "description"),
)
COLLISION: Final = (
    *("collider", "victim", "colliderType", "victimType", "colliderSpeed", "victimSpeed"),
    *("type", "lane", "pos"),
)


def _stops(found: Any) -> bytes:
    rows = [[getattr(stop, name) for name in STOP] for stop in found]
    return _items("sdsiddddddsssssd")(rows)


def _next_stops(found: Any) -> bytes:
    rows = [[getattr(stop, name) for name in STOP[:6]] for stop in found]
    return _items("sdsidd")(rows)


def _stage(found: Any) -> bytes:
    return tp.compound(*_fields("isssldddsddds", [getattr(found, name) for name in STAGE]))


def _collisions(found: Any) -> bytes:
    rows = [[getattr(one, name) for name in COLLISION] for one in found]
    return _items("ssssddssd")(rows)


def _controlled_links(found: Any) -> bytes:
    parts = [tp.integer(len(found))]
    for links in found:
        parts += [tp.integer(len(links)), *(tp.strings(link) for link in links)]
    return tp.compound(*parts)


def _logics(found: Any) -> bytes:
    logics = []
    for logic in found:
        phases = [
            tp.compound(
                *_fields("dsdd", (phase.duration, phase.state, phase.minDur, phase.maxDur)),
                tp.compound(*map(tp.integer, phase.next)),
                tp.string(phase.name),
            )
            for phase in logic.phases
        ]
        own = [tp.strings(pair) for pair in logic.subParameter.items()]
        head = _fields("sii", (logic.programID, logic.type, logic.currentPhaseIndex))
        logics.append(tp.compound(*head, tp.compound(*phases), tp.compound(*own)))
    return tp.compound(*logics)


def _pair(kinds: str) -> Callable[[Any], bytes]:
    return lambda found: tp.compound(*_fields(kinds, found))


PACKED: Final[dict[str, Callable[[Any], bytes]]] = {
    "vehicle.getLeader": _one_vehicle,
    "vehicle.getFollower": _one_vehicle,
    "vehicle.getNeighbors": _neighbours,
    "vehicle.getLaneChangeState": _pair("ii"),
    "vehicle.getNextTLS": _items("sidb"),
    "vehicle.getNextStops": _next_stops,
    "vehicle.getStops": _stops,
    "vehicle.getJunctionFoes": _items("sddddssuu"),
    "vehicle.getBestLanes": _items("sddbul"),
    "vehicle.getNextLinks": _links,
    "lane.getLinks": _links,
    "simulation.convertRoad": lambda found: tp.road_position(*found),
    "simulation.getCollisions": _collisions,
    "simulation.findRoute": _stage,
    "person.getStage": _stage,
    "person.getTaxiReservations": lambda _: tp.compound(),
    "trafficlight.getControlledLinks": _controlled_links,
    "trafficlight.getAllProgramLogics": _logics,
}
"""Answers whose layout does not follow from their type in Python."""
OF_POINTS: Final = frozenset({"getShape", "getNetBoundary"})


def packed(function: str, found: Any) -> bytes:
    """Return a typed value: what a function of libsumo gave."""
    special = PACKED.get(function)
    if special is not None:
        return special(found)
    if isinstance(found, tuple):
        return _packed_tuple(function.partition(".")[2], found)
    if isinstance(found, str):
        return tp.string(found)
    return tp.integer(found) if isinstance(found, int) else tp.double(found)


def _packed_tuple(name: str, found: tuple[Any, ...]) -> bytes:
    if name == "getParameterWithKey":
        return _pair("ss")(found)
    if name in OF_POINTS:
        return tp.polygon([(point[0], point[1]) for point in found])
    if all(isinstance(item, str) for item in found):
        return tp.strings(found)
    if len(found) == 4 and all(isinstance(item, int) for item in found):
        return tp.colour(*found)
    return tp.position(*found) if len(found) in (2, 3) else tp.doubles(found)
