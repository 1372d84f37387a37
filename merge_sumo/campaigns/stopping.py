"""When a search may stop by itself: nothing new is expected, and nothing new was found lately.

Only a sampler that can say what it expects of its next batch can be asked. What it expects is what
its surrogate knows: a region of failures that no case has come near is in no expectation. So the
rule saves cases; it proves nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final, Protocol, runtime_checkable

import numpy as np

from merge_sumo.errors import UserError
from merge_sumo.samplers.base import Sampler
from merge_sumo.samplers.registry import SAMPLERS
from merge_sumo.values.case import to_unit
from merge_sumo.values.chance import failing_cases
from merge_sumo.values.fmc import fmc
from merge_sumo.values.score import Outcome

PATIENCE: Final = 3
"""Batches in a row after which little must be expected: one may be luck."""


@runtime_checkable
class Foresighted(Protocol):
    """A sampler that says what it expects."""

    def expected_gain(self, n: int) -> float:
        """Return the expected new coverage of the next `n` cases as a share of that so far."""


class StoppingRule:
    """Ends a search when, after each of the last `PATIENCE` batches, little more was expected.

    Little is less than `share` of the coverage found so far, per batch. The batches that ran must
    bear it out: on average they added less than that, too. While no failure is known, the search
    goes on. A pure function of the outcomes, so that a resumed campaign ends where it would have
    ended; what was expected after a batch is worked out once and kept.
    """

    def __init__(
        self,
        share: float,
        batch: int | None,
        fresh: Callable[[], Sampler],
        *,
        tolerated: float = 0.0,
    ) -> None:
        """Stop below `share`; `fresh` makes a sampler that was told nothing.

        A case fails where more than the `tolerated` share of its runs do.

        Raises `UserError` for a share that is no share, or a sampler that expects nothing.
        """
        if not 0.0 < share < 1.0:
            raise UserError(
                f"--stop-after-converged is {share}: choose a share between 0 and 1, say 0.01"
            )
        if not isinstance(fresh(), Foresighted):
            able = [name for name, kind in SAMPLERS.items() if issubclass(kind, Foresighted)]
            raise UserError(
                "--stop-after-converged needs a sampler that says what it expects of its next "
                f"batch: choose --sampler {' or '.join(able)}"
            )
        self._share, self._batch, self._fresh = share, batch, fresh
        self._tolerated = tolerated
        self._expected: dict[int, float] = {}

    def __call__(self, outcomes: Sequence[Outcome]) -> bool:
        """Return whether the search is over after these outcomes, which have a verdict."""
        last = max((outcome.batch for outcome in outcomes), default=-1)
        if last + 1 <= PATIENCE:
            return False
        expected = (self.expected(outcomes, last - ago) for ago in range(PATIENCE))
        return all(gain < self._share for gain in expected) and (
            gained(outcomes, last - PATIENCE, self._tolerated) < PATIENCE * self._share
        )

    def expected(self, outcomes: Sequence[Outcome], batch: int) -> float:
        """Return the gain that was expected after a batch, as a share of the coverage by then."""
        if batch not in self._expected:
            sampler = self._fresh()
            sampler.tell([outcome for outcome in outcomes if outcome.batch <= batch])
            assert isinstance(sampler, Foresighted), "checked at the start"  # noqa: S101
            self._expected[batch] = sampler.expected_gain(self._batch or sampler.batch_size())
        return self._expected[batch]


def gained(outcomes: Sequence[Outcome], batch: int, tolerated: float = 0.0) -> float:
    """Return the coverage found after a batch as a share of that found up to it.

    Below 0 where cases that had failed turn out to be tolerated.
    """
    earlier = [outcome for outcome in outcomes if outcome.batch <= batch]
    before = covered_balls(earlier, tolerated)
    return covered_balls(outcomes, tolerated) / before - 1.0 if before > 0.0 else math.inf


def covered_balls(outcomes: Sequence[Outcome], tolerated: float = 0.0) -> float:
    """Return the coverage of all levels in balls: areas and volumes do not compare."""
    balls = 0.0
    cases = [one.case for one in failing_cases(outcomes, tolerated)]
    for level in {case.level for case in cases}:
        failing = to_unit((case for case in cases if case.level == level), level)
        balls += fmc(failing) / fmc(np.zeros((1, failing.shape[1])))
    return balls
