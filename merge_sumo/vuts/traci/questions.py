"""How a question of a TraCI client is put to SUMO, and how SUMO's answer is packed.

A question carries the numbers of a domain and of a variable; SUMO's own client names the functions
behind them (`traci_names`), and libsumo has the same functions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from operator import attrgetter
from typing import Any, Final

from merge_sumo.sumo.shadow_sumo import RefusedError
from merge_sumo.vuts.traci import protocol as tp
from merge_sumo.vuts.traci.protocol import ProtocolError, Reader, compound, pack

Call = tuple[str, list[Any]]
"""A function of libsumo, named as "vehicle.getSpeed", and its arguments."""

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
    *("trafficlight.swapConstraints", "trafficlight.getAllProgramLogics"),
    *("trafficlight.getControlledLinks", "simulation.findIntermodalRoute", "simulation.findRoute"),
    *("person.getRemainingStages", "person.getStage", "person.getTaxiReservations"),
}
"""Their answers have a layout that no car needs."""
COMPOUND_HEAD_BYTES: Final = 5
"""Its type, and how many values it has."""
GEO: Final = (tp.POSITION_LON_LAT, tp.POSITION_LON_LAT_ALT)
DRIVING: Final = 1
"""A distance by road, as a question for one says; 0 is the one through the air."""


def call_of_question(functions: Sequence[str], object_id: str, reader: Reader) -> Call:
    """Return the call that answers what some functions of SUMO's client ask of an object.

    The reader has the parameters of the question. Raises `RefusedError` where none answers it.
    """
    function = OF_SHARED_VARIABLES.get(functions[0], functions[0])
    domain, _, name = function.partition(".")
    if domain == "gui":  # without a window libsumo's answer is the end of the process
        raise RefusedError("GUI is not running, command not implemented in command line sumo")
    if function in NOT_ANSWERED:
        raise RefusedError(f"merge-sumo does not answer {function}: no car needs it")
    try:
        if function in _SPECIAL:
            return _SPECIAL[function](object_id, reader)
        arguments = reader.arguments()
    except (ProtocolError, ValueError, IndexError) as error:
        raise RefusedError(f"{function} was asked in no form that SUMO has") from error
    if name in WITHOUT_OBJECT or (domain == "simulation" and not object_id):
        return function, arguments
    return function, [object_id, *arguments]


def _distance_of_vehicle(object_id: str, reader: Reader) -> Call:
    reader.raw(COMPOUND_HEAD_BYTES)
    kind, place = reader.place()
    on_road = kind == tp.POSITION_ROADMAP
    return f"vehicle.getDrivingDistance{'' if on_road else '2D'}", [object_id, *place]


def _distance(_: str, reader: Reader) -> Call:
    reader.raw(COMPOUND_HEAD_BYTES)
    kind, start = reader.place()
    end = reader.place()[1]
    driving = reader.ubyte() == DRIVING
    if kind == tp.POSITION_ROADMAP:
        return "simulation.getDistanceRoad", [*start[:2], *end[:2], driving]
    return "simulation.getDistance2D", [*start[:2], *end[:2], kind in GEO, driving]


def _converted(_: str, reader: Reader) -> Call:
    reader.raw(COMPOUND_HEAD_BYTES)
    kind, place = reader.place()
    target, *vclass = reader.arguments()
    if kind == tp.POSITION_ROADMAP:
        flat = target in (tp.POSITION_2D, tp.POSITION_LON_LAT)
        return f"simulation.convert{'2D' if flat else '3D'}", [*place, target in GEO]
    if target == tp.POSITION_ROADMAP:
        return "simulation.convertRoad", [*place[:2], kind in GEO, *vclass]
    return "simulation.convertGeo", [*place[:2], kind in GEO]


def _foes(object_id: str, reader: Reader) -> Call:
    (to_lane,) = reader.arguments()
    if to_lane:
        return "lane.getFoes", [object_id, to_lane]
    return "lane.getInternalFoes", [object_id]


_SPECIAL: Final[dict[str, Callable[[str, Reader], Call]]] = {
    "vehicle.getDrivingDistance": _distance_of_vehicle,
    "simulation.getDistance2D": _distance,
    "simulation.convert2D": _converted,
    "lane.getFoes": _foes,
}
"""Questions whose parameters are not the function's arguments in their order."""


