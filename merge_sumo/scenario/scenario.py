"""Scenarios as values: starts and limits of the vehicles, and which gaps are too small.

A `Scenario` is a merge from a ramp. Each path has its own coordinate: the distance of the front
bumper along its lanes from the merge point M, in metres, negative before M. A case is a point of a
scenario and holds it: drivers, rollout and score take its limits from the case. `US23` is
the paper's: Wang et al., sections VI and VII and Table I.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from msgspec import Meta

from merge_sumo.errors import UserError
from merge_sumo.scenario.imperfection import (
    ACT,
    PERFECT_ACTUATION,
    PERFECT_SENSING,
    SENSE,
    Actuation,
    Sensing,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

DT_S = 0.1
"""Step of the equations of motion, eq. (4)."""
LEVELS = (0, 1, 2)
"""Levels of reasoning of the POV."""
OWN = 3
"""Stands for a level where a user's own controller is the POV; users write and read "own"."""
ALL_LEVELS = (*LEVELS, OWN)
DEADLINE_S = 5.0
"""A VUT that takes longer than this for one step, or for one reset, is a VUT_ERROR."""
MEMORY_GIB = 4.0
"""A user's code that takes more memory than this fails to get it."""
MAX_EPISODE_S = 120.0
"""No scenario lets an episode last longer."""

MAX_FOLLOW_UP_S = 30.0
"""Longest follow-up of vehicles after M."""

ROOM_AFTER_M = 2000.0
"""Minimum length of the road after M."""

Bounds = tuple[float, float]
Edges = Annotated[tuple[str, ...], Meta(min_length=1, description='edges, as in ["e1", "e2"]')]


def level_name(level: int) -> str:
    """Return the name of a level in texts."""
    return "own" if level == OWN else str(level)


AnyLevels = int | str | Iterable[int | str]


def names_of_levels(asked: AnyLevels) -> tuple[str, ...]:
    """Return the names of the levels that a user lists, in a text with commas."""
    listed = asked if isinstance(asked, Iterable) else [asked]
    parts = asked.split(",") if isinstance(asked, str) else listed
    return tuple(dict.fromkeys(str(part).strip() for part in parts)) or ("",)


@dataclass(frozen=True, slots=True)
class Coordinate:
    """A coordinate of the pool: a field of `Case`, its notation and its bounds.

    Attributes:
        field: name of the field.
        name: its name in texts.
        unit: its unit.
        digits: digits after the point.
        symbol: its label in figures of the paper's scenario.
        low: lower bound.
        high: upper bound.
    """

    field: str
    name: str
    unit: str
    digits: int
    symbol: str = ""
    low: float = 0.0
    high: float = 1.0

    def of(self, case: Any) -> float | None:
        """Return the value of a case; None where its level has no such coordinate."""
        value: float | None = getattr(case, self.field)
        return value

    def share(self, case: Any) -> float:
        """Return where a case is between the bounds, from 0 to 1; 0 where it has no value."""
        return ((self.of(case) or self.low) - self.low) / (self.high - self.low)

    def text(self, case: Any) -> str:
        """Return the value of a case for a table; empty where there is none."""
        value = self.of(case)
        return "" if value is None else f"{value:.{self.digits}f}"


