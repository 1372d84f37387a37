"""What a TraCI client may command: what drives the VUT, what SUMO keeps of it, what is refused.

The VUT drives as a car in SUMO that is commanded in speed mode 38: the limits of acceleration of
the vehicle act, SUMO's checks of safe speed, right of way and lights do not. The scenario's limits
hold besides, as for every VUT.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

from merge_sumo.drivers.vuts import traci_protocol as tp
from merge_sumo.drivers.vuts.traci_protocol import ProtocolError, Reader
from merge_sumo.drivers.vuts.traci_simulation import VUT, RefusedError
from merge_sumo.values.scenario import DT_S, US23, Scenario

SET_VEHICLE, SET_VEHICLETYPE = 0xC4, 0xC5
SLOW_DOWN, SET_SPEED, SET_ACCELERATION = 0x14, 0x40, 0x72
SPEEDS: Final = {
    SLOW_DOWN: "vehicle.slowDown",
    SET_SPEED: "vehicle.setSpeed",
    SET_ACCELERATION: "vehicle.setAcceleration",
}
MAX_SPEED, ACCEL, DECEL = 0x41, 0x46, 0x47
LIMITS: Final = frozenset({MAX_SPEED, ACCEL, DECEL})
SPEED_FACTOR: Final = 0x5E
INVALID: Final = {
    MAX_SPEED: "maximum speed",
    ACCEL: "acceleration",
    DECEL: "deceleration",
    0x7B: "emergency deceleration",
    0x7C: "apparent deceleration",
    0x48: "headway time",
    0x4C: "minimum gap",
    0x5D: "driver imperfection",
    SPEED_FACTOR: "speed factor",
}
"""Numbers of SUMO's car-following model, by what SUMO calls them where they are invalid."""
OF_MODEL: Final = frozenset({*INVALID, 0x26, 0x5F})
"""All that its drivers are made of: besides those impatience and the deviation of speeds."""
OF_TYPE: Final = frozenset({*INVALID, 0x4F, 0x68, 0xB7})
"""What a vehicle says otherwise when such a number was set: besides them its type's name, the gap
to its leader (less the minimum gap) and the speed that it is allowed."""
SPEED_MODE, LANE_CHANGE_MODE = 0xB3, 0xB6
MODES: Final = {SPEED_MODE: 0x7F, LANE_CHANGE_MODE: 0xFFF}
"""The bits that SUMO knows of each mode."""
SPEED_MODE_AT_FIRST: Final = 38
REGARDS_ACCEL, REGARDS_DECEL = 2, 4
CHECKS_OF_SUMO: Final = 1 | 8 | 16
"""Bits of a speed mode: safe speed, right of way, red lights."""
MAX_KEPT: Final = 256
"""Commands that are kept of a vehicle; the oldest is dropped."""
OWN_TYPE: Final = f"{VUT}@{VUT}"
"""What SUMO calls the type of a vehicle that has numbers of its own."""


class Kind(Enum):
    """What becomes of a command."""

    DRIVES = "Drives the VUT"
    KEPT = "Kept for SUMO's answers, moves nothing"
    NOTHING = "Accepted, changes nothing"
    REFUSED = "Refused"


