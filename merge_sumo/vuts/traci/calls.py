"""Which function of SUMO a TraCI command calls, how its answer is packed, and what is refused.

Questions and commands carry the numbers of a domain and of a variable; SUMO's own client names the
functions behind them (`traci_names`), and libsumo has the same functions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from enum import Enum
from functools import cache
from typing import Any, Final

from merge_sumo.sumo.shadow_sumo import RefusedError
from merge_sumo.values.scenario import DT_S
from merge_sumo.vuts.traci import protocol as tp
from merge_sumo.vuts.traci.protocol import ProtocolError, Reader

Arguments = list[Any]
Call = tuple[str, Arguments]
"""A function of libsumo, named as "vehicle.getSpeed", and what it takes behind the object."""

ASKED: Final = {
    "trafficlight.getNemaPhaseCalls": "trafficlight.getParameter",
    "trafficlight.getRedYellowGreenState": "trafficlight.getRedYellowGreenState",
    "trafficlight.getAllProgramLogics": "trafficlight.getAllProgramLogics",
    "vehicle.couldChangeLane": "vehicle.getLaneChangeState",
    "vehicle.getLeftFollowers": "vehicle.getNeighbors",
    "person.getRemainingStages": "person.getRemainingStages",
}
"""Of several functions that ask for one variable, the one that SUMO's server calls."""
WITHOUT_OBJECT: Final = frozenset(
    {
        *("getIDList", "getIDCount", "getLoadedIDList", "getTeleportingIDList", "getTaxiFleet"),
        "getTaxiReservations",
    }
)
NOT_ANSWERED: Final = frozenset(
    {
        "trafficlight.getConstraints",
        "trafficlight.getConstraintsByFoe",
        "trafficlight.swapConstraints",
        "simulation.findIntermodalRoute",
    }
)
"""Their answers have a layout that no car needs."""
COMPOUND_HEAD_BYTES: Final = 5
"""Its type, and how many values it has."""
GEO: Final = (tp.POSITION_LON_LAT, tp.POSITION_LON_LAT_ALT)
DRIVING: Final = 1
"""A distance by road, as a question for one says; 0 is the one through the air."""


def asked_of(functions: Sequence[str], object_id: str, reader: Reader) -> Call:
    """Return what a question calls; raises `RefusedError` for what is not answered."""
    function = ASKED.get(functions[0], functions[0])
    domain, _, name = function.partition(".")
    if domain == "gui":  # without a window libsumo's answer is the end of the process
        raise RefusedError("GUI is not running, command not implemented in command line sumo")
    if function in NOT_ANSWERED:
        raise RefusedError(f"merge-sumo does not answer {function}: no car needs it")
    try:
        special = SPECIAL.get(function)
        if special is not None:
            return special(object_id, reader)
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


SPECIAL: Final[dict[str, Callable[[str, Reader], Call]]] = {
    "vehicle.getDrivingDistance": _distance_of_vehicle,
    "simulation.getDistance2D": _distance,
    "simulation.convert2D": _converted,
    "lane.getFoes": _foes,
}


class Kind(Enum):
    """What becomes of a command."""

    CARRIED_OUT = "Carried out by SUMO, on the VUT and its type"
    NOTHING = "Accepted, changes nothing"
    REFUSED = "Refused"


SPEEDS: Final = ("setSpeed", "slowDown", "setAcceleration", "setSpeedMode")
GAPS_AND_STOPS: Final = (
    *("openGap", "deactivateGapControl", "setStop", "setBusStop", "setChargingStationStop"),
    *("setContainerStop", "setParkingAreaStop", "insertStop", "replaceStop", "setStopParameter"),
    "resume",
)
MODEL: Final = (
    *("setMaxSpeed", "setAccel", "setDecel", "setEmergencyDecel", "setApparentDecel", "setTau"),
    *("setMinGap", "setImperfection", "setSpeedFactor", "setImpatience", "setSpeedDeviation"),
)
LOOKS: Final = (
    *("setColor", "setSignals", "setShapeClass", "setWidth", "setHeight", "setMass"),
    *("setLateralAlignment", "setMaxSpeedLat", "setMinGapLat", "setLine", "setEmissionClass"),
    *("setBoardingDuration", "setRoutingMode", "setAdaptedTraveltime", "setEffort"),
    *("setParameter", "requestToC"),
)
CARRIED_OUT: Final = frozenset(
    [f"vehicle.{function}" for function in (*SPEEDS, *GAPS_AND_STOPS, *MODEL, *LOOKS)]
    + [f"vehicletype.{function}" for function in (*MODEL, *LOOKS)]
)
NOTHING: Final = frozenset(
    f"vehicle.{function}"
    for function in (
        *("setLaneChangeMode", "changeLane", "changeLaneRelative", "changeSublane", "highlight"),
        *("setVia", "rerouteTraveltime", "rerouteEffort", "updateBestLanes"),
    )
)
"""Commands that are accepted: the path holds anyway."""
ONLY_SEEN: Final = ("gui", "poi", "polygon")
"""Domains of what is only looked at."""
OF_OTHERS: Final = frozenset(
    f"{domain}.{f}" for domain in ("vehicle", "vehicletype") for f in LOOKS
)
"""Commands that are accepted of other vehicles, too, and change nothing there."""

