"""How a question of a TraCI client is put to SUMO, and how SUMO's answer is packed.

A question carries the numbers of a domain and of a variable; SUMO's own client names the functions
behind them (`traci_names`), and libsumo has the same functions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final

from merge_sumo.sumo.shadow_sumo import RefusedError
from merge_sumo.vuts.traci.protocol import (
    ProtocolError,
    Reader,
    compound,
    pack,
    raw_double,
    raw_string,
)

Call = tuple[str, list[Any]]
"""A function of libsumo, named as "vehicle.getSpeed", and its arguments."""

OF_SHARED_VARIABLES: Final = {
    "trafficlight.getNemaPhaseCalls": "trafficlight.getParameter",
    "vehicle.couldChangeLane": "vehicle.getLaneChangeState",
    "vehicle.getLeftFollowers": "vehicle.getNeighbors",
}
"""Of several functions that read one variable, by the first: the one that SUMO's server calls."""
WITHOUT_OBJECT: Final = ("getIDList", "getIDCount", "getLoadedIDList", "getTeleportingIDList")
DOMAINS: Final = (
    *("vehicle", "vehicletype", "simulation", "edge", "lane", "junction", "route"),
    *("trafficlight", "poi", "polygon"),
)
"""What a road and its cars have; a car asks of no other."""
NOT_ANSWERED: Final = {
    *("vehicle.getDrivingDistance", "vehicle.getDrivingDistance2D", "vehicle.getJunctionFoes"),
    *("vehicle.getNextStops", "vehicle.getNextTLS", "vehicle.getStops", "vehicle.getTaxiFleet"),
    *("lane.getFoes", "lane.getInternalFoes", "simulation.getCollisions"),
    *("simulation.convert2D", "simulation.convert3D", "simulation.convertGeo"),
    *("simulation.convertRoad", "simulation.findIntermodalRoute", "simulation.findRoute"),
    *("simulation.getDistance2D", "simulation.getDistanceRoad"),
    *("trafficlight.getAllProgramLogics", "trafficlight.getConstraints"),
    *("trafficlight.getConstraintsByFoe", "trafficlight.getControlledLinks"),
    "trafficlight.swapConstraints",
}
"""Questions whose parameters or answers have a layout of their own."""


def is_answered(functions: Sequence[str]) -> bool:
    """Return whether SUMO is asked what some functions of its client ask."""
    return functions[0].partition(".")[0] in DOMAINS and NOT_ANSWERED.isdisjoint(functions)


def call_of_question(functions: Sequence[str], object_id: str, reader: Reader) -> Call:
    """Return the call that answers what some functions of SUMO's client ask of an object.

    The reader has the parameters of the question. Raises `RefusedError` where none answers it.
    """
    function = OF_SHARED_VARIABLES.get(functions[0], functions[0])
    if not is_answered(functions):
        raise RefusedError(f"merge-sumo does not answer {function}")
    try:
        arguments = reader.arguments()
    except ProtocolError as error:
        raise RefusedError(f"{function} was asked in no form that SUMO has") from error
    domain, _, name = function.partition(".")
    if name in WITHOUT_OBJECT or (domain == "simulation" and not object_id):
        return function, arguments
    return function, [object_id, *arguments]


def packed(function: str, answer: Any) -> bytes:
    """Return the typed value of what a function of libsumo gave, as SUMO's own server packs it."""
    if function in _LAYOUTS:
        return _LAYOUTS[function](answer)
    if isinstance(answer, str):
        return pack("s", answer)
    if not isinstance(answer, tuple):
        return pack("i" if isinstance(answer, int) else "d", answer)
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


def _one_vehicle(answer: tuple[str, float] | None) -> bytes:
    return _fields("sd", answer or ("", -1.0))


def _links(answer: Sequence[Sequence[Any]]) -> bytes:
    """Pack links: libsumo has the lane inside of the junction at another place than the wire."""
    return _rows("ssBBBssd", [(link[0], link[4], *link[1:4], *link[5:]) for link in answer])


def _neighbours(answer: Sequence[tuple[str, float]]) -> bytes:
    items = (raw_string(name) + raw_double(gap_m) for name, gap_m in answer)
    return compound(len(answer), b"".join(items))


_LAYOUTS: Final[dict[str, Callable[[Any], bytes]]] = {
    "vehicle.getLeader": _one_vehicle,
    "vehicle.getFollower": _one_vehicle,
    "vehicle.getNeighbors": _neighbours,
    "vehicle.getLaneChangeState": lambda answer: _fields("ii", answer),
    "vehicle.getBestLanes": lambda answer: _rows("sddbBl", answer),
    "vehicle.getNextLinks": _links,
    "lane.getLinks": _links,
    **dict.fromkeys(
        ("lane.getShape", "junction.getShape", "polygon.getShape", "simulation.getNetBoundary"),
        lambda answer: pack("p", answer),
    ),
    **dict.fromkeys(
        (f"{domain}.getParameterWithKey" for domain in DOMAINS),
        lambda answer: _fields("ss", answer),
    ),
}
"""Answers whose layout does not follow from their type in Python."""
