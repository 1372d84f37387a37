"""The outcomes that a sampler learns from, as arrays."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.scenario.case import FloatArray

LINEAR: Final = 1.25
"""Size up to which a margin is learned as it is; the paper's are all within."""


def bounded(margin: FloatArray) -> FloatArray:
    """Return margins, (...), with the large ones drawn in: what a process on them can learn.

    In the same order and with the same signs, continuous with its slope, and within 2.5.
    """
    size = np.maximum(np.abs(margin), LINEAR)
    drawn_in = np.sign(margin) * (2.0 * LINEAR - LINEAR**2 / size)
    return np.asarray(np.where(size > LINEAR, drawn_in, margin), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class LevelHistory:
    """The outcomes of one POV level: N cases with a verdict, in the order of their first run.

    A case that ran several times has one row. Its worst run gives its score and its gap, whatever
    is tolerated: so a surrogate learns where a case can fail, and from k of n how often it does.

    Attributes:
        points: cases in the unit cube, (N, d).
        margin: bounded margin of the worst run, below 0 for a failure, (N,): see `bounded`.
        failed: whether more than the tolerated share of the runs failed, (N,).
        gap: signed gap of the worst run, (N,), which fails within 1: see `Outcome.signed_gap`; NaN
            where the VUT never arrived or there is no trajectory.
        batch: batch of the campaign in which the case ran first, (N,).
        runs: number of runs of each case, (N,).
        failures: number of those that failed, (N,).
        variance: variance of the margin over the runs of a case, (N,); NaN for a single run.
        varies: whether runs of a case have differed, at this level or another.
        tolerated: share of the runs of a case that may fail.
    """

    points: FloatArray
    margin: FloatArray
    failed: NDArray[np.bool_]
    gap: FloatArray
    batch: NDArray[np.int64]
    runs: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    failures: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    variance: FloatArray = field(default_factory=lambda: np.empty(0, dtype=np.float64))
    varies: bool = False
    tolerated: float = 0.0

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
    def badness(self) -> FloatArray:
        """Return how bad each case is, (N,): above 1 for a failure; P / lambda in the paper."""
        return np.asarray(1.0 - self.margin, dtype=np.float64)

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
