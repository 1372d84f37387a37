"""A campaign in a few numbers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from merge_sumo.values.case import to_unit
from merge_sumo.values.empty_ball import EmptyBall, largest_empty_ball
from merge_sumo.values.fmc import fmc, regions
from merge_sumo.values.score import Outcome
from merge_sumo.values.trajectory import End


@dataclass(frozen=True, slots=True)
class LevelSummary:
    """What was found at one POV level.

    Attributes:
        cases: cases that ran.
        tested: cases in which the VUT reached the merge point.
        failures: cases with P < -500.
        fmc: failure mode coverage, M(s, 0.05, -500), in the level's unit cube.
        regions: groups of failures that are linked at a distance of 0.05.
        unseen: the largest ball of the level's unit cube that no case has entered, but for those
            that ended in an error; None without cases.
    """

    cases: int
    tested: int
    failures: int
    fmc: float
    regions: int
    unseen: EmptyBall | None = None


@dataclass(frozen=True, slots=True)
class Summary:
    """What was found in all: totals, ends of episodes by name, and each level."""

    cases: int
    failures: int
    ends: dict[str, int]
    levels: dict[int, LevelSummary]


def summarise(outcomes: Sequence[Outcome], levels: Sequence[int]) -> Summary:
    """Return the summary of outcomes, at the given levels and where else there are any."""
    every = sorted({*levels, *(outcome.case.level for outcome in outcomes)})
    ends = Counter(outcome.measures.end for outcome in outcomes)
    return Summary(
        cases=len(outcomes),
        failures=sum(outcome.failed for outcome in outcomes),
        ends={end.value: ends[end] for end in End if ends[end]},
        levels={level: _level(outcomes, level) for level in every},
    )


def _level(outcomes: Sequence[Outcome], level: int) -> LevelSummary:
    at_level = [outcome for outcome in outcomes if outcome.case.level == level]
    seen = to_unit((o.case for o in at_level if not o.measures.end.is_error), level)
    points = to_unit((outcome.case for outcome in at_level if outcome.failed), level)
    return LevelSummary(
        cases=len(at_level),
        tested=sum(outcome.is_tested for outcome in at_level),
        failures=len(points),
        fmc=fmc(points),
        regions=int(regions(points).max(initial=-1)) + 1,
        unseen=largest_empty_ball(seen),
    )
