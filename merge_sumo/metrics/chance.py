"""Cases that ran more than once: a failure probability for each, and what counts as a failing case.

A controller that draws random numbers, or that is driven through noise, fails with a probability.
Each run of a case is a case of its own with another draw (`Case.draw`), and an outcome of its own.
A case fails where more than a tolerated share of its runs fail; with none tolerated, where any run
does.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from operator import itemgetter
from typing import Final

from scipy.special import betainc

from merge_sumo.errors import UserError
from merge_sumo.metrics.score import Outcome
from merge_sumo.printable import counted
from merge_sumo.scenario.case import Case

CONFIDENCE: Final = 0.95
"""That the interval of a case holds its failure probability."""
DOUBT: Final = 0.05
"""A case is decided where it fails in more than the tolerated share of its runs, or does not, with
at most this posterior probability of the contrary."""
MOST_RUNS: Final = 20
"""Runs of a case after which it counts as decided."""


@dataclass(frozen=True, slots=True)
class RunsOfCase:
    """The runs of one case that have a verdict.

    Attributes:
        case: the case, at draw 0.
        outcomes: its runs, (n,), at least one, in the order in which they are recorded.
    """

    case: Case
    outcomes: tuple[Outcome, ...]

    @property
    def runs(self) -> int:
        """Number of runs, n."""
        return len(self.outcomes)

    @property
    def failures(self) -> int:
        """Number of runs that fail."""
        return sum(outcome.failed for outcome in self.outcomes)

    @property
    def share(self) -> float:
        """Share of the runs that fail."""
        return self.failures / self.runs

    @property
    def varies(self) -> bool:
        """Whether its runs differ in a measure: then chance is in them."""
        return any(outcome.measures != self.outcomes[0].measures for outcome in self.outcomes)

    @property
    def in_words(self) -> str:
        """How many of the runs fail."""
        return f"{self.failures} of {counted(self.runs, 'run')} fail{'s' * (self.failures == 1)}"

    def deciding(self, tolerated: float = 0.0) -> Outcome:
        """Return the run that decides whether more than a tolerated share of the runs failed.

        Of the runs from the worst to the best it is the first one behind those that are tolerated:
        it fails exactly where the case does.
        """
        spared = sum(number / self.runs <= tolerated for number in range(1, self.runs + 1))
        ordered = sorted(self.outcomes, key=lambda run: (run.margin or 0.0, run.index))
        return ordered[spared]

    def interval(self, confidence: float = CONFIDENCE) -> tuple[float, float]:
        """Return where the failure probability is with a confidence (Clopper and Pearson, 1934).

        It holds for a number of runs that outcomes do not decide.
        """
        return clopper_pearson(self.failures, self.runs, confidence)


def by_case(outcomes: Iterable[Outcome]) -> list[RunsOfCase]:
    """Return outcomes with a verdict by their case, in the order of the first run of each.

    Each outcome of draw 0 begins a case; other draws join the last case with their start.
    """
    cases: list[tuple[Case, list[Outcome]]] = []
    place: dict[Case, int] = {}
    for outcome in outcomes:
        if outcome.margin is None:
            continue
        start = outcome.case.start
        if outcome.case.draw == 0 or start not in place:
            place[start] = len(cases)
            cases.append((start, []))
        cases[place[start]][1].append(outcome)
    return [RunsOfCase(case, tuple(runs)) for case, runs in cases]


def failing_cases(outcomes: Iterable[Outcome], tolerated: float = 0.0) -> list[RunsOfCase]:
    """Return the cases that fail in more than a tolerated share of their runs, as `by_case`."""
    return [one for one in by_case(outcomes) if one.share > tolerated]


def one_per_case(outcomes: Iterable[Outcome], tolerated: float = 0.0) -> list[Outcome]:
    """Return the deciding run of each case, and outcomes without a verdict as they are.

    In the order of the first run of each case. Without repeats, these are the outcomes.
    """
    known = list(outcomes)
    if not any(outcome.case.draw for outcome in known):
        return known
    shown = [(one.outcomes[0].index, one.deciding(tolerated)) for one in by_case(known)]
    errors = [(outcome.index, outcome) for outcome in known if outcome.margin is None]
    return [outcome for _, outcome in sorted(shown + errors, key=itemgetter(0))]


def undecided(outcomes: Iterable[Outcome], tolerated: float) -> set[int]:
    """Return the deciding runs, by index, of failing cases that ran too seldom to tell.

    None where cases ran more than once and no two runs of one differ: chance decides on nothing.
    """
    cases = by_case(outcomes) if tolerated else []
    again = [one for one in cases if one.runs > 1]
    if again and not any(one.varies for one in again):
        return set()
    return {
        one.deciding(tolerated).index
        for one in cases
        if one.share > tolerated and runs_needed(one.failures, one.runs, tolerated)
    }


@cache
def is_decided(failures: int, runs: int, tolerated: float) -> bool:
    """Return whether runs show if a case fails in more than a tolerated share of its runs.

    By the posterior of Jeffreys' prior. The first failure is left out: by it the case was noticed.
    With none tolerated a failure decides, and nothing else.
    """
    if not tolerated:
        return failures > 0
    further = max(failures - 1, 0)
    below = float(betainc(further + 0.5, runs - failures + 0.5, tolerated))
    return not DOUBT < below < 1.0 - DOUBT


@cache
def runs_needed(failures: int, runs: int, tolerated: float) -> int:
    """Return how many further runs of a case decide at least; 0 from `MOST_RUNS` on."""
    further = 0
    while runs + further < MOST_RUNS:
        ends = failures, failures + further
        if any(is_decided(end, runs + further, tolerated) for end in ends):
            break
        further += 1
    return further


def check_tolerated(tolerated: float) -> None:
    """Raise `UserError` for what is no share of runs that may fail."""
    if not 0.0 <= tolerated < 1.0:
        raise UserError(
            f"`tolerated` is {tolerated}: choose the share of its runs in which a case may fail, "
            "from 0 to below 1, say 0.1"
        )


def clopper_pearson(failures: int, cases: int, confidence: float) -> tuple[float, float]:
    """Return the exact interval of a probability by independent cases; (0, 1) without any.

    Source: Clopper and Pearson (1934). Never for cases that a sampler has chosen.
    """
    from scipy.stats import binomtest

    if not cases:
        return 0.0, 1.0
    found = binomtest(failures, cases).proportion_ci(confidence, method="exact")
    return float(found.low), float(found.high)
