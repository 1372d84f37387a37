"""A test case, and the pool that it is drawn from (Wang et al., section V-A).

A case is s = [x_POV0, v_POV0, psi, L]: where the POV starts, how fast, its social value
orientation, and its level of reasoning. The orientation exists only at level 2, so the pool is
three boxes: two-dimensional at levels 0 and 1, three-dimensional at level 2. Where a scenario has
traffic, or a range of the VUT's speed, these are further coordinates.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merge_sumo.errors import UserError
from merge_sumo.scenario.imperfection import (
    ACT,
    PERFECT_ACTUATION,
    PERFECT_SENSING,
    SENSE,
    Actuation,
    Sensing,
    with_numbers,
)
from merge_sumo.scenario.scenario import (
    ALL_LEVELS,
    IMPERFECTIONS,
    LEVELS,
    OWN,
    SVO,
    US23,
    V_VUT0_MPS,
    Coordinate,
    Scenario,
)

FloatArray = NDArray[np.float64]
_IMPERFECT_FIELDS = [coordinate.field for coordinate in IMPERFECTIONS]
_imperfections = attrgetter(*_IMPERFECT_FIELDS)
_NONE = (None,) * len(IMPERFECTIONS)
_PERFECT = (PERFECT_SENSING, PERFECT_ACTUATION)
MOST_DRAWS = 2**32
"""Draws of a case: their numbers have 4 bytes."""
MOST_SVO_RAD = math.nextafter(SVO.high, 0.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class Case:
    """One test case, a point of a scenario.

    Raises `UserError` for values with which the scenario cannot be set up. Values outside the
    pool are allowed.

    Attributes:
        level: level of the POV.
        svo_rad: its social value orientation; None below level 2.
        x_pov0_m: where it starts.
        v_pov0_mps: how fast.
        v_vut0_mps: speed of the VUT at the start.
        headway_ahead_s: time headway of the car ahead of the POV; None without traffic.
        headway_behind_s: that of the car behind it.
        draw: number of the draw of random values in its episode; not a coordinate of the pool.
        scenario: the scenario.

    The others are numbers for ranges of the scenario's `sense` and `act`; None where it has none.

    Example:
        >>> case = Case(level=0, x_pov0_m=-250.0, v_pov0_mps=30.0, scenario=US23)
        >>> case.starts()
        [(-250.0, 30.0), (-182.0, 18.0)]
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
        """Check that the numbers describe a scenario."""
        if self.level not in ALL_LEVELS:
            raise UserError(
                f"level is {self.level}: choose 0, 1 or 2, or {OWN} for a POV of your own"
            )
        if (self.svo_rad is None) == (self.level == 2):
            raise UserError("svo_rad belongs to level 2, and only there: give it or leave it out")
        reach_m, most_mps = self.scenario.reach_m, self.scenario.v_start_max_mps
        for name, value, low, high in (
            ("x_pov0_m", self.x_pov0_m, -reach_m, 0.0),
            ("v_pov0_mps", self.v_pov0_mps, 0.0, most_mps),
            ("v_vut0_mps", self.v_vut0_mps, 0.0, most_mps),
            ("svo_rad", self.svo_rad or 0.0, SVO.low, MOST_SVO_RAD),
            ("draw", self.draw, 0, MOST_DRAWS - 1),
        ):
            if not low <= value <= high:
                raise UserError(f"{name} is {value}: choose between {low:g} and {high:g}")
        self._check_imperfections()
        self._check_headways()

    def _check_headways(self) -> None:
        """Raise `UserError` where a car would start too far away or in another."""
        reach_m, least_m = self.scenario.reach_m, self.scenario.pov_length_m
        for name, side in (("headway_ahead_s", 1.0), ("headway_behind_s", -1.0)):
            headway_s = getattr(self, name)
            if (headway_s is not None) != (self.scenario.vehicles > 2):
                raise UserError(f"{name} belongs to traffic: give it there, and only there")
            if headway_s is None:
                continue
            apart_m = headway_s * self.v_pov0_mps
            if not (apart_m >= least_m and abs(self.x_pov0_m + side * apart_m) <= reach_m):
                raise UserError(
                    f"{name} is {headway_s}: the cars would be {apart_m:g} m apart; choose "
                    f"{least_m:g} m or more, and not more than {reach_m:g} m from M"
                )

    def starts(self) -> list[tuple[float, float]]:
        """Return position and speed of every vehicle at the start, in the order of their rows."""
        x, v = self.x_pov0_m, self.v_pov0_mps
        starts = [(x, v), (self.scenario.x_vut0_m, self.v_vut0_mps)]
        if self.headway_ahead_s is not None and self.headway_behind_s is not None:
            starts += [(x + self.headway_ahead_s * v, v), (x - self.headway_behind_s * v, v)]
        return starts

    @property
    def sensing(self) -> Sensing:
        """How the VUT senses other cars in this case, in numbers."""
        return with_numbers(self.scenario.sense, SENSE, self)

    @property
    def actuation(self) -> Actuation:
        """How it obeys its controller, in numbers."""
        return with_numbers(self.scenario.act, ACT, self)

    @property
    def start(self) -> Case:
        """The case at its first draw."""
        return self if self.draw == 0 else replace(self, draw=0)

    @property
    def seed(self) -> int:
        """The seed of all random numbers of its episode; it follows from the case."""
        return self._hashed((self.level, self.svo_rad, self.starts()))

    @property
    def controller_seed(self) -> int:
        """The seed for a controller, which knows neither level nor orientation."""
        return self._hashed([(float(x), float(v)) for x, v in self.starts()])

    def _hashed(self, known: object) -> int:
        """Return a number below 2**32, another one for each draw."""
        first = zlib.crc32(repr(known).encode())
        # A CRC continues from another one, and differs for different bytes of the same number.
        return first if self.draw == 0 else zlib.crc32(self.draw.to_bytes(4, "little"), first)

    def _check_imperfections(self) -> None:
        """Raise `UserError` where a number is missing for a range, or there without one."""
        given, scenario = _imperfections(self), self.scenario
        if given == _NONE and (scenario.sense, scenario.act) == _PERFECT:
            return
        wanted = scenario.imperfect_fields
        for name, value in zip(_IMPERFECT_FIELDS, given, strict=True):
            if (value is not None) != (name in wanted):
                raise UserError(f"{name} belongs to a range of the scenario: give it there alone")
        if wanted:
            # Checks the numbers.
            _ = self.sensing, self.actuation


