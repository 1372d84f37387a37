"""The outcomes that a sampler learns from, as arrays."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
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
    """

    points: FloatArray
    margin: FloatArray
    failed: NDArray[np.bool_]
    gap: FloatArray
    batch: NDArray[np.int64]
    runs: NDArray[np.int64]
    failures: NDArray[np.int64]
    variance: FloatArray
    varies: bool

    @property
    def dims(self) -> int:
        """Return d, the number of coordinates."""
        return int(self.points.shape[1])

    @property
    def badness(self) -> FloatArray:
        """Return how bad each case is, (N,): above 1 for a failure; P / lambda in the paper."""
        return np.asarray(1.0 - self.margin, dtype=np.float64)

    @property
    def has_gaps(self) -> bool:
        """Return whether the VUT gives trajectories."""
        return not np.isnan(self.gap).all()

    @property
    def ever_failed(self) -> NDArray[np.bool_]:
        """Return whether any run of a case failed, (N,)."""
        return self.failures > 0

    def take(self, places: slice | NDArray[np.int64]) -> LevelHistory:
        """Return some of the outcomes."""
        chosen: dict[str, Any] = {}
        for column in fields(self):
            values = getattr(self, column.name)
            if isinstance(values, np.ndarray):
                chosen[column.name] = values[places]
        return replace(self, **chosen)


def most_informative(history: LevelHistory, most: int) -> LevelHistory:
    """Return at most `most` cases: half of them the worst ones, half spread over the rest."""
    if len(history.points) <= most:
        return history
    order = np.argsort(history.margin, kind="stable")
    half = most // 2
    rest = np.sort(order[half:])
    evenly = np.linspace(0, len(rest) - 1, half).round().astype(np.int64)
    return history.take(np.sort(np.concatenate([order[:half], rest[evenly]])))
