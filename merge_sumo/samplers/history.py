"""The outcomes that a sampler learns from, as arrays."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merge_sumo.values.case import FloatArray
from merge_sumo.values.scenario import DX_CRASH_M


@dataclass(frozen=True, slots=True)
class LevelHistory:
    """The outcomes of one POV level: N cases with a verdict, in the order of their first run.

    A case that ran several times has one row. Its worst run gives its score and its gap, whatever
    is tolerated: so a surrogate learns where a case can fail, and from k of n how often it does.

    Attributes:
        points: cases in the unit cube, (N, d).
        score: P of the worst run, or its stand-in under another criterion than the paper's, (N,).
        failed: whether more than the tolerated share of the runs failed, (N,); for a single run,
            score < lambda.
        dx_m: signed gap at M in the worst run, (N,), or its stand-in under another criterion: a run
            fails within `limit_m`; NaN where the VUT never arrived or there is no trajectory.
        batch: batch of the campaign in which the case ran first, (N,).
        runs: number of runs of each case, (N,).
        failures: number of those that failed, (N,).
        variance: variance of the score over the runs of a case, (N,); NaN for a single run.
        varies: whether runs of a case have differed, at this level or another.
        tolerated: share of the runs of a case that may fail.
        limit_m: gap within which a run fails.
    """

    points: FloatArray
    score: FloatArray
    failed: NDArray[np.bool_]
    dx_m: FloatArray
    batch: NDArray[np.int64]
    runs: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    failures: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    variance: FloatArray = field(default_factory=lambda: np.empty(0, dtype=np.float64))
    varies: bool = False
    tolerated: float = 0.0
    limit_m: float = DX_CRASH_M

    def __post_init__(self) -> None:
        """Give each case a single run where nothing else is said."""
        single = {
            "runs": np.ones(len(self.points), dtype=np.int64),
            "failures": self.failed.astype(np.int64),
            "variance": np.full(len(self.points), np.nan),
        }
        for name, values in single.items():
            if len(getattr(self, name)) != len(self.points):
                object.__setattr__(self, name, values)

    @property
    def dims(self) -> int:
        """Return d, the number of coordinates."""
        return int(self.points.shape[1])

    @property
    def share(self) -> FloatArray:
        """Return the share of the runs of each case that failed, (N,)."""
        return np.asarray(self.failures / self.runs, dtype=np.float64)

    @property
    def ever_failed(self) -> NDArray[np.bool_]:
        """Return whether any run of a case failed, (N,)."""
        return self.failures > 0

    def then(self, later: LevelHistory) -> LevelHistory:
        """Return the outcomes with later ones after them."""
        if not len(later.points):
            return self
        rows: dict[str, Any] = {
            name: np.concatenate([values, getattr(later, name)])
            for name, values in self._rows().items()
        }
        rows["varies"] = self.varies or later.varies
        return replace(self, **rows)

    def take(self, places: slice | NDArray[np.int64]) -> LevelHistory:
        """Return some of the outcomes."""
        return replace(self, **{name: values[places] for name, values in self._rows().items()})

    def _rows(self) -> dict[str, Any]:
        """Return the fields with a row for each case, by name."""
        values = {one.name: getattr(self, one.name) for one in fields(self)}
        return {name: rows for name, rows in values.items() if isinstance(rows, np.ndarray)}