REFUSED: Final = {
    "the route is the scenario's": (
        *("vehicle.changeTarget", "vehicle.rerouteParkingArea", "vehicle.dispatchTaxi"),
        *("vehicle.setRoute", "vehicle.setRouteID"),
    ),
    "what the vehicles are is the scenario's": (
        *("vehicle.setLength", "vehicle.setVehicleClass", "vehicle.setType", "vehicletype"),
    ),
    f"the VUT acts in every step of {DT_S:g} s": (
        *("vehicle.setActionStepLength", "vehicletype.setActionStepLength"),
    ),
    "vehicles come, move and go as the scenario says, and the VUT by its speed": ("vehicle",),
    "the road is the scenario's": ("edge", "lane", "route", "trafficlight", "variablespeedsign"),
    "the campaign runs the simulation": ("simulation",),
}
"""Why a function is refused, else those of its domain."""
INVALID: Final = {
    "setMaxSpeed": "maximum speed",
    "setAccel": "acceleration",
    "setDecel": "deceleration",
    "setEmergencyDecel": "emergency deceleration",
    "setApparentDecel": "apparent deceleration",
    "setTau": "headway time",
    "setMinGap": "minimum gap",
    "setImperfection": "driver imperfection",
    "setSpeedFactor": "speed factor",
}
"""Numbers of SUMO's car-following model, by what its server calls them where they are invalid."""
KEYS_OF_DEVICES: Final = ("device.", "has.")
"""Parameters by which SUMO gives a vehicle a device; some of them write files."""


@cache
def kind_of(functions: tuple[str, ...]) -> Kind:
    """Return what becomes of the commands that share a number."""
    if not CARRIED_OUT.isdisjoint(functions):
        return Kind.CARRIED_OUT
    if any(
        function in NOTHING
        or function.endswith(".setParameter")
        or function.partition(".")[0] in ONLY_SEEN
        for function in functions
    ):
        return Kind.NOTHING
    return Kind.REFUSED


def reason_against(functions: Sequence[str]) -> str:
    """Return why such commands are refused."""
    domains = (function.partition(".")[0] for function in functions)
    for name in (*functions, *domains):
        for reason, names in REFUSED.items():
            if name in names:
                return reason
    return "there is none of that kind here"


class NotFiniteError(Exception):
    """A command on the VUT's speed with a number that is none; the text is the command."""


def _check_number(name: str, value: object) -> None:
    """Raise `RefusedError`, as SUMO's server does, for a number that its models cannot have."""
    what = INVALID.get(name)
    if what is None or not isinstance(value, float):
        return
    if not math.isfinite(value) or value < 0.0 or (value == 0.0 and name == "setMaxSpeed"):
        raise RefusedError(f"Invalid {what}.")


def told_by(functions: Sequence[str], object_id: str, reader: Reader) -> Call:
    """Return what a command calls; raises `RefusedError` for a value that is not taken.

    Raises `NotFiniteError` where that is a speed: the VUT would drive on as if nothing was said.
    """
    function, arguments = functions[-1], reader.arguments()
    name = function.partition(".")[2]
    for value in arguments:
        _check_number(name, value)
    if any(isinstance(value, float) and not math.isfinite(value) for value in arguments):
        given = ", ".join(f"{value!r:.40}" for value in arguments)
        if name in SPEEDS:
            raise NotFiniteError(f"{function}({given})")
        raise RefusedError(f"{function} takes no ({given})")
    if name == "setParameter" and str(arguments[0] if arguments else "").startswith(
        KEYS_OF_DEVICES
    ):
        raise RefusedError(f"merge-sumo gives vehicles no devices: {arguments[0]!r:.60}")
    if name == "openGap" and arguments[:2] == [-1.0, -1.0]:
        return "vehicle.deactivateGapControl", [object_id]
    if name in ("setAdaptedTraveltime", "setEffort") and len(arguments) == 4:
        begin_s, end_s, edge, value = arguments
        arguments = [edge, value, begin_s, end_s]
    return function, [object_id, *arguments]
