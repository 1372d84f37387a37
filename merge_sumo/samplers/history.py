"""The outcomes of a level as arrays with one row for each case, which samplers learn from."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from merge_sumo.metrics.fmc import BoolArray, IntArray
from merge_sumo.scenario.case import FloatArray


@dataclass(frozen=True, slots=True)
class LevelHistory:
    """The N cases of one POV level without errors, in the order of their first run.

    A case that ran several times has one row, with the margin and the gap of its worst run. From
    these a surrogate learns where cases can fail. From `failures` and `runs` it learns how often.

    Example:
        ```python
        history = sampler.history(level=1)
        share = len(history.failing) / len(history.points)
        ```

    Attributes:
        points: cases in the unit cube, (N, d).
        margin: margin of the worst run, below 0 for a failure, (N,); large margins are compressed
            to at most 2.5 (`bounded`).
        failed: whether more than the tolerated share of the runs failed, (N,).
        gap: signed gap of the worst run, (N,); from -1 to 1 the run fails (`Outcome.signed_gap`).
            NaN if the VUT never arrived.
        batch: number of the batch in which the case ran first, (N,).
        runs: number of runs of each case, (N,).
        failures: number of runs that failed, (N,).
        variance: variance of the margin over the runs of a case, (N,); NaN for a single run.
        varies: whether the runs of any case differ, at any level.
    """

    points: FloatArray
    margin: FloatArray
    failed: BoolArray
    gap: FloatArray
    batch: IntArray
    runs: IntArray
    failures: IntArray
    variance: FloatArray
    varies: bool

    @property
    def dims(self) -> int:
        """Number of coordinates of a case, d."""
        return int(self.points.shape[1])

    @property
    def failing(self) -> FloatArray:
        """The points of the cases that failed, (m, d)."""
        return self.points[self.failed]

    def rows(self, chosen: IntArray) -> LevelHistory:
        """Return the history of some of the cases.

        Args:
            chosen: numbers of the rows, (m,).
        """
        arrays: dict[str, Any] = {}
        for field in fields(self):
            if field.name != "varies":  # the only field without a value for each case
                arrays[field.name] = getattr(self, field.name)[chosen]
        return replace(self, **arrays)


def bounded(margin: FloatArray) -> FloatArray:
    """Compress large margins, so that a Gaussian process can learn them.

    Margins keep their order and their signs. The function is continuous, and so is its slope:
    m where |m| <= 1.25, else sign(m) (2.5 - 1.25^2 / |m|).

    Args:
        margin: margins of any shape; infinite ones are allowed.

    Returns:
        Margins of the same shape, within -2.5 and 2.5. All margins of the paper are at most 1.25.

    Example:
        >>> bounded(np.array([-0.5, 2.5, np.inf]))
        array([-0.5  ,  1.875,  2.5  ])
    """
    linear = 1.25
    size = np.maximum(np.abs(margin), linear)  # no division by 0 where the margin stays as it is
    compressed = np.sign(margin) * (2.0 * linear - linear**2 / size)
    return np.where(size > linear, compressed, margin)


def most_informative(history: LevelHistory, most: int) -> LevelHistory:
    """Limit a history, so that learning from it takes a limited time.

    Args:
        history: the cases.
        most: largest number of cases.

    Returns:
        The history itself where it is short enough. Else half of `most` are the cases of the lowest
        margins, and half are spread evenly over the others, in the order of the history.
    """
    if len(history.points) <= most:
        return history
    half = most // 2
    worst_first = np.argsort(history.margin, kind="stable")
    worst, others = worst_first[:half], np.sort(worst_first[half:])
    evenly = np.linspace(0, len(others) - 1, half).round().astype(np.int64)
    return history.rows(np.sort(np.concatenate([worst, others[evenly]])))
