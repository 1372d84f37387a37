"""Which commands of a TraCI client SUMO carries out on the VUT, and why the rest is refused."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum
from functools import cache
from typing import Final

from merge_sumo.scenario.scenario import DT_S
from merge_sumo.sumo.shadow_sumo import RefusedError
from merge_sumo.vuts.traci.protocol import Reader
from merge_sumo.vuts.traci.questions import Call


class Effect(Enum):
    """What becomes of a command."""

    CARRIED_OUT = "Carried out by SUMO, on the VUT and its type"
    ON_A_LANE = "Carried out by SUMO on a road with an acceleration lane; elsewhere changes nothing"
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
    ["vehicle.setLaneChangeMode"]
    + [f"vehicle.{function}" for function in (*SPEEDS, *GAPS_AND_STOPS, *MODEL, *LOOKS)]
    + [f"vehicletype.{function}" for function in (*MODEL, *LOOKS)]
)
ON_A_LANE: Final = frozenset({"vehicle.changeLane", "vehicle.changeLaneRelative"})
"""Commands that say on which lane the VUT is to drive, where there are two for it."""
NOTHING: Final = frozenset(
    f"vehicle.{function}"
    for function in (
        *("changeSublane", "highlight"),
        *("setVia", "rerouteTraveltime", "rerouteEffort", "updateBestLanes"),
    )
)
"""Commands that are accepted: the path holds anyway."""
ONLY_SEEN: Final = ("gui", "poi", "polygon")
"""Domains of what is only looked at."""
OF_OTHERS: Final = frozenset(
    f"{domain}.{f}" for domain in ("vehicle", "vehicletype") for f in LOOKS
)
"""Commands that are accepted on other vehicles, too, and change nothing there."""

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
def effect_of(functions: tuple[str, ...]) -> Effect:
    """Return what becomes of the commands that share a number."""
    if not CARRIED_OUT.isdisjoint(functions):
        return Effect.CARRIED_OUT
    if not ON_A_LANE.isdisjoint(functions):
        return Effect.ON_A_LANE
    if any(
        function in NOTHING
        or function.endswith(".setParameter")
        or function.partition(".")[0] in ONLY_SEEN
        for function in functions
    ):
        return Effect.NOTHING
    return Effect.REFUSED


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


def call_of_command(functions: Sequence[str], object_id: str, reader: Reader) -> Call:
    """Return the call that carries out what some functions of SUMO's client command of an object.

    Raises `RefusedError` for a value that SUMO's models cannot have, and for a device, and
    `NotFiniteError` for a speed that is no number: the VUT would drive on as if nothing was
    commanded.
    """
    function, arguments = functions[-1], reader.arguments()
    name = function.partition(".")[2]
    for value in arguments:
        # As SUMO's server does: its models cannot have such a number.
        if name in INVALID and isinstance(value, float):
            is_zero_speed = name == "setMaxSpeed" and value == 0.0
            if not math.isfinite(value) or value < 0.0 or is_zero_speed:
                raise RefusedError(f"Invalid {INVALID[name]}.")
    if any(isinstance(value, float) and not math.isfinite(value) for value in arguments):
        given = ", ".join(f"{value!r:.40}" for value in arguments)
        if name in SPEEDS:
            raise NotFiniteError(f"{function}({given})")
        raise RefusedError(f"{function} takes no ({given})")
    if name == "setParameter" and str(arguments[0] if arguments else "").startswith(
        KEYS_OF_DEVICES
    ):
        raise RefusedError(f"merge-sumo gives vehicles no devices: {arguments[0]!r:.60}")
    if functions[0] == "vehicle.changeLane":
        # An offset has a third value behind it, which only marks it as one.
        return functions[len(arguments) > len(("lane", "duration"))], [object_id, *arguments[:2]]
    if name == "openGap" and arguments[:2] == [-1.0, -1.0]:
        return "vehicle.deactivateGapControl", [object_id]
    if name in ("setAdaptedTraveltime", "setEffort") and len(arguments) == 4:
        begin_s, end_s, edge, value = arguments
        arguments = [edge, value, begin_s, end_s]
    return function, [object_id, *arguments]