def packed(function: str, answer: Any) -> bytes:
    """Return the typed value of what a function of libsumo gave, as SUMO's own server packs it."""
    if function in _LAYOUTS:
        return _LAYOUTS[function](answer)
    if isinstance(answer, tuple):
        return _packed_tuple(function.partition(".")[2], answer)
    if isinstance(answer, str):
        return pack("s", answer)
    return pack("i" if isinstance(answer, int) else "d", answer)


def _packed_tuple(name: str, answer: tuple[Any, ...]) -> bytes:
    if name == "getParameterWithKey":
        return _fields("ss")(answer)
    if name in ("getShape", "getNetBoundary"):
        return pack("p", answer)
    if all(isinstance(item, str) for item in answer):
        return pack("l", answer)
    if len(answer) == 4 and all(isinstance(item, int) for item in answer):
        return pack("c", answer)
    return pack({2: "o", 3: "O"}.get(len(answer), "f"), answer)


def _fields(form: str) -> Callable[[Iterable[Any]], bytes]:
    """Return what packs values as one compound."""
    return lambda values: compound(len(form), pack(form, *values))


def _rows(form: str) -> Callable[[Sequence[Iterable[Any]]], bytes]:
    """Return what packs rows of values as one compound that begins with their number."""

    def packed_rows(rows: Sequence[Iterable[Any]]) -> bytes:
        content = b"".join(pack(form, *row) for row in rows)
        return compound(1 + len(rows) * len(form), pack("i", len(rows)) + content)

    return packed_rows


def _objects(form: str, *names: str) -> Callable[[Sequence[Any]], bytes]:
    """Return what packs objects with such attributes as rows."""
    return lambda objects: _rows(form)([attrgetter(*names)(thing) for thing in objects])


def _one_vehicle(answer: tuple[str, float] | None) -> bytes:
    return _fields("sd")(answer or ("", -1.0))


def _links(answer: Sequence[Sequence[Any]]) -> bytes:
    """Pack links: libsumo has the lane inside of the junction at another place than the wire."""
    return _rows("ssBBBssd")([(link[0], link[4], *link[1:4], *link[5:]) for link in answer])


def _neighbours(answer: Sequence[tuple[str, float]]) -> bytes:
    items = (tp.raw_string(name) + tp.raw_double(gap_m) for name, gap_m in answer)
    return compound(len(answer), b"".join(items))


_NEXT_STOP: Final = ("lane", "endPos", "stoppingPlaceID", "stopFlags", "duration", "until")
_STOP: Final = (
    *(*_NEXT_STOP, "startPos", "intendedArrival", "arrival", "depart", "split", "join", "actType"),
    *("tripId", "line", "speed"),
)
_COLLISION: Final = (
    *("collider", "victim", "colliderType", "victimType", "colliderSpeed", "victimSpeed"),
    *("type", "lane", "pos"),
)
_LAYOUTS: Final[dict[str, Callable[[Any], bytes]]] = {
    "vehicle.getLeader": _one_vehicle,
    "vehicle.getFollower": _one_vehicle,
    "vehicle.getNeighbors": _neighbours,
    "vehicle.getLaneChangeState": _fields("ii"),
    "vehicle.getNextTLS": lambda answer: _rows("sidb")([(*row[:3], ord(row[3])) for row in answer]),
    "vehicle.getNextStops": _objects("sdsidd", *_NEXT_STOP),
    "vehicle.getStops": _objects("sdsiddddddsssssd", *_STOP),
    "vehicle.getJunctionFoes": _rows("sddddssBB"),
    "vehicle.getBestLanes": _rows("sddbBl"),
    "vehicle.getNextLinks": _links,
    "lane.getLinks": _links,
    "simulation.convertRoad": lambda answer: pack("r", answer),
    "simulation.getCollisions": _objects("ssssddssd", *_COLLISION),
}
"""Answers whose layout does not follow from their type in Python."""
