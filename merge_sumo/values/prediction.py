"""What was predicted of a case before it ran."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np

from merge_sumo.values.case import FloatArray

DIGITS: Final = 4
"""Decimals that are kept: what is decided by must be what is on disk."""


@dataclass(frozen=True, slots=True)
class Prediction:
    """The gaps at M that a twin of the VUT had in its games, and the chances of failing.

    Attributes:
        dx_m: signed gap at M by each member of each expert, (E, G); None where the VUT never
            arrived.
        p_twin: P(fail) that follows from these.
        p_surrogate: P(fail) by the surrogate, which learns the outcomes.
        p_fail: what was made of both.
    """

    dx_m: tuple[tuple[float | None, ...], ...]
    p_twin: float
    p_surrogate: float
    p_fail: float

    @classmethod
    def of(cls, dx_m: FloatArray, p_twin: float, p_surrogate: float, p_fail: float) -> Self:
        """Take gaps, (E, G), NaN where the VUT never arrived, and the chances."""
        rows = np.round(dx_m, DIGITS).tolist()
        gaps = tuple(tuple(None if math.isnan(x) else x for x in row) for row in rows)
        return cls(gaps, *(round(p, DIGITS) for p in (p_twin, p_surrogate, p_fail)))

    @property
    def gaps_m(self) -> FloatArray:
        """The gaps, (E, G); NaN where the VUT never arrived."""
        return np.array(self.dx_m, dtype=np.float64)

    @property
    def median_dx_m(self) -> float | None:
        """The gap in the middle of all members'; None where the VUT never arrives."""
        gaps = np.sort(np.nan_to_num(self.gaps_m.ravel(), nan=np.inf))
        middle = float(gaps[len(gaps) // 2])
        return middle if math.isfinite(middle) else None

    def to_record(self) -> dict[str, Any]:
        """Return it as JSON has it."""
        return {
            "dx_m": [list(row) for row in self.dx_m],
            "p_twin": self.p_twin,
            "p_surrogate": self.p_surrogate,
            "p_fail": self.p_fail,
        }

    @classmethod
    def from_record(cls, record: Any) -> Self:
        """Return what a record says; KeyError, TypeError or ValueError where it is none."""
        if not isinstance(record, dict) or set(record) != set(cls.__slots__):
            raise TypeError("what was predicted is a table of dx_m and three chances")
        gaps, chances = record["dx_m"], [record[name] for name in cls.__slots__[1:]]
        if not all(type(p) is float and 0.0 <= p <= 1.0 for p in chances):
            raise ValueError(f"chances are {chances}")
        rows = [tuple(row) for row in gaps]
        flat = [gap for row in rows for gap in row]
        if not flat or len({len(row) for row in rows}) != 1:
            raise ValueError("every expert predicts the same number of gaps")
        if not all(gap is None or (type(gap) is float and math.isfinite(gap)) for gap in flat):
            raise TypeError("a gap is a number or null")
        return cls(tuple(rows), *chances)
