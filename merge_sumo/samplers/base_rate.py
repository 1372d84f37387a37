"""Cases from anywhere in the place of picks that promise less, where predictions do not come true.

A controller may fail where neither its driving nor failures nearby foretell it. P(fail) of a pick
is then too large, and its worth below that of a case from anywhere in the pool. Two shares of past
outcomes say so: which share of the failures that the picks promised came, near failures known by
then and far from them; and which share of the cases of a space-filling sequence failed, the base
rate. The first batch of a level begins the sequence, and each case that stands in for a pick goes
on with it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from merge_sumo.metrics.prediction import Prediction
from merge_sumo.samplers.belief import is_far
from merge_sumo.samplers.candidates import spread_out
from merge_sumo.samplers.greedy import Proposal
from merge_sumo.samplers.history import LevelHistory
from merge_sumo.scenario.case import FloatArray

SAME: Final = 1e-6
"""Distance below which a case is a point of the sequence: rounding is below 1e-12."""
PRIOR_FAILURES: Final = 0.5
PRIOR_CASES: Final = 10.0
"""Failures and cases that the base rate begins with."""
OFFERED: Final = 4000
"""Points of another sequence, among which cases are chosen by the margin alone."""
LEAST_OF_SEQUENCE: Final = 0.25
"""Least share of the stand-ins that the sequence gives: only it comes everywhere."""
JUDGED: Final = 100
"""Last picks that are judged by."""


class BaseRate:
    """The base rate of failures at a level, and what the picks there were worth.

    Attributes:
        chance: base rate of failures.
        following: next points that stand in for picks, (n, d): of the sequence, and by the margin.
    """

    def __init__(
        self,
        history: LevelHistory,
        predictions: Sequence[Prediction | None],
        unknown: FloatArray,
        n: int,
        proposed: int,
        rng: np.random.Generator,
        by_margin: Callable[[FloatArray, int], FloatArray],
    ) -> None:
        """Judge by a history and what was predicted of each of its cases.

        Args:
            history: outcomes of the level.
            predictions: of each of them; None of a case without one.
            unknown: cases that run, or ended without a verdict, (m, d).
            n: points of the sequence that are wanted.
            proposed: number of cases proposed at the level.
            rng: generator with which the first batch of the level began the sequence.
            by_margin: chooses so many of some points by the margin alone.
        """
        self._history = history
        offered = spread_out(OFFERED, history.dims, np.random.default_rng([OFFERED, history.dims]))
        sequence = spread_out(proposed + n, history.dims, rng)
        distance, place = cKDTree(sequence).query(np.concatenate([history.points, unknown]))
        begun = int(place[distance < SAME].max(initial=-1)) + 1
        anywhere = distance[: len(history.points)] < SAME
        scored = cKDTree(offered).query(history.points)[0] < SAME
        chances = [
            (float(history.share[of].sum()) + PRIOR_FAILURES) / (float(of.sum()) + PRIOR_CASES)
            for of in (scored, anywhere)
        ]
        self.chance = max(chances)
        share = max(chances[1] / sum(chances), LEAST_OF_SEQUENCE)
        spread = int((anywhere & (history.batch > history.batch.min(initial=0))).sum())
        first = np.arange(1, n + 1)
        stood_in = spread + int(scored.sum()) + first
        wanted = np.clip((stood_in * share).astype(np.int64) - spread, 0, first)
        from_sequence = np.diff(wanted, prepend=0) > 0
        self.following = by_margin(offered, n)
        self.following[from_sequence] = sequence[begun : begun + int(from_sequence.sum())]
        anywhere |= scored
        said = np.array([np.nan if one is None else one.p_fail for one in predictions])
        picks = np.flatnonzero(~anywhere & ~np.isnan(said))[-JUDGED:]
        far = self._far_then(picks)
        promised = np.bincount(far, said[picks], minlength=2)
        failed = np.bincount(far, history.share[picks], minlength=2)
        self._credit = np.minimum((failed + 1.0) / (promised + 1.0), 1.0)

    def mixed(self, picks: Proposal, following: Proposal) -> Proposal:
        """Return picks with points of the sequence, which come last, in the place of worse ones."""
        far = is_far(picks.points, self._history.points[self._history.failed])
        gain = picks.gain * self._credit[far]
        kept = np.flatnonzero(gain > self.chance)
        rest = len(gain) - len(kept)
        return Proposal(
            np.concatenate([picks.points[kept], following.points[:rest]]),
            np.concatenate([gain[kept], np.full(rest, self.chance)]),
            np.concatenate([picks.probability[kept], following.probability[:rest]]),
            (*(picks.predictions[i] for i in kept.tolist()), *following.predictions[:rest]),
        )

    def _far_then(self, picks: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return for picks, (k,), 1 where no failure of an earlier batch was near, else 0."""
        points, batch, failed = self._history.points, self._history.batch, self._history.failed
        far = np.empty(len(picks), dtype=np.int64)
        for one in np.unique(batch[picks]):
            of = batch[picks] == one
            far[of] = is_far(points[picks[of]], points[failed & (batch < one)])
        return far
