"""What was predicted of a case before it ran."""

from __future__ import annotations

import math
from typing import Annotated, Final, Self

import numpy as np
from msgspec import Meta

from merge_sumo.errors import UserError
from merge_sumo.records import Record
from merge_sumo.scenario.case import FloatArray

NO_GAP: Final = 100.0 / 3.0
"""Gap of a VUT that never arrives, in units of the limit: another car goes first, far away."""
DIGITS: Final = 4
"""Decimals that are kept: what is decided by must be what is on disk."""


Chance = Annotated[float, Meta(ge=0.0, le=1.0)]


class Prediction(Record, frozen=True):
    """The gaps at M that a model of the controller had in its rollouts, and P(fail).

    Attributes:
        dx_m: signed gaps at M by the members of the ensemble, (E, G); None where the VUT never
            arrived.
        p_twin: P(fail) that follows from these.
        p_surrogate: P(fail) by the surrogate, which learns the outcomes.
        p_fail: what was made of both.
    """

    dx_m: tuple[tuple[float | None, ...], ...]
    p_twin: Chance
    p_surrogate: Chance
    p_fail: Chance

    @classmethod
    def of(cls, dx_m: FloatArray, p_twin: float, p_surrogate: float, p_fail: float) -> Self:
        """Take gaps, (E, G), NaN where the VUT never arrived, and the chances."""
        rows = np.round(dx_m, DIGITS).tolist()
        gaps = tuple(tuple(None if math.isnan(x) else x for x in row) for row in rows)
        return cls(gaps, *(round(float(p), DIGITS) for p in (p_twin, p_surrogate, p_fail)))

    @property
    def gaps_m(self) -> FloatArray:
        """The gaps, (E, G); NaN where the VUT never arrived."""
        return np.array(self.dx_m, dtype=np.float64)

    def __post_init__(self) -> None:
        """Raise `UserError` unless every expert has the same number of gaps, one or more."""
        if not self.dx_m or len({len(row) for row in self.dx_m}) != 1 or not self.dx_m[0]:
            raise UserError("dx_m must have the same number of gaps, 1 or more, for every expert")