DRIVES: Final = frozenset(
    {
        *SPEEDS.values(),
        *("vehicle.setSpeedMode", "vehicle.setMaxSpeed", "vehicle.setAccel", "vehicle.setDecel"),
        *("vehicletype.setMaxSpeed", "vehicletype.setAccel", "vehicletype.setDecel"),
    }
)
MODEL: Final = (
    *("setTau", "setMinGap", "setImperfection", "setApparentDecel", "setEmergencyDecel"),
    *("setSpeedFactor", "setImpatience", "setSpeedDeviation"),
)
LOOKS: Final = (
    *("setColor", "setSignals", "setShapeClass", "setWidth", "setHeight", "setMass"),
    *("setLateralAlignment", "setMaxSpeedLat", "setMinGapLat", "setLine", "setEmissionClass"),
    *("setBoardingDuration", "setRoutingMode", "setAdaptedTraveltime", "setEffort"),
    *("setParameter", "requestToC"),
)
KEPT: Final = frozenset(
    f"{domain}.{function}" for domain in ("vehicle", "vehicletype") for function in MODEL + LOOKS
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

REFUSED: Final = {
    "nothing stops here but by a speed of 0": (
        *("vehicle.setStop", "vehicle.insertStop", "vehicle.replaceStop", "vehicle.resume"),
        *("vehicle.setStopParameter", "vehicle.dispatchTaxi"),
    ),
    "the route is the scenario's": (
        *("vehicle.changeTarget", "vehicle.rerouteParkingArea"),
        *("vehicle.setRoute", "vehicle.setRouteID"),
    ),
    "it acts on SUMO's car-following model, which does not drive the VUT: command its speed": (
        *("vehicle.openGap", "vehicle.deactivateGapControl"),
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


def kind_of(functions: Sequence[str]) -> Kind:
    """Return what becomes of the commands that share a number."""
    if not DRIVES.isdisjoint(functions):
        return Kind.DRIVES
    if not KEPT.isdisjoint(functions):
        return Kind.KEPT
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


@dataclass(slots=True)
class SpeedWish:
    """What the last command on the VUT's speed asks for; SUMO's own rule for each command.

    Attributes:
        target_mps: speed to reach; None to keep the present one.
        duration_s: time in which it is reached, from the first step after the command; 0 at once.
        start_mps: speed at that step; None before it.
        elapsed_s: time since.
    """

    target_mps: float | None = None
    duration_s: float = 0.0
    start_mps: float | None = None
    elapsed_s: float = 0.0

    def next_mps(self, v_mps: float) -> float:
        """Return the speed after the coming step; the wish ages by a step."""
        if self.target_mps is None:
            return v_mps
        if self.duration_s == 0.0:
            return self.target_mps
        if self.start_mps is None:
            self.start_mps = v_mps
        if self.elapsed_s > self.duration_s + 1e-9:
            return v_mps
        self.elapsed_s += DT_S
        share = min(self.elapsed_s / max(self.duration_s, DT_S), 1.0)
        return self.start_mps + (self.target_mps - self.start_mps) * share


@dataclass(slots=True)
class Orders:
    """What a client has commanded of the VUT and of its type.

    Attributes:
        scenario: whose limits of acceleration the VUT has at first.
        wish: what is commanded of its speed.
        modes: the speed mode and the lane change mode, by their variables, where they were set.
        own: what was set of its maximum speed, acceleration and deceleration, by their variables;
            None while it has those of its type. As in SUMO it gets numbers of its own, copied from
            its type, when the first of them is set.
        of_type: what was set of those of the type; it outlives the vehicle.
        kept: the commands themselves, for a SUMO that is asked: the last of each variable.
        kept_of_type: those on the type.
    """

    scenario: Scenario = US23
    wish: SpeedWish = field(default_factory=SpeedWish)
    modes: dict[int, int] = field(default_factory=dict)
    own: dict[int, float] | None = None
    of_type: dict[int, float] = field(default_factory=dict)
    kept: dict[bytes, bytes] = field(default_factory=dict)
    kept_of_type: dict[bytes, bytes] = field(default_factory=dict)

    def carry_out(self, command: int, variable: int, name: str, typed: bytes, v_mps: float) -> None:
        """Take a command on the VUT, at its speed, or on its type.

        Raises `RefusedError` for what SUMO would refuse, and `ProtocolError` for no value.
        """
        if command == SET_VEHICLE and variable in SPEEDS:
            self._command_speed(variable, Reader(typed).typed(), v_mps)
            return
        if command == SET_VEHICLE and variable in MODES:
            mode = Reader(typed).typed()
            if not isinstance(mode, int):
                raise RefusedError("a mode is an integer")
            self.modes[variable] = mode & MODES[variable]
            return
        of_type = command != SET_VEHICLE and name == VUT
        if variable in INVALID:
            self._set_number(variable, Reader(typed).typed(), of_type=of_type)
        kept = self.kept_of_type if of_type else self.kept
        if len(kept) >= MAX_KEPT:
            del kept[next(iter(kept))]
        of_several = typed[:1] == bytes((tp.TYPE_COMPOUND,))
        key = bytes((command, variable)) + (typed if of_several else b"")
        kept[key] = bytes((command, variable)) + tp.raw_string(name) + typed

    def _command_speed(self, variable: int, value: object, v_mps: float) -> None:
        if variable == SET_SPEED and isinstance(value, float):
            self.wish = SpeedWish(None if value < 0.0 else value)
            return
        numbers = [v for v in value if type(v) is float] if isinstance(value, tuple) else []
        if variable == SET_SPEED or len(numbers) != 2 or value != tuple(numbers):
            raise ProtocolError(f"a speed was commanded by {value!r:.60}")
        change, duration_s = numbers
        if duration_s < 0.0:
            raise RefusedError(f"a duration of {duration_s} s is negative")
        target = change if variable == SLOW_DOWN else max(v_mps + change * duration_s, 0.0)
        self.wish = SpeedWish(target, max(duration_s, DT_S))

    def _set_number(self, variable: int, value: object, *, of_type: bool) -> None:
        number = value if isinstance(value, float) and math.isfinite(value) else -1.0
        if number < 0.0 or (number == 0.0 and variable == MAX_SPEED):
            raise RefusedError(f"Invalid {INVALID[variable]}.")
        if of_type:
            limits = self.of_type
        elif variable == SPEED_FACTOR:
            return  # a vehicle has one without numbers of its own
        else:
            self.own = limits = dict(self.of_type) if self.own is None else self.own
        if variable in LIMITS:
            limits[variable] = number

    def next_mps(self, v_mps: float) -> float:
        """Return the speed after the coming step, as far as the limits that were set let it be.

        As in SUMO the speed mode says which are regarded, and braking goes last. Who set none is
        held by the scenario's alone, as every VUT is.
        """
        wanted_mps = self.wish.next_mps(v_mps)
        given = self.of_type if self.own is None else self.own
        if not given:
            return wanted_mps
        limits = {
            MAX_SPEED: math.inf,
            ACCEL: self.scenario.a_max_mps2,
            DECEL: -self.scenario.a_min_mps2,
            **given,
        }
        mode = self.mode(SPEED_MODE)
        if mode & REGARDS_ACCEL:
            wanted_mps = min(wanted_mps, limits[MAX_SPEED], v_mps + limits[ACCEL] * DT_S)
        if mode & REGARDS_DECEL:
            wanted_mps = max(wanted_mps, v_mps - limits[DECEL] * DT_S, 0.0)
        return wanted_mps

    def mode(self, variable: int) -> int:
        """Return a mode."""
        return self.modes.get(variable, SPEED_MODE_AT_FIRST if variable == SPEED_MODE else 0)

    def changed(self, variable: int) -> bool:
        """Return whether what a vehicle says of a variable follows from what was set."""
        numbers = variable in OF_TYPE and (self.own is not None or bool(self.kept_of_type))
        return numbers or any(key[1] == variable for key in self.kept)

    def all_kept(self) -> list[bytes]:
        """Return the commands that a SUMO has to be told, which knows nothing yet."""
        return [*self.kept_of_type.values(), *self.kept.values()]

    def forget_vehicle(self) -> None:
        """Keep what was set of the type alone: the next vehicle is another one."""
        self.wish, self.own = SpeedWish(), None
        self.modes.clear()
        self.kept.clear()


def note_on(name: str, variable: int, kind: Kind, typed: bytes) -> str:
    """Return what there is to say of a command that does less than in SUMO; "" of others."""
    if kind is Kind.KEPT and variable in OF_MODEL:
        return (
            f"{name} is kept for what SUMO answers and moves nothing: SUMO's car-following model "
            "does not drive the VUT"
        )
    if kind is not Kind.DRIVES:
        return f"{name} is accepted and changes nothing here"
    if variable not in (SPEED_MODE, SET_SPEED):
        return ""
    value = Reader(typed).typed()
    if variable == SPEED_MODE and isinstance(value, int) and value & CHECKS_OF_SUMO:
        return (
            f"{name}: limits of acceleration act as the mode says; SUMO's checks of safe speed, "
            "right of way and red lights are off here"
        )
    if variable == SET_SPEED and isinstance(value, float) and value < 0.0:
        return (
            f"{name} below 0 gives the VUT back to SUMO's car-following model, which does not "
            "drive it here: it keeps its speed"
        )
    return ""
