"""A campaign in a few numbers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from merge_sumo.metrics.chance import one_per_case, undecided
from merge_sumo.metrics.fmc import fmc, regions
from merge_sumo.metrics.score import Outcome
from merge_sumo.metrics.severity import Severity
from merge_sumo.scenario.case import to_unit
from merge_sumo.scenario.trajectory import End


@dataclass(frozen=True, slots=True)
class LevelSummary:
    """The findings at one POV level.

    Attributes:
        cases: cases that ran.
        tested: cases in which the VUT reached the merge point.
        failures: cases that fail under the criterion, but for those that are undecided.
        severities: cases by severity, those that occur.
        fmc: failure mode coverage of failing cases, undecided or not, in the level's unit cube;
            M(s, 0.05, -500) under the paper's criterion and in up to three coordinates.
        regions: groups of these that are linked at the radius of FMC.
        undecided: failing cases that ran too seldom to tell: see `chance.undecided`.
    """

    cases: int
    tested: int
    failures: int
    severities: dict[str, int]
    fmc: float
    regions: int
    undecided: int = 0


@dataclass(frozen=True, slots=True)
class Summary:
    """The findings of a campaign: totals, ends and severities by name, and each level."""

    cases: int
    failures: int
    ends: dict[str, int]
    severities: dict[str, int]
    levels: dict[int, LevelSummary]
    undecided: int = 0


def summarise(
    outcomes: Sequence[Outcome], levels: Sequence[int], tolerated: float = 0.0
) -> Summary:
    """Return the summary of outcomes, at the given levels and where else there are any.

    A case counts once, by the run that stands for it where a share of its runs is `tolerated`.
    """
    every = sorted({*levels, *(outcome.case.level for outcome in outcomes)})
    unsure = undecided(outcomes, tolerated)
    outcomes = one_per_case(outcomes, tolerated)
    ends = Counter(outcome.measures.end for outcome in outcomes)
    return Summary(
        cases=len(outcomes),
        failures=sum(outcome.failed for outcome in outcomes) - len(unsure),
        ends={end.value: ends[end] for end in End if ends[end]},
        severities=_severities(outcomes),
        levels={level: _level(outcomes, level, unsure) for level in every},
        undecided=len(unsure),
    )


def _severities(outcomes: Sequence[Outcome]) -> dict[str, int]:
    """Return the number of cases of each severity that occurs, the most severe first."""
    counts = Counter(outcome.measures.severity for outcome in outcomes)
    return {severity.value: counts[severity] for severity in Severity if counts[severity]}


def _level(outcomes: Sequence[Outcome], level: int, unsure: set[int]) -> LevelSummary:
    at_level = [outcome for outcome in outcomes if outcome.case.level == level]
    unsure_here = sum(outcome.index in unsure for outcome in at_level)
    points = to_unit((outcome.case for outcome in at_level if outcome.failed), level)
    return LevelSummary(
        cases=len(at_level),
        tested=sum(outcome.is_tested for outcome in at_level),
        failures=len(points) - unsure_here,
        severities=_severities(at_level),
        fmc=fmc(points),
        regions=int(regions(points).max(initial=-1)) + 1,
        undecided=unsure_here,
    )
