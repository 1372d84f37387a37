"""A test case, and the pool that it is drawn from (Wang et al., section V-A).

A case is s = [x_POV0, v_POV0, psi, L]: where the POV starts, how fast, its social value
orientation, and its level of reasoning. The orientation exists only at level 2, so the pool is
three boxes: two-dimensional at levels 0 and 1, three-dimensional at level 2.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.errors import UserError
from merge_sumo.values.scenario import LEVELS, SVO, US23, Dimension, Scenario

FloatArray = NDArray[np.float64]


X_POV0, V_POV0 = US23.dimensions(0)


def dimensions(level: int, scenario: Scenario = US23) -> tuple[Dimension, ...]:
    """Return the continuous coordinates of the pool at a level: two, or three at level 2."""
    return scenario.dimensions(level)


@dataclass(frozen=True, kw_only=True, slots=True)
class Case:
    """One test case, a point of a scenario; `svo_rad` is None below level 2.

    Raises `UserError` for values with which the scenario cannot be set up. Values outside the
    pool are allowed: a person may want to look at one.
    """

    level: int
    x_pov0_m: float
    v_pov0_mps: float
    svo_rad: float | None = None
    v_vut0_mps: float = US23.v_vut0_mps
    scenario: Scenario = field(default=US23, repr=False)

    def __post_init__(self) -> None:
        """Check that the numbers describe a scenario."""
        if self.level not in LEVELS:
            raise UserError(f"level is {self.level}: choose 0, 1 or 2")
        if (self.svo_rad is None) == (self.level == 2):
            raise UserError("svo_rad belongs to level 2, and only there: give it or leave it out")
        reach_m, most_mps = self.scenario.reach_m, self.scenario.v_start_max_mps
        if not -reach_m <= self.x_pov0_m <= 0.0:
            raise UserError(f"x_pov0_m is {self.x_pov0_m}: choose between {-reach_m:g} and 0")
        for name in ("v_pov0_mps", "v_vut0_mps"):
            if not 0.0 <= getattr(self, name) <= most_mps:
                raise UserError(
                    f"{name} is {getattr(self, name)}: choose between 0 and {most_mps:g}"
                )
        if self.svo_rad is not None and not 0.0 <= self.svo_rad < math.pi / 2:
            raise UserError(f"svo_rad is {self.svo_rad}: choose between 0 and below pi/2")


COORDINATES: Final = ("level", "x_pov0_m", "v_pov0_mps", "svo_rad", "v_vut0_mps")
"""Fields of a case that its record has; the scenario is that of its campaign."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Pool:
    """The cases that a campaign may choose from: POV levels, and the VUT's observed speed."""

    levels: tuple[int, ...]
    v_vut0_mps: float = US23.v_vut0_mps
    scenario: Scenario = US23

    def cases(self, points: FloatArray, level: int) -> list[Case]:
        """Return the cases at points, (n, d), of a level's unit cube."""
        return from_unit(points, level, self.v_vut0_mps, self.scenario)


def to_unit(cases: Iterable[Case], level: int) -> FloatArray:
    """Return the cases of one level as points, (n, d), with the pool's box as the unit cube."""
    rows = []
    for case in cases:
        dims = case.scenario.dimensions(level)
        rows.append([(getattr(case, d.field) - d.low) / (d.high - d.low) for d in dims])
    return np.array(rows, dtype=np.float64).reshape(len(rows), len(dimensions(level)))


def from_unit(
    points: FloatArray,
    level: int,
    v_vut0_mps: float = US23.v_vut0_mps,
    scenario: Scenario = US23,
) -> list[Case]:
    """Return the cases at points, (n, d), of the unit cube; the inverse of `to_unit`."""
    dims = scenario.dimensions(level)
    cases = []
    for row in points.tolist():
        values = {d.field: d.low + u * (d.high - d.low) for d, u in zip(dims, row, strict=True)}
        if level == 2:
            values["svo_rad"] = min(values["svo_rad"], math.nextafter(SVO.high, 0.0))
        cases.append(Case(level=level, v_vut0_mps=v_vut0_mps, scenario=scenario, **values))
    return cases
