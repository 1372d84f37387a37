"""The outcomes that a sampler learns from, as arrays."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merge_sumo.scenario.case import FloatArray


def bounded(margin: FloatArray) -> FloatArray:
    """Return margins, (...), with the large ones compressed, so that a process can learn them.

    They keep their order and signs, are continuous with their slope, and within 2.5.
    """
    # Smaller margins stay as they are; the paper's are all smaller.
    linear = 1.25
    size = np.maximum(np.abs(margin), linear)
    compressed = np.sign(margin) * (2.0 * linear - linear**2 / size)
    return np.where(size > linear, compressed, margin)


@dataclass(frozen=True, slots=True)
class LevelHistory:
    """The outcomes of one POV level: N cases with a verdict, in the order of their first run.

    A case that ran several times has one row. Its worst run gives its score and its gap, whatever
    share is tolerated: a surrogate learns from it where a case can fail, and how often from
    `failures` and `runs`.

    Attributes:
        points: cases in the unit cube, (N, d).
        margin: bounded margin of the worst run, below 0 for a failure, (N,): see `bounded`.
        failed: whether more than the tolerated share of the runs failed, (N,).
        gap: signed gap of the worst run, (N,), which fails within 1: see `Outcome.signed_gap`; NaN
            where the VUT never arrived or there is no trajectory.
        batch: batch of the campaign in which the case ran first, (N,).
        runs: number of runs of each case, (N,).
        failures: number of runs that failed, (N,).
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
    def has_gaps(self) -> bool:
        """Return whether the VUT gives trajectories."""
        return not np.isnan(self.gap).all()


def most_informative(history: LevelHistory, most: int) -> LevelHistory:
    """Return at most `most` cases: half of them the worst ones, half spread over the rest."""
    if len(history.points) <= most:
        return history
    order = np.argsort(history.margin, kind="stable")
    half = most // 2
    rest = np.sort(order[half:])
    evenly = np.linspace(0, len(rest) - 1, half).round().astype(np.int64)
    chosen = np.sort(np.concatenate([order[:half], rest[evenly]]))
    columns: dict[str, Any] = {}
    for column in fields(history)[:-1]:
        columns[column.name] = getattr(history, column.name)[chosen]
    return replace(history, **columns)