@dataclass(frozen=True, kw_only=True, slots=True)
class ObservedCase(Case):
    """The part of a case that the driver of a vehicle knows: where vehicles start, and own limits.

    It is not checked: a sensor may show a car anywhere.
    """

    x_pov0_m: float = math.nan
    v_pov0_mps: float = math.nan
    told: tuple[tuple[float, float], ...]
    """Position and speed of every vehicle at the start, in the order of their rows."""

    def __post_init__(self) -> None:
        """Accept all numbers."""

    def starts(self) -> list[tuple[float, float]]:
        """Return position and speed of every vehicle at the start, in the order of their rows."""
        return list(self.told)


@dataclass(frozen=True, kw_only=True, slots=True)
class Pool:
    """The cases that a campaign may choose from: those of a scenario at POV levels."""

    levels: tuple[int, ...]
    scenario: Scenario

    def cases(self, points: FloatArray, level: int) -> list[Case]:
        """Return the cases at points, (n, d), of a level's unit cube."""
        return from_unit(points, level, scenario=self.scenario)


def to_unit(cases: Iterable[Case], level: int, scenario: Scenario = US23) -> FloatArray:
    """Return the cases of one level as points, (n, d), with the pool's box as the unit cube.

    Args:
        cases: the cases, of one scenario.
        level: the level of all of them.
        scenario: gives d where there are no cases.

    Returns:
        The points.
    """
    cases = list(cases)
    dims = (cases[0].scenario if cases else scenario).dimensions(level)
    points = np.empty((len(cases), len(dims)))
    for row, case in enumerate(cases):
        points[row] = [(getattr(case, d.field) - d.low) / (d.high - d.low) for d in dims]
    return points


def from_unit(points: FloatArray, level: int, *, scenario: Scenario) -> list[Case]:
    """Return the cases at points of the unit cube; the inverse of `to_unit`.

    Args:
        points: coordinates between 0 and 1, (n, d).
        level: the level of the cases.
        scenario: their scenario.
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
    """Return the coordinates that a scenario has at any of some levels, in the pool's order."""
    return max((scenario.dimensions(level) for level in levels), key=len)


def described(case: Case) -> str:
    """Return the coordinates of a case in one line."""
    texts = []
    for c in coordinates(case.scenario, (case.level,)):
        texts.append(f"{c.name} {c.text(case)} {c.unit}")
    return ", ".join(texts)


def outside_of_the_pool(case: Case) -> list[str]:
    """Return a sentence for each coordinate of a case that is outside of the pool."""
    sentences = []
    for c in coordinates(case.scenario, (case.level,)):
        value = c.of(case)
        if value is not None and not c.low <= value <= c.high:
            sentences.append(
                f"{c.name} {c.text(case)} {c.unit} is outside of the pool, {c.low:g} to {c.high:g} "
                f"{c.unit}: no campaign runs such a case"
            )
    return sentences
