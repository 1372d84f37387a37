"""A test case, and the pool that it is drawn from (Wang et al., section V-A).

`Case` is what every kind of scenario has. A case of a merge is s = [x_POV0, v_POV0, psi, L]: where
the POV starts, how fast, its social value orientation, and its level of reasoning. The orientation
exists only at level 2, so the pool is three boxes: two-dimensional at levels 0 and 1,
three-dimensional at level 2. Where a scenario has traffic, or a range of the VUT's speed, these are
further coordinates.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final

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
    AHEAD,
    ALL_LEVELS,
    BEHIND,
    COORDINATES,
    OWN,
    POV,
    SVO,
    US23,
    V_VUT0_MPS,
    VUT,
    MergeScenario,
    Scenario,
)

FloatArray = NDArray[np.float64]
_IMPERFECTIONS: Final = attrgetter(*COORDINATES)
_NONE: Final = (None,) * len(COORDINATES)
_PERFECT: Final = (PERFECT_SENSING, PERFECT_ACTUATION)
MOST_DRAWS: Final = 2**32
"""Draws of a case: their numbers have 4 bytes."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Case:
    """One test case, a point of a scenario; a kind of scenario has a subclass with its coordinates.

    Raises `UserError` for values with which the scenario cannot be set up. Values outside the
    pool are allowed: a person may want to look at one.

    Attributes:
        level: level of the POV.
        svo_rad: its social value orientation; None below level 2.
        v_vut0_mps: speed of the VUT at the start.
        draw: which draw of what is random in its episode; no coordinate of the pool.
        scenario: the scenario.

    The others are numbers for ranges of the scenario's `sense` and `act`; None where it has none.
    """

    level: int
    svo_rad: float | None = None
    v_vut0_mps: float = V_VUT0_MPS
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

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Coordinates of a kind are fields of its own `Case`."""

    def __post_init__(self) -> None:
        """Check that the numbers describe a scenario."""
        if self.level not in ALL_LEVELS:
            raise UserError(
                f"level is {self.level}: choose 0, 1 or 2, or {OWN} for a POV of your own"
            )
        if (self.svo_rad is None) == (self.level == 2):
            raise UserError("svo_rad belongs to level 2, and only there: give it or leave it out")
        self._check_coordinates()
        if not 0 <= self.draw < MOST_DRAWS:
            raise UserError(f"draw is {self.draw}: choose 0 or more, and less than {MOST_DRAWS}")
        if self.svo_rad is not None and not 0.0 <= self.svo_rad < math.pi / 2:
            raise UserError(f"svo_rad is {self.svo_rad}: choose between 0 and below pi/2")

    def _check_coordinates(self) -> None:
        """Raise `UserError` where a coordinate of the kind does not describe a scenario."""
        raise NotImplementedError

    def _check_speed(self, name: str) -> None:
        most_mps = self.scenario.v_start_max_mps
        if not 0.0 <= getattr(self, name) <= most_mps:
            raise UserError(f"{name} is {getattr(self, name)}: choose between 0 and {most_mps:g}")

    def starts(self) -> list[tuple[float, float]]:
        """Return position and speed of every vehicle at the start, in the order of their rows."""
        raise NotImplementedError

    @property
    def level0_pov_mps2(self) -> float:
        """Acceleration of a level-0 POV, which it keeps whatever the VUT does."""
        return 0.0

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
        """The case at its first draw: what its runs have in common."""
        return self if self.draw == 0 else replace(self, draw=0)

    @property
    def seed(self) -> int:
        """A number that the case alone decides: seeds what is drawn at random in its episode."""
        return self._hashed((self.level, self.svo_rad, self.starts()))

    @property
    def told_seed(self) -> int:
        """The same for a controller, by what it is told: neither level nor orientation decide."""
        return self._hashed([(float(x), float(v)) for x, v in self.starts()])

    def _hashed(self, known: object) -> int:
        """Return a number below 2**32 for each draw, other than those of further draws."""
        first = zlib.crc32(repr(known).encode())
        # A CRC goes on from another one, and differs for different bytes of the same number.
        return first if self.draw == 0 else zlib.crc32(self.draw.to_bytes(4, "little"), first)

    def _check_imperfections(self) -> None:
        """Raise `UserError` where a number is missing for a range, or there without one."""
        given, scenario = _IMPERFECTIONS(self), self.scenario
        if given == _NONE and (scenario.sense, scenario.act) == _PERFECT:
            return
        wanted = scenario.imperfect_fields
        for name, value in zip(COORDINATES, given, strict=True):
            if (value is not None) != (name in wanted):
                raise UserError(f"{name} belongs to a range of the scenario: give it there alone")
        if wanted:
            # Checks the numbers.
            _ = self.sensing, self.actuation


@dataclass(frozen=True, kw_only=True, slots=True)
class MergeCase(Case):
    """A case of a merge: start and speed of the POV and, in traffic, headways to its neighbours."""

    x_pov0_m: float
    v_pov0_mps: float
    headway_ahead_s: float | None = None
    headway_behind_s: float | None = None

    def _check_coordinates(self) -> None:
        """Raise `UserError` where a vehicle would start too far away, too fast or in another."""
        reach_m = self.scenario.reach_m
        if not -reach_m <= self.x_pov0_m <= 0.0:
            raise UserError(f"x_pov0_m is {self.x_pov0_m}: choose between {-reach_m:g} and 0")
        self._check_speed("v_pov0_mps")
        self._check_speed("v_vut0_mps")
        self._check_imperfections()
        in_traffic = self.scenario.vehicles > 2
        for name in ("headway_ahead_s", "headway_behind_s"):
            headway_s = getattr(self, name)
            if (headway_s is not None) != in_traffic:
                raise UserError(f"{name} belongs to traffic: give it there, and only there")
            if headway_s is None:
                continue
            apart_m, least_m = headway_s * self.v_pov0_mps, self.scenario.pov_length_m
            ahead_m = apart_m if name == "headway_ahead_s" else -apart_m
            if not (apart_m >= least_m and abs(self.x_pov0_m + ahead_m) <= reach_m):
                raise UserError(
                    f"{name} is {headway_s}: the cars would be {apart_m:g} m apart; choose "
                    f"{least_m:g} m or more, and not more than {reach_m:g} m from M"
                )

    def starts(self) -> list[tuple[float, float]]:
        """Return position and speed of every vehicle at the start, in the order of their rows."""
        x, v = self.x_pov0_m, self.v_pov0_mps
        rows = {POV: (x, v), VUT: (self.scenario.x_vut0_m, self.v_vut0_mps)}
        if self.headway_ahead_s is not None and self.headway_behind_s is not None:
            rows[AHEAD] = x + self.headway_ahead_s * v, v
            rows[BEHIND] = x - self.headway_behind_s * v, v
        return [rows[row] for row in range(len(rows))]


MergeScenario.case_type = MergeCase


@dataclass(frozen=True, kw_only=True, slots=True)
class ToldCase(Case):
    """What the driver of a vehicle may know of a case: where vehicles start, and own limits."""

    told: tuple[tuple[float, float], ...]
    """Position and speed of every vehicle at the start, in the order of their rows."""

    def _check_coordinates(self) -> None:
        """Accept all: the case was checked where it was made."""

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

    Where there are no cases, d is that of the scenario.
    """
    rows, known, dims = [], scenario, scenario.dimensions(level)
    for case in cases:
        if case.scenario is not known:
            known, dims = case.scenario, case.scenario.dimensions(level)
        rows.append([(getattr(case, d.field) - d.low) / (d.high - d.low) for d in dims])
    return np.array(rows, dtype=np.float64) if rows else np.empty((0, len(dims)))


def from_unit(points: FloatArray, level: int, *, scenario: Scenario) -> list[Case]:
    """Return the cases at points, (n, d), of the unit cube; the inverse of `to_unit`."""
    dims = scenario.dimensions(level)
    v_vut0_mps, _ = scenario.bounds("v_vut0_mps")
    cases = []
    for row in points.tolist():
        values = {"v_vut0_mps": v_vut0_mps}
        values |= {d.field: d.low + u * (d.high - d.low) for d, u in zip(dims, row, strict=True)}
        if level == 2:
            values["svo_rad"] = min(values["svo_rad"], math.nextafter(SVO.high, 0.0))
        cases.append(scenario.case_type(level=level, scenario=scenario, **values))
    return cases