SVO = Coordinate("svo_rad", "psi", "rad", 2, "$\\psi$ (rad)", 0.0, math.pi / 2)
"""psi in [0, pi/2): the upper end itself is outside the pool."""
IMPERFECTIONS = (
    Coordinate("sense_delay_s", "sensing delay", "s", 2),
    Coordinate("sense_noise_x_m", "noise of x", "m", 2),
    Coordinate("sense_noise_v_mps", "noise of v", "m/s", 2),
    Coordinate("sense_dropout", "dropout", "", 2),
    Coordinate("sense_range_m", "range", "m", 1),
    Coordinate("sense_occluded_until_m", "occluded until", "m", 1),
    Coordinate("act_lag_s", "actuator lag", "s", 2),
    Coordinate("act_delay_s", "actuator delay", "s", 2),
    Coordinate("act_power_w_per_kg", "power", "W/kg", 1),
)
"""Numbers of `SENSE` or `ACT`, by the fields of a case."""
COORDINATES = (
    Coordinate("x_pov0_m", "x_POV0", "m", 1, "$x_{POV}^0$ (m)"),
    Coordinate("v_pov0_mps", "v_POV0", "m/s", 2, "$v_{POV}^0$ (m/s)"),
    Coordinate("v_vut0_mps", "v_VUT0", "m/s", 2, "$v_{VUT}^0$ (m/s)"),
    Coordinate("headway_ahead_s", "headway ahead", "s", 2),
    Coordinate("headway_behind_s", "headway behind", "s", 2),
    *IMPERFECTIONS,
)
"""Coordinates of the pool in order, without the SVO: a scenario has those with a range."""

POV = 0
VUT = 1
AHEAD = 2
BEHIND = 3
"""Rows of the vehicles of an episode, in every array that has one for each. The mainline is driven
on by the POV and, in traffic, by a car ahead of it and one behind it."""
VEHICLES = ("pov", "vut", "ahead", "behind")
"""Their names."""
COLOURS = {"pov": "#e69f00", "vut": "#0072b2", "ahead": "#009e73", "behind": "#a6518b"}
"""Their colours in every picture (Okabe and Ito, 2008); `report.css` has lighter ones for dark
pages."""
Vehicle = Annotated[str, Meta(pattern="^(pov|vut|ahead|behind)$", description="a vehicle's name")]

EpisodeTime = Annotated[float, Meta(ge=0.0, le=MAX_EPISODE_S)]
"""A time of an episode in a record, in s."""


def rgb(vehicle: str) -> tuple[int, int, int]:
    """Return the colour of a vehicle as red, green and blue, of 255."""
    red, green, blue = bytes.fromhex(COLOURS[vehicle][1:])
    return red, green, blue


_LENGTH_M = (0.1, 100.0)
_SPEED_MPS = (0.0, 100.0)
_HEADWAY_S = (0.0, 60.0)
RANGES: dict[str, Bounds] = {
    "x_pov0_m": (-5000.0, 0.0),
    "v_pov0_mps": _SPEED_MPS,
    "x_vut0_m": (-5000.0, 0.0),
    "v_vut0_mps": _SPEED_MPS,
    "headway_ahead_s": _HEADWAY_S,
    "headway_behind_s": _HEADWAY_S,
    "tau_s": (DT_S, 10.0),
    "min_gap_m": (0.0, 100.0),
    "pov_length_m": _LENGTH_M,
    "vut_length_m": _LENGTH_M,
    "a_min_mps2": (-20.0, 0.0),
    "a_max_mps2": (0.0, 20.0),
    "timeout_s": (DT_S, MAX_EPISODE_S),
    "follow_up_s": (0.0, MAX_FOLLOW_UP_S),
    "v_hw_min_mps": _SPEED_MPS,
    "v_hw_max_mps": _SPEED_MPS,
    "v_min_mps": _SPEED_MPS,
    "ttc_min_s": (0.0, 100.0),
    "dx_crash_m": (0.0, 1000.0),
    "dx_critical_m": (0.0, 1000.0),
    "level0_a_mps2": (0.0, 20.0),
    "level0_v_mps": _SPEED_MPS,
    "reach_m": (0.0, 5000.0),
    "v_start_max_mps": _SPEED_MPS,
    "lane_m": (-2000.0, 2000.0),
}
"""Possible numbers of a road and its cars, by field: up to 360 km/h, 2 g, 5 km."""

