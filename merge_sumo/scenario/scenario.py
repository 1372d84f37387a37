"""Scenarios: starts and limits of the vehicles of a merge, and the gaps that are too small.

Positions are lane coordinates: distances of front bumpers along the lanes of a path from the merge
point M, in m, negative before M. `US23` is the scenario of the paper (Wang et al., Table I).
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
    check_amount,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

DT_S = 0.1
"""Step of the equations of motion, eq. (4)."""
LEVELS = (0, 1, 2)
"""Levels of reasoning of the POV."""
OWN = 3
"""Level of a POV that is a controller of the user; texts call it "own"."""
ALL_LEVELS = (*LEVELS, OWN)
DEADLINE_S = 5.0
"""Maximum time of a VUT for a step or a reset, else the case is a VUT_ERROR."""
MEMORY_GIB = 4.0
"""Maximum memory of the code of a user."""
MAX_EPISODE_S = 120.0
"""Maximum duration of an episode in any scenario."""

MAX_FOLLOW_UP_S = 30.0
"""Maximum duration of the follow-up after M."""

ROOM_AFTER_M = 2000.0
"""Minimum length of the road after M."""

Bounds = tuple[float, float]
Edges = Annotated[tuple[str, ...], Meta(min_length=1, description='edges, as in ["e1", "e2"]')]


def level_name(level: int) -> str:
    """Return the name of a level in texts.

    Args:
        level: one of `ALL_LEVELS`.
    """
    return "own" if level == OWN else str(level)


AnyLevels = int | str | Iterable[int | str]


def names_of_levels(levels: AnyLevels) -> tuple[str, ...]:
    """Return the names of the levels of an argument, each once.

    Args:
        levels: a level, levels, or a text with commas.

    Example:
        >>> names_of_levels("0, 2, own")
        ('0', '2', 'own')
    """
    if isinstance(levels, str):
        levels = levels.split(",")
    elif not isinstance(levels, Iterable):
        levels = [levels]
    names = [str(level).strip() for level in levels]
    return tuple(dict.fromkeys(names)) or ("",)


@dataclass(frozen=True, slots=True)
class Coordinate:
    """A coordinate of the pool: a field of `Case`, its notation and its bounds.

    Attributes:
        field: name of the field.
        name: name in texts.
        unit: unit in texts; empty for a share.
        digits: number of digits after the decimal point.
        symbol: label of the axis in figures of the paper's scenario.
        low: lower bound in the pool.
        high: upper bound in the pool.
    """

    field: str
    name: str
    unit: str
    digits: int
    symbol: str = ""
    low: float = 0.0
    high: float = 1.0

    def of(self, case: Any) -> float | None:
        """Return the value of a case.

        Args:
            case: a `Case`.

        Returns:
            The value; None where the level of the case has no such coordinate.
        """
        value: float | None = getattr(case, self.field)
        return value

    def share(self, case: Any) -> float:
        """Return the place of a case between the bounds.

        Args:
            case: a `Case`.

        Returns:
            0 at the lower bound, 1 at the upper bound; 0 for a case without a value.
        """
        return ((self.of(case) or self.low) - self.low) / (self.high - self.low)

    def text(self, case: Any) -> str:
        """Return the value of a case for a table.

        Args:
            case: a `Case`.

        Returns:
            The value without its unit; empty for a case without a value.
        """
        value = self.of(case)
        return "" if value is None else f"{value:.{self.digits}f}"


SVO = Coordinate("svo_rad", "psi", "rad", 2, "$\\psi$ (rad)", 0.0, math.pi / 2)
"""Orientation psi in [0, pi/2)."""
OPTIONAL = (
    Coordinate("headway_ahead_s", "headway ahead", "s", 2),
    Coordinate("headway_behind_s", "headway behind", "s", 2),
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
"""Coordinates that a scenario may have: headways, and ranges of `sense` and `act`."""
COORDINATES = (
    Coordinate("x_pov0_m", "x_POV0", "m", 1, "$x_{POV}^0$ (m)"),
    Coordinate("v_pov0_mps", "v_POV0", "m/s", 2, "$v_{POV}^0$ (m/s)"),
    Coordinate("v_vut0_mps", "v_VUT0", "m/s", 2, "$v_{VUT}^0$ (m/s)"),
    *OPTIONAL,
)
"""Coordinates of the pool in order, except the SVO. A scenario has those with a range."""

POV = 0
VUT = 1
AHEAD = 2
BEHIND = 3
"""Indices of the vehicles of an episode in every array with one row for each. The POV and, in
traffic, the cars ahead of it and behind it are cars of the mainline."""
VEHICLES = ("pov", "vut", "ahead", "behind")
"""Names of the vehicles, by index."""
NAMES = {
    "pov": "POV",
    "vut": "VUT",
    "ahead": "car ahead of the POV",
    "behind": "car behind the POV",
}
"""Names of the vehicles in texts."""
COLOURS = {"pov": "#e69f00", "vut": "#0072b2", "ahead": "#009e73", "behind": "#a6518b"}
"""Colours of the vehicles in every picture (Okabe and Ito, 2008); `report.css` has lighter ones for
dark pages."""
Vehicle = Annotated[str, Meta(pattern="^(pov|vut|ahead|behind)$", description="a vehicle's name")]

EpisodeTime = Annotated[float, Meta(ge=0.0, le=MAX_EPISODE_S)]
"""A time of an episode in a record, in s."""


LEAST = 0.01
"""Least amount of a number that must be above or below 0."""
_LENGTH_M = (0.1, 100.0)
_SPEED_MPS = (0.0, 100.0)
_TARGET_MPS = (LEAST, 100.0)
_HEADWAY_S = (0.0, 60.0)
RANGES: dict[str, Bounds] = {
    "x_pov0_m": (-5000.0, 0.0),
    "v_pov0_mps": _SPEED_MPS,
    "x_vut0_m": (-5000.0, -LEAST),
    "v_vut0_mps": _SPEED_MPS,
    "headway_ahead_s": _HEADWAY_S,
    "headway_behind_s": _HEADWAY_S,
    "tau_s": (DT_S, 10.0),
    "min_gap_m": (0.0, 100.0),
    "pov_length_m": _LENGTH_M,
    "vut_length_m": _LENGTH_M,
    "a_min_mps2": (-20.0, -LEAST),
    "a_max_mps2": (LEAST, 20.0),
    "timeout_s": (DT_S, MAX_EPISODE_S),
    "follow_up_s": (0.0, MAX_FOLLOW_UP_S),
    "v_hw_min_mps": _TARGET_MPS,
    "v_hw_max_mps": _SPEED_MPS,
    "v_min_mps": _TARGET_MPS,
    "ttc_min_s": (LEAST, 100.0),
    "dx_crash_m": (LEAST, 1000.0),
    "dx_critical_m": (0.0, 1000.0),
    "level0_a_mps2": (LEAST, 20.0),
    "level0_v_mps": _TARGET_MPS,
    "reach_m": (0.0, 5000.0),
    "v_start_max_mps": _SPEED_MPS,
    "lane_m": (-2000.0, 2000.0),
}
"""Lowest and highest possible number of each field: up to 360 km/h, 2 g and 5 km."""

V_VUT0_MPS = 18.0
"""Speed at which the paper's VUT starts."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Scenario:
    """A merge of the VUT, from the ramp, with the POV on the mainline.

    Example:
        >>> slow = dataclasses.replace(US23, name="slow", v_pov0_mps=(15.0, 25.0))
        >>> slow.dimensions(0)[1].high
        25.0

    Attributes:
        name: name of the scenario.
        net: path of the SUMO net; None for that of the paper's scenario.
        x_vut0_m: start of the VUT.
        v_vut0_mps: speed of the VUT at the start, which the tester observes and does not choose. A
            range makes it a coordinate of the pool.
        tau_s: reaction time with which a car of the mainline follows the car ahead (Krauss).
        min_gap_m: gap to the car ahead at standstill.
        pov_length_m: length of the cars of the mainline.
        vut_length_m: length of the VUT.
        a_min_mps2: hardest braking of all vehicles, negative.
        a_max_mps2: hardest acceleration of all vehicles.
        timeout_s: an episode that has not ended by then is a TIMEOUT.
        follow_up_s: duration of the simulation after M.
        v_hw_min_mps: lowest speed of the mainline.
        v_hw_max_mps: highest speed of the mainline.
        v_min_mps: below this the VUT is slow.
        ttc_min_s: a time to collision below this is short.
        dx_crash_m: front bumpers nearer than this collide under the paper's rule.
        dx_critical_m: front bumpers nearer than this are critical.
        level0_a_mps2: acceleration of a level-0 VUT (section VI-B).
        level0_v_mps: speed up to which a level-0 VUT accelerates, and which it holds.
        reach_m: maximum distance of a start before M.
        v_start_max_mps: maximum speed at the start.
        sense: sensing of other cars by the VUT.
        act: actuation of the VUT.
        mainline: ids of the edges of the mainline, in driving order, past M.
        ramp: ids of the edges of the ramp, in driving order, past M.
        x_pov0_m: range of the start of the POV.
        v_pov0_mps: range of the speed of the POV at the start.
        headway_ahead_s: range of the time headway of a car ahead of the POV: the distance of their
            front bumpers is the headway times the speed of both. None without traffic.
        headway_behind_s: range of the time headway of a car behind the POV; None without traffic.
        lane_m: begin and end of the acceleration lane, around M, where a merge is expected; None
            where M is the only place to merge.
        lane_end: effect of the end of that lane on a VUT that has not merged: "merge" moves it to
            the mainline, "stop" brakes it to a standstill before the end.

    Raises:
        UserError: a number is impossible, or numbers contradict each other.
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
        for name, possible in RANGES.items():
            if (value := getattr(self, name)) is not None:
                check_amount(name, value, possible)
        for name, fits, wanted in self._checks():
            if not fits:
                raise UserError(f"{name} is {getattr(self, name)}: choose {wanted}")

    def _checks(self) -> Iterator[tuple[str, bool, str]]:
        """Yield (field, whether it fits the others, values that fit)."""
        near = f"starts up to reach_m, {self.reach_m:g} m, before M"
        for name in ("x_pov0_m", "x_vut0_m"):
            yield name, -self.reach_m <= self.bounds(name)[0], near
        yield "headway_behind_s", self.farthest_start_m <= self.reach_m, near
        speeds = f"speeds up to v_start_max_mps, {self.v_start_max_mps:g}"
        for name in ("v_pov0_mps", "v_vut0_mps"):
            yield name, self.bounds(name)[1] <= self.v_start_max_mps, speeds
        has_both = (self.headway_ahead_s is None) == (self.headway_behind_s is None)
        yield "headway_behind_s", has_both, "both headways or neither"
        slowest_mps = self.v_pov0_mps[0]
        shortest_s = (self.pov_length_m + self.min_gap_m) / max(slowest_mps, 1e-9)
        apart = f"{shortest_s:.2f} or more, or cars overlap at {slowest_mps:g} m/s"
        for name in ("headway_ahead_s", "headway_behind_s"):
            headway_s = getattr(self, name)
            yield name, headway_s is None or shortest_s <= headway_s[0], apart
        begin_m, end_m = self.lane_m or (0.0, 1.0)
        around = "[begin, end] of the lane: begin from x_vut0_m to 0, end above 0"
        yield "lane_m", self.x_vut0_m <= begin_m <= 0.0 < end_m, around
        yield "v_hw_min_mps", self.v_hw_min_mps < self.v_hw_max_mps, "below v_hw_max_mps"
        yield "dx_crash_m", self.dx_crash_m <= self.dx_critical_m, "up to dx_critical_m"
        yield "level0_a_mps2", self.level0_a_mps2 <= self.a_max_mps2, "up to a_max_mps2"

    def to_record(self) -> dict[str, Any]:
        """Return the scenario for JSON: its fields, without perfect parts and an unused lane."""
        record = asdict(self) | {SENSE: self.sense.to_record(), ACT: self.act.to_record()}
        for name in (SENSE, ACT, "lane_m"):
            if not record[name]:
                del record[name]
        if self.lane_m is None:
            del record["lane_end"]
        return record

    @property
    def criterion(self) -> str:
        """Default criterion of a campaign; that of the paper does not know lanes."""
        return "paper" if self.lane_m is None else "unsafe"

    @property
    def goal(self) -> str:
        """Place in words that the VUT must reach before the timeout."""
        return "the merge point" if self.lane_m is None else "the mainline"

    @property
    def place(self) -> str:
        """Name of the place of the merge: M, or "the merge" on an acceleration lane."""
        return "M" if self.lane_m is None else "the merge"

    def wording(self, text: str) -> str:
        """Return a text with `place` for the word M.

        Args:
            text: a sentence about M.
        """
        return re.sub(r"\bM\b", self.place, text)

    def bounds(self, name: str) -> Bounds:
        """Return lowest and highest value of a number that may be a range.

        Args:
            name: field of the number.
        """
        value = getattr(self, name)
        return value if isinstance(value, tuple) else (value, value)

    @property
    def vehicles(self) -> int:
        """Number A of the vehicles of an episode, with the VUT."""
        return 2 if self.headway_ahead_s is None else len(VEHICLES)

    @property
    def lengths_m(self) -> tuple[float, float]:
        """Length of a car of the mainline, and of the VUT, in m."""
        return self.pov_length_m, self.vut_length_m

    @property
    def farthest_start_m(self) -> float:
        """Distance of the farthest start on the mainline to M, in m."""
        behind_s = 0.0 if self.headway_behind_s is None else self.headway_behind_s[1]
        return behind_s * self.v_pov0_mps[1] - self.x_pov0_m[0]

    @property
    def max_steps(self) -> int:
        """Number of steps until the timeout."""
        return round(self.timeout_s / DT_S)

    @property
    def room_after_m(self) -> float:
        """Length of the road after M that a POV may need until the timeout, in m."""
        far_m = self.v_start_max_mps * self.timeout_s + 0.5 * self.a_max_mps2 * self.timeout_s**2
        ahead_m = self.reach_m if self.vehicles > 2 else 0.0
        return max(far_m, ROOM_AFTER_M) + ahead_m

    def dimensions(self, level: int) -> tuple[Coordinate, ...]:
        """Return the coordinates of the pool at a level, with their bounds.

        Args:
            level: level of the POV. At level 2 the orientation is the last coordinate.
        """
        ranges = []
        for coordinate in COORDINATES:
            value = self._amount(coordinate)
            if isinstance(value, tuple):
                ranges.append(replace(coordinate, low=value[0], high=value[1]))
        return (*ranges, SVO) if level == 2 else tuple(ranges)

    @property
    def optional_fields(self) -> tuple[str, ...]:
        """Fields of a case for headways, and for the ranges of `sense` and `act`."""
        ranges = [c.field for c in OPTIONAL if isinstance(self._amount(c), tuple)]
        return tuple(ranges)

    def _amount(self, coordinate: Coordinate) -> Any:
        """Return the number or the range of a coordinate."""
        part, _, name = coordinate.field.partition("_")
        if part in (SENSE, ACT):
            return getattr(getattr(self, part), name)
        return getattr(self, coordinate.field)

    @property
    def case_fields(self) -> tuple[str, ...]:
        """Fields of a case that a record names, except its level."""
        own = ("x_pov0_m", "v_pov0_mps", "v_vut0_mps", "svo_rad")
        return (*own, *self.optional_fields)

    def has_ended(self, x_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether the VUT has passed M, or the end of the acceleration lane.

        Args:
            x_m: positions, (A, K).

        Returns:
            For each corridor, (K,).
        """
        end_m = 0.0 if self.lane_m is None else self.lane_m[1]
        arrived: NDArray[np.bool_] = x_m[VUT] >= end_m
        return arrived


US23 = Scenario()
"""Scenario of the paper."""


@dataclass(frozen=True, slots=True)
class Units:
    """Size of a scenario as multiples of the paper's.

    A learned driver measures in these units, so that similar merges look alike. Where lengths,
    speeds and accelerations are the same multiple of the paper's, its inputs are equal, to the last
    bit for a power of two.

    Attributes:
        length: distance of the VUT to M at the start.
        speed: speed of the VUT at M on the level-0 profile.
        time: time for that distance at that speed.
        gap: gap below which two vehicles collide.
        acceleration: hardest acceleration.
    """

    length: float
    speed: float
    time: float
    gap: float
    acceleration: float

    @classmethod
    def of(cls, scenario: Scenario) -> Self:
        """Return the units of a scenario.

        Args:
            scenario: the scenario.
        """
        length = scenario.x_vut0_m / US23.x_vut0_m
        speed = scenario.level0_v_mps / US23.level0_v_mps
        return cls(
            length=length,
            speed=speed,
            time=length / speed,
            gap=scenario.dx_crash_m / US23.dx_crash_m,
            acceleration=scenario.a_max_mps2 / US23.a_max_mps2,
        )
