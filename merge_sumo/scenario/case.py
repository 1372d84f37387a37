"""Test cases, and the pool from which a campaign chooses them (Wang et al., section V-A).

The pool has one box for each level of the POV. Its coordinates are the numbers for which a scenario
has a range: x_POV0 and v_POV0, psi at level 2, and headways, speeds of the VUT and imperfections.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merge_sumo.errors import UserError
from merge_sumo.scenario.imperfection import ACT, SENSE, Actuation, Sensing, check_amount
from merge_sumo.scenario.scenario import (
    ALL_LEVELS,
    LEVELS,
    OPTIONAL,
    OWN,
    SVO,
    US23,
    V_VUT0_MPS,
    Coordinate,
    Scenario,
)

FloatArray = NDArray[np.float64]
MOST_DRAWS = 2**32
"""Maximum number of draws of a case: 4 bytes."""
MOST_SVO_RAD = math.nextafter(SVO.high, 0.0)
"""Largest orientation: pi/2 itself is not in the pool."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Case:
    """One case: a start of a scenario, in the pool or outside it.

    Attributes:
        level: POV level, 0 to 2; `OWN` for your own POV.
        svo_rad: psi, the social value orientation of the POV, in rad; None except at level 2.
        x_pov0_m: position of the POV at the start, in m; negative before M.
        v_pov0_mps: speed of the POV at the start, in m/s.
        v_vut0_mps: speed of the VUT at the start, in m/s.
        headway_ahead_s: time headway from the POV to the car ahead, in s; None without traffic.
        headway_behind_s: time headway from the car behind to the POV, in s; None without traffic.
        sense_delay_s: value of `delay_s` of the scenario's `sense`, if that is a range; else None.
            The other attributes `sense_...` and `act_...` follow the same rule.
        draw: number of the draw of random values. It is not a coordinate of the pool.
        scenario: the scenario.

    Raises:
        UserError: the scenario cannot start with these values.

    Example:
        ```pycon
        >>> case = Case(level=0, x_pov0_m=-250.0, v_pov0_mps=30.0, scenario=US23)
        >>> case.starts()
        [(-250.0, 30.0), (-182.0, 18.0)]
        ```
    """

    level: int
    svo_rad: float | None = None
    x_pov0_m: float
    v_pov0_mps: float
    v_vut0_mps: float = V_VUT0_MPS
    headway_ahead_s: float | None = None
    headway_behind_s: float | None = None
    sense_delay_s: float | None = None
    sense_noise_x_m: float | None = None
    sense_noise_v_mps: float | None = None
    sense_dropout: float | None = None
    sense_range_m: float | None = None
    sense_occluded_until_m: float | None = None
    act_lag_s: float | None = None
    act_delay_s: float | None = None
    act_power_w_per_kg: float | None = None
    draw: int = field(default=0, repr=False)
    scenario: Scenario = field(repr=False)

    def __post_init__(self) -> None:
        """Check that the scenario can start with these values."""
        if self.level not in ALL_LEVELS:
            raise UserError(
                f"level is {self.level}: choose 0, 1 or 2, or {OWN} for a POV of your own"
            )
        if (self.svo_rad is None) == (self.level == 2):
            raise UserError(
                "svo_rad is for level 2 only: set it at level 2, and remove it at other levels"
            )
        reach_m, most_mps = self.scenario.reach_m, self.scenario.v_start_max_mps
        for name, value, low, high in (
            ("x_pov0_m", self.x_pov0_m, -reach_m, 0.0),
            ("v_pov0_mps", self.v_pov0_mps, 0.0, most_mps),
            ("v_vut0_mps", self.v_vut0_mps, 0.0, most_mps),
            ("svo_rad", self.svo_rad or 0.0, SVO.low, MOST_SVO_RAD),
            ("draw", self.draw, 0, MOST_DRAWS - 1),
        ):
            check_amount(name, value, (low, high))
        self._check_ranges()
        self._check_headways()

    def _check_headways(self) -> None:
        """Raise `UserError` where a car would start too far away or in another."""
        reach_m, least_m = self.scenario.reach_m, self.scenario.pov_length_m
        for name, side in (("headway_ahead_s", 1.0), ("headway_behind_s", -1.0)):
            headway_s = getattr(self, name)
            if headway_s is None:
                continue
            apart_m = headway_s * self.v_pov0_mps
            if not (apart_m >= least_m and abs(self.x_pov0_m + side * apart_m) <= reach_m):
                raise UserError(
                    f"{name} is {headway_s}: the cars would be {apart_m:g} m apart; choose at "
                    f"least {least_m:g} m, and at most {reach_m:g} m from M"
                )

    def starts(self) -> list[tuple[float, float]]:
        """Return position in m and speed in m/s of each vehicle, in the order of `VEHICLES`."""
        x, v = self.x_pov0_m, self.v_pov0_mps
        starts = [(x, v), (self.scenario.x_vut0_m, self.v_vut0_mps)]
        if self.headway_ahead_s is not None and self.headway_behind_s is not None:
            starts += [(x + self.headway_ahead_s * v, v), (x - self.headway_behind_s * v, v)]
        return starts

    @property
    def sensing(self) -> Sensing:
        """The sensing of the VUT in this case, with numbers in the place of ranges."""
        return self.scenario.sense.in_case(self, SENSE)

    @property
    def actuation(self) -> Actuation:
        """The actuation of the VUT in this case, with numbers in the place of ranges."""
        return self.scenario.act.in_case(self, ACT)

    @property
    def start(self) -> Case:
        """The same case with draw 0."""
        return self if self.draw == 0 else replace(self, draw=0)

    @property
    def seed(self) -> int:
        """Seed of all random numbers of the episode, below 2**32."""
        return self._hashed((self.level, self.svo_rad, self.starts()))

    @property
    def controller_seed(self) -> int:
        """Seed for the controller, below 2**32; it does not reveal level and psi of the POV."""
        return self._hashed([(float(x), float(v)) for x, v in self.starts()])

    def _hashed(self, known: object) -> int:
        """Return a hash below 2**32 that differs for each draw."""
        first = zlib.crc32(repr(known).encode())
        # A CRC continues from another one, and differs for different bytes of the same number.
        return first if self.draw == 0 else zlib.crc32(self.draw.to_bytes(4, "little"), first)

    def _check_ranges(self) -> None:
        """Raise `UserError` where a range has no number, or a number no range."""
        ranges = self.scenario.optional_fields
        for coordinate in OPTIONAL:
            if (coordinate.of(self) is not None) != (coordinate.field in ranges):
                raise UserError(
                    f"{coordinate.field}: set it if the scenario has a range of it, and only then"
                )
        if ranges:
            # They are made of the numbers of the case, which may be impossible.
            _ = self.sensing, self.actuation