V_VUT0_MPS = 18.0
"""Speed at which the paper's VUT starts."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Scenario:
    """A merge: the VUT comes from the ramp and the POV on the mainline, and an episode ends at M.

    Raises `UserError` for impossible numbers.

    Example:
        >>> slow = dataclasses.replace(US23, name="slow", v_pov0_mps=(15.0, 25.0))
        >>> slow.dimensions(0)[1].high
        25.0

    Attributes:
        name: its name.
        net: the SUMO net; None for the shipped one.
        x_vut0_m: where the VUT starts.
        v_vut0_mps: how fast the VUT is then, unless a campaign says otherwise: it is observed, not
            chosen by the tester. A range makes it a coordinate of the pool.
        tau_s: reaction time with which a car of the mainline follows the one ahead of it (Krauss).
        min_gap_m: distance that it keeps from it at a stand.
        pov_length_m: length of the POV and of other cars of the mainline.
        vut_length_m: length of the VUT.
        a_min_mps2: hardest braking of all vehicles, negative.
        a_max_mps2: hardest acceleration of all vehicles.
        timeout_s: an episode that has not ended by then is a TIMEOUT.
        follow_up_s: how long all drive on after M.
        v_hw_min_mps: lowest speed that the mainline drives at.
        v_hw_max_mps: highest speed that it drives at.
        v_min_mps: below this the VUT is slow.
        ttc_min_s: a time to collision below this is short.
        dx_crash_m: front bumpers nearer than this are a collision under the paper's rule.
        dx_critical_m: nearer than this is critical.
        level0_a_mps2: acceleration of a level-0 VUT (section VI-B),
        level0_v_mps: up to this speed, which it holds.
        reach_m: no vehicle starts farther from M than this.
        v_start_max_mps: no vehicle starts faster than this.
        sense: how the VUT senses other cars.
        act: how it obeys its controller.
        mainline: edges of the mainline, in driving order, past M.
        ramp: edges of the ramp, in driving order, past M.
        x_pov0_m: where the POV may start, low and high.
        v_pov0_mps: how fast it may be then.
        headway_ahead_s: time headways at which a car drives ahead of the POV, low and high: the
            distance of their front bumpers is the headway times the POV's speed, which is also
            that of the car. A coordinate of the pool; None where there is no such car.
        headway_behind_s: the same of a car behind the POV; given with the other, or not at all.
        lane_m: where the acceleration lane begins and ends, around M, which is where a merge is
            expected; None where M is the only place to merge.
        lane_end: the effect of the end of that lane on a VUT that has not merged: "merge" moves it
            to the mainline, "stop" brakes it to a stand before the end.
    """

    name: str = "us23"
    net: str | None = None
    x_vut0_m: float = -182.0
    v_vut0_mps: float | Bounds = V_VUT0_MPS
    tau_s: float = 1.0
    min_gap_m: float = 2.5
    pov_length_m: float = 5.0
    vut_length_m: float = 5.0
    a_min_mps2: float = -4.0
    a_max_mps2: float = 2.0
    timeout_s: float = 30.0
    follow_up_s: float = 3.0
    v_hw_min_mps: float = 24.6
    v_hw_max_mps: float = 35.0
    v_min_mps: float = 12.0
    ttc_min_s: float = 7.0
    dx_crash_m: float = 6.0
    dx_critical_m: float = 15.0
    level0_a_mps2: float = 1.0
    level0_v_mps: float = 28.0
    reach_m: float = 900.0
    v_start_max_mps: float = 45.0
    sense: Sensing = PERFECT_SENSING
    act: Actuation = PERFECT_ACTUATION
    mainline: Edges = ("main_in", "main_out")
    ramp: Edges = ("ramp", "main_out")
    x_pov0_m: Bounds = (-340.0, -180.0)
    v_pov0_mps: Bounds = (25.0, 35.0)
    headway_ahead_s: Bounds | None = None
    headway_behind_s: Bounds | None = None
    lane_m: Bounds | None = None
    lane_end: Literal["merge", "stop"] = "merge"

    def __post_init__(self) -> None:
        """Check the numbers one by one, then together."""
        for name, (low, high) in RANGES.items():
            value = getattr(self, name)
            for number in value if isinstance(value, tuple) else (value,):
                if number is not None and not low <= number <= high:
                    raise UserError(f"{name} is {value}: choose {low:g} to {high:g}")
        for name, fits, wanted in self._checks():
            if not fits:
                raise UserError(f"{name} is {getattr(self, name)}: choose {wanted}")

    def _checks(self) -> Iterator[tuple[str, bool, str]]:
        """Yield (field, whether it fits with the others, what would)."""
        x_m, v_mps = self.x_pov0_m, self.v_pov0_mps
        slow_mps, fast_mps = self.bounds("v_vut0_mps")
        before = f"metres before M, -{self.reach_m:g} to 0, low < high"
        speeds = f"between 0 and {self.v_start_max_mps:g}, low < high"
        yield "x_pov0_m", -self.reach_m <= x_m[0] < x_m[1] <= 0.0, before
        yield "v_pov0_mps", 0.0 <= v_mps[0] < v_mps[1] <= self.v_start_max_mps, speeds
        is_range = slow_mps < fast_mps or not isinstance(self.v_vut0_mps, tuple)
        fits = 0.0 <= slow_mps <= fast_mps <= self.v_start_max_mps
        yield "v_vut0_mps", fits and is_range, speeds
        has_both = (self.headway_ahead_s is None) == (self.headway_behind_s is None)
        yield "headway_behind_s", has_both, "both headways, or none"
        shortest_s = (self.pov_length_m + self.min_gap_m) / max(v_mps[0], 1e-9)
        apart = f"low < high, from {shortest_s:.2f} up: else cars overlap at {v_mps[0]:g} m/s"
        for name in ("headway_ahead_s", "headway_behind_s"):
            headway_s = getattr(self, name)
            yield name, headway_s is None or shortest_s <= headway_s[0] < headway_s[1], apart
        near = f"headways that start no car more than reach_m, {self.reach_m:g} m, before M"
        yield "headway_behind_s", self.farthest_start_m <= self.reach_m, near
        begin_m, end_m = self.lane_m or (0.0, 1.0)
        around = "[begin, end] of the lane: begin from x_vut0_m to 0, end above 0"
        yield "x_vut0_m", -self.reach_m <= self.x_vut0_m < 0.0, before
        yield "lane_m", self.x_vut0_m <= begin_m <= 0.0 < end_m, around
        yield "a_min_mps2", self.a_min_mps2 < 0.0, "below 0"
        for name in ("a_max_mps2", "v_min_mps", "ttc_min_s", "level0_v_mps"):
            yield name, getattr(self, name) > 0.0, "above 0"
        yield "v_hw_min_mps", 0.0 < self.v_hw_min_mps < self.v_hw_max_mps, "below v_hw_max_mps"
        yield "dx_crash_m", 0.0 < self.dx_crash_m <= self.dx_critical_m, "up to dx_critical_m"
        yield "level0_a_mps2", 0.0 < self.level0_a_mps2 <= self.a_max_mps2, "up to a_max_mps2"

    def to_record(self) -> dict[str, Any]:
        """Return the scenario as JSON keeps it, without perfect sensing and without a lane."""
        record = asdict(self)
        for name, imperfection in ((SENSE, self.sense), (ACT, self.act)):
            del record[name]
            if imperfect := imperfection.to_record():
                record[name] = imperfect
        if self.lane_m is None:
            del record["lane_m"], record["lane_end"]
        return record

    @property
    def criterion(self) -> str:
        """The criterion of a campaign that names none; the paper's is not for a lane."""
        return "paper" if self.lane_m is None else "unsafe"

    @property
    def goal(self) -> str:
        """Words for the place that the VUT must reach before the timeout."""
        return "the merge point" if self.lane_m is None else "the mainline"

    @property
    def place(self) -> str:
        """M; on an acceleration lane, where M is only expected, the merge."""
        return "M" if self.lane_m is None else "the merge"

    def wording(self, text: str) -> str:
        """Return a text with M, where M is only expected with "the merge" in its place."""
        if self.lane_m is None:
            return text
        return re.sub(r"\bM\b", self.place, text)

    def bounds(self, name: str) -> Bounds:
        """Return the bounds of a number that may be a range: both are the number if it is not."""
        value = getattr(self, name)
        return value if isinstance(value, tuple) else (value, value)

    @property
    def vehicles(self) -> int:
        """A: how many vehicles an episode has, the VUT among them."""
        return 2 if self.headway_ahead_s is None else len(VEHICLES)

    @property
    def lengths_m(self) -> tuple[float, float]:
        """Length of a car of the mainline, and of the VUT."""
        return self.pov_length_m, self.vut_length_m

    @property
    def farthest_start_m(self) -> float:
        """Distance to M of the farthest start on the mainline."""
        behind_s = 0.0 if self.headway_behind_s is None else self.headway_behind_s[1]
        return behind_s * self.v_pov0_mps[1] - self.x_pov0_m[0]

    @property
    def max_steps(self) -> int:
        """Steps after which an episode that has not ended is a TIMEOUT."""
        return round(self.timeout_s / DT_S)

    @property
    def room_after_m(self) -> float:
        """How far after M a POV may get until the timeout, at full acceleration."""
        far_m = self.v_start_max_mps * self.timeout_s + 0.5 * self.a_max_mps2 * self.timeout_s**2
        ahead_m = self.reach_m if self.vehicles > 2 else 0.0
        return max(far_m, ROOM_AFTER_M) + ahead_m

    def dimensions(self, level: int) -> tuple[Coordinate, ...]:
        """Return the continuous coordinates of the pool at a level: those that have a range.

        At level 2 the POV's orientation is the last one.
        """
        ranges = []
        for coordinate in COORDINATES:
            owner, field = self, coordinate.field
            if coordinate in IMPERFECTIONS:
                part, _, field = field.partition("_")
                owner = getattr(self, part)
            value = getattr(owner, field)
            if isinstance(value, tuple):
                ranges.append(replace(coordinate, low=value[0], high=value[1]))
        return (*ranges, SVO) if level == 2 else tuple(ranges)

    @property
    def imperfect_fields(self) -> tuple[str, ...]:
        """Fields of a case that are ranges of `sense` and `act`."""
        fields = (coordinate.field for coordinate in self.dimensions(0))
        return tuple(field for field in fields if field.startswith((SENSE, ACT)))

    @property
    def case_fields(self) -> tuple[str, ...]:
        """Fields of a case, without its level, that are its place in the scenario."""
        headways = ("headway_ahead_s", "headway_behind_s") if self.vehicles > 2 else ()
        own = ("x_pov0_m", "v_pov0_mps", "v_vut0_mps", "svo_rad")
        return (*own, *headways, *self.imperfect_fields)

    def has_ended(self, x_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return in which corridors the VUT has to be on the mainline in positions (A, K), (K,).

        It is there from M on, or from the end of the acceleration lane on.
        """
        end_m = 0.0 if self.lane_m is None else self.lane_m[1]
        arrived: NDArray[np.bool_] = x_m[VUT] >= end_m
        return arrived


US23 = Scenario()
"""The paper's."""


@dataclass(frozen=True, slots=True)
class Units:
    """The size of a scenario relative to the paper's, of which all units are 1.

    A driver that measures in these units sees the same numbers in similar merges. Where lengths,
    speeds and accelerations are all the same multiple of the paper's, all else is equal, to the
    last bit if that is a power of two.
    """

    length: float  # of the way of the VUT to M
    speed: float  # of the VUT at M, on the level-0 profile
    time: float  # that such a way takes at such a speed
    gap: float  # of the gap below which two vehicles collide
    acceleration: float  # of the hardest acceleration

    @classmethod
    def of(cls, scenario: Scenario) -> Self:
        """Return the units of a scenario."""
        length = scenario.x_vut0_m / US23.x_vut0_m
        speed = scenario.level0_v_mps / US23.level0_v_mps
        return cls(
            length=length,
            speed=speed,
            time=length / speed,
            gap=scenario.dx_crash_m / US23.dx_crash_m,
            acceleration=scenario.a_max_mps2 / US23.a_max_mps2,
        )
