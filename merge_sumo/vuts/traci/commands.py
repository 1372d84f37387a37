"""Which commands of a TraCI client SUMO carries out on the VUT, and why the rest is refused."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum
from functools import cache
from typing import Final

from merge_sumo.sumo.shadow_sumo import RefusedError
from merge_sumo.vuts.traci.protocol import Reader
from merge_sumo.vuts.traci.questions import Call


class Effect(Enum):
    """What becomes of a command."""

    CARRIED_OUT = "Carried out by SUMO, on the VUT and its type"
    ON_A_LANE = "Carried out by SUMO on a road with an acceleration lane; elsewhere changes nothing"
    REACHED = "Taken as what a vehicle model of the controller's own reaches in the step"
    OWN_KEYS = "Carried out by SUMO on the VUT, for keys without a dot"
    NOTHING = "Accepted, changes nothing"
    REFUSED = "Refused: the scenario and the campaign decide it"


SPEEDS: Final = ("setSpeed", "slowDown", "setAcceleration", "setSpeedMode")
GAPS_AND_STOPS: Final = ("openGap", "deactivateGapControl", "setStop", "resume")
MODEL: Final = {
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
CARRIED_OUT: Final = frozenset(
    [f"vehicle.{function}" for function in (*SPEEDS, *GAPS_AND_STOPS, "setLaneChangeMode")]
    + [f"{domain}.{function}" for domain in ("vehicle", "vehicletype") for function in MODEL]
)
ON_A_LANE: Final = frozenset({"vehicle.changeLane", "vehicle.changeLaneRelative"})
"""Commands that say on which lane the VUT is to drive, where there are two for it."""
REACHED: Final = frozenset({"vehicle.setPreviousSpeed", "vehicle.moveToXY"})
OWN_KEYS: Final = "vehicle.setParameter"
"""A key with a dot is SUMO's: of its models, and of devices that write files."""
LOOKS: Final = (
    *("setColor", "setSignals", "setShapeClass", "setWidth", "setHeight", "setLine", "highlight"),
    *("setEmissionClass", "setBoardingDuration"),
)
NOTHING: Final = frozenset(
    f"{domain}.{function}"
    for domain in ("vehicle", "vehicletype")
    for function in (
        *(*LOOKS, "setMass", "setLateralAlignment", "setMaxSpeedLat", "setMinGapLat"),
        *("setImpatience", "setSpeedDeviation", "changeSublane"),
        *("setRoutingMode", "setAdaptedTraveltime", "setEffort", "setVia", "updateBestLanes"),
        *("rerouteTraveltime", "rerouteEffort"),
    )
)
"""Looks, places across a lane, and routes: the path holds anyway."""
ONLY_SEEN: Final = ("gui", "poi", "polygon")
"""Domains of what is only looked at."""


def is_in_vain(functions: Sequence[str]) -> bool:
    """Return whether commands that change nothing here change in SUMO how the VUT drives."""
    domain, _, name = functions[-1].partition(".")
    return domain in ("vehicle", "vehicletype") and name not in LOOKS


@cache
def effect_of(functions: tuple[str, ...]) -> Effect:
    """Return what becomes of the commands that share a number."""
    if not CARRIED_OUT.isdisjoint(functions):
        return Effect.CARRIED_OUT
    if not ON_A_LANE.isdisjoint(functions):
        return Effect.ON_A_LANE
    if not REACHED.isdisjoint(functions):
        return Effect.REACHED
    if OWN_KEYS in functions:
        return Effect.OWN_KEYS
    accepted = any(
        function in NOTHING
        or function.endswith(".setParameter")
        or function.partition(".")[0] in ONLY_SEEN
        for function in functions
    )
    return Effect.NOTHING if accepted else Effect.REFUSED


class NotFiniteError(Exception):
    """A command on the VUT's speed with a number that is none; the text is the command."""


def call_of_command(functions: Sequence[str], object_id: str, reader: Reader) -> Call:
    """Return the call that carries out what some functions of SUMO's client command of an object.

    Raises `RefusedError` for a value that SUMO's models cannot have, and `NotFiniteError` for a
    speed that is no number: the VUT would drive on as if nothing was commanded.
    """
    function, arguments = functions[-1], reader.arguments()
    name = function.partition(".")[2]
    numbers = [value for value in arguments if isinstance(value, float)]
    if name in MODEL and any(not 0.0 <= value < math.inf for value in numbers):
        raise RefusedError(f"Invalid {MODEL[name]}.")
    if name == "setMaxSpeed" and 0.0 in numbers:
        raise RefusedError(f"Invalid {MODEL[name]}.")
    if not all(map(math.isfinite, numbers)):
        given = ", ".join(f"{value!r:.40}" for value in arguments)
        if function in REACHED:  # what follows are defaults of the client
            given = next(f"{value!r}" for value in numbers if not math.isfinite(value))
        if name in SPEEDS or function in REACHED:
            raise NotFiniteError(f"{function}({given})")
        raise RefusedError(f"{function} takes no ({given})")
    if functions[0] == "vehicle.changeLane":
        # An offset has a third value behind it, which only marks it as one.
        name = functions[len(arguments) > len(("lane", "duration"))]
        return Call(name, [object_id, *arguments[:2]])
    if name == "openGap" and arguments[:2] == [-1.0, -1.0]:
        return Call("vehicle.deactivateGapControl", [object_id])
    return Call(function, [object_id, *arguments])
