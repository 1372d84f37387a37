"""A test case, and the pool that it is drawn from (Wang et al., section V-A).

A case is s = [x_POV0, v_POV0, psi, L]: where the POV starts, how fast, its social value
orientation, and its level of reasoning. The orientation exists only at level 2, so the pool is
three boxes: two-dimensional at levels 0 and 1, three-dimensional at level 2.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.errors import UserError
from merge_sumo.scenario import LEVELS, V_VUT0_MAX_MPS, V_VUT0_MPS

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Dimension:
    """One continuous coordinate of the pool: the name of a `Case` field and its bounds."""

    field: str
    low: float
    high: float


X_POV0: Final = Dimension("x_pov0_m", -340.0, -180.0)
V_POV0: Final = Dimension("v_pov0_mps", 25.0, 35.0)
SVO: Final = Dimension("svo_rad", 0.0, math.pi / 2)
"""psi in [0, pi/2): the upper end itself is outside the pool."""


def dimensions(level: int) -> tuple[Dimension, ...]:
    """Return the continuous coordinates of the pool at a level: two, or three at level 2."""
    return (X_POV0, V_POV0, SVO) if level == 2 else (X_POV0, V_POV0)


@dataclass(frozen=True, kw_only=True, slots=True)
class Case:
    """One test case; `svo_rad` is None below level 2.

    Raises `UserError` for values with which the scenario cannot be set up. Values outside the
    pool are allowed: a person may want to look at one.
    """

    level: int
    x_pov0_m: float
    v_pov0_mps: float
    svo_rad: float | None = None
    v_vut0_mps: float = V_VUT0_MPS

    def __post_init__(self) -> None:
        """Check that the numbers describe a scenario."""
        if self.level not in LEVELS:
            raise UserError(f"level is {self.level}: choose 0, 1 or 2")
        if (self.svo_rad is None) == (self.level == 2):
            raise UserError("svo_rad belongs to level 2, and only there: give it or leave it out")
        if not -900.0 <= self.x_pov0_m <= 0.0:
            raise UserError(f"x_pov0_m is {self.x_pov0_m}: choose between -900 and 0")
        if not 0.0 <= self.v_pov0_mps <= 45.0:
            raise UserError(f"v_pov0_mps is {self.v_pov0_mps}: choose between 0 and 45")
        if not 0.0 <= self.v_vut0_mps <= V_VUT0_MAX_MPS:
            raise UserError(
                f"v_vut0_mps is {self.v_vut0_mps}: choose between 0 and {V_VUT0_MAX_MPS:g}"
            )
        if self.svo_rad is not None and not 0.0 <= self.svo_rad < math.pi / 2:
            raise UserError(f"svo_rad is {self.svo_rad}: choose between 0 and below pi/2")


@dataclass(frozen=True, kw_only=True, slots=True)
class Pool:
    """The cases that a campaign may choose from: POV levels, and the VUT's observed speed."""

    levels: tuple[int, ...]
    v_vut0_mps: float = V_VUT0_MPS


def to_unit(cases: Iterable[Case], level: int) -> FloatArray:
    """Return the cases of one level as points, (n, d), with the pool's box as the unit cube."""
    dims = dimensions(level)
    rows = [[(getattr(case, d.field) - d.low) / (d.high - d.low) for d in dims] for case in cases]
    return np.array(rows, dtype=np.float64).reshape(len(rows), len(dims))


def from_unit(points: FloatArray, level: int, v_vut0_mps: float = V_VUT0_MPS) -> list[Case]:
    """Return the cases at points, (n, d), of the unit cube; the inverse of `to_unit`."""
    dims = dimensions(level)
    cases = []
    for row in points.tolist():
        values = {d.field: d.low + u * (d.high - d.low) for d, u in zip(dims, row, strict=True)}
        if level == 2:
            values["svo_rad"] = min(values["svo_rad"], math.nextafter(SVO.high, 0.0))
        cases.append(Case(level=level, v_vut0_mps=v_vut0_mps, **values))
    return cases