@dataclass(frozen=True, kw_only=True, slots=True)
class ObservedCase(Case):
    """The part of a case that the driver of a vehicle knows, for `Driver.begin`.

    Attributes:
        observed: position in m and speed in m/s of each vehicle at the start, in the order of
            `VEHICLES`.
    """

    x_pov0_m: float = math.nan
    v_pov0_mps: float = math.nan
    observed: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        """Accept all numbers: a sensor may show a car anywhere."""

    def starts(self) -> list[tuple[float, float]]:
        """Return position in m and speed in m/s of each vehicle, in the order of `VEHICLES`."""
        return list(self.observed)


@dataclass(frozen=True, kw_only=True, slots=True)
class Pool:
    """All possible starts, from which a campaign chooses its cases.

    Attributes:
        levels: POV levels.
        scenario: scenario of all cases.

    Example:
        ```pycon
        >>> pool = Pool(levels=(0,), scenario=US23)
        >>> pool.cases(np.array([[0.5, 0.5]]), 0)[0].x_pov0_m
        -260.0
        ```
    """

    levels: tuple[int, ...]
    scenario: Scenario

    def cases(self, points: FloatArray, level: int) -> list[Case]:
        """Return the cases at points of the unit cube of a level.

        Args:
            points: coordinates between 0 and 1, (n, d).
            level: POV level of the cases.
        """
        return from_unit(points, level, scenario=self.scenario)


def to_unit(cases: Iterable[Case], level: int, scenario: Scenario = US23) -> FloatArray:
    """Return cases as points of the unit cube of a level.

    Args:
        cases: cases of one scenario and of the level.
        level: level of the cases.
        scenario: scenario that gives d where `cases` is empty.

    Returns:
        Coordinates, (n, d): between 0 and 1 in the pool.
    """
    cases = list(cases)
    dims = (cases[0].scenario if cases else scenario).dimensions(level)
    points = np.empty((len(cases), len(dims)))
    for row, case in enumerate(cases):
        points[row] = [(getattr(case, d.field) - d.low) / (d.high - d.low) for d in dims]
    return points


def from_unit(points: FloatArray, level: int, *, scenario: Scenario) -> list[Case]:
    """Return the cases at points of the unit cube of a level: the inverse of `to_unit`.

    Args:
        points: coordinates between 0 and 1, (n, d).
        level: level of the cases.
        scenario: scenario of the cases.
    """
    dims = scenario.dimensions(level)
    v_vut0_mps, _ = scenario.bounds("v_vut0_mps")
    cases = []
    for row in points.tolist():
        values: dict[str, Any] = {"v_vut0_mps": v_vut0_mps}
        values |= {d.field: d.low + u * (d.high - d.low) for d, u in zip(dims, row, strict=True)}
        if level == 2:
            values["svo_rad"] = min(values["svo_rad"], MOST_SVO_RAD)
        cases.append(Case(level=level, scenario=scenario, **values))
    return cases


def coordinates(scenario: Scenario, levels: Sequence[int] = LEVELS) -> tuple[Coordinate, ...]:
    """Return the coordinates that a scenario has at any of some levels.

    Args:
        scenario: the scenario.
        levels: levels of the POV.
    """
    return max((scenario.dimensions(level) for level in levels), key=len)


def described(case: Case) -> str:
    """Return the coordinates of a case in one line.

    Args:
        case: the case.

    Example:
        >>> described(Case(level=0, x_pov0_m=-250.0, v_pov0_mps=30.0, scenario=US23))
        'x_POV0 -250.0 m, v_POV0 30.00 m/s'
    """
    texts = []
    for c in case.scenario.dimensions(case.level):
        texts.append(f"{c.name} {c.text(case)} {c.unit}")
    return ", ".join(texts)
