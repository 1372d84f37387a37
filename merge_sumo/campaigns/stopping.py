"""When a search may stop by itself: its last cases added little to what it had covered.

A region of failures that no case has come near is in no coverage, so the rule saves cases and
proves nothing. `python tools/bench_stopping.py` shows where it stops.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from merge_sumo.metrics.fmc import fmc
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.summary import failing_cases
from merge_sumo.scenario.case import to_unit

WINDOW: Final = 100
"""Cases of all levels together that are looked at."""
LITTLE: Final = 0.01
"""Growth of the coverage over the window below which it has converged."""


def has_converged(outcomes: Sequence[Outcome], tolerated: float = 0.0) -> bool:
    """Return whether the last cases added little to the coverage of all levels together.

    A pure function of the outcomes, in the order of their index, so that a resumed campaign ends
    where it would have ended. A search that knows no failure goes on. A case fails where more than
    the `tolerated` share of its runs do.
    """
    before = sum(coverage_by_level(outcomes[:-WINDOW], tolerated).values())
    return sum(coverage_by_level(outcomes, tolerated).values()) < (1.0 + LITTLE) * before


def coverage_by_level(outcomes: Sequence[Outcome], tolerated: float = 0.0) -> dict[int, float]:
    """Return the failure mode coverage of each level with failures."""
    cases = [one.case for one in failing_cases(outcomes, tolerated)]
    return {
        level: fmc(
            to_unit((case for case in cases if case.level == level), level, cases[0].scenario)
        )
        for level in {case.level for case in cases}
    }
