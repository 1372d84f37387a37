"""Counts of a campaign: failures by level, cases without a verdict, and gates.

A case is tested when the VUT reaches the merge point. Runs of a case with other draws are outcomes
of their own; the case fails where more than a tolerated share of its runs fail.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from typing import Any

from scipy.special import betainc

from merge_sumo.errors import UserError
from merge_sumo.metrics.fmc import fmc, regions
from merge_sumo.metrics.merge import Severity
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.printable import counted, printable
from merge_sumo.scenario.case import Case, to_unit
from merge_sumo.scenario.scenario import US23, level_name
from merge_sumo.scenario.trajectory import End

CONFIDENCE = 0.95
"""Of the interval of the failure probability of a case."""
DOUBT = 0.05
"""Largest posterior probability of the contrary at which a failing case is decided."""
MOST_RUNS = 20
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
        """Return the run that decides the case: it fails exactly where the case does.

        Of the runs from the worst to the best it is the first one after the tolerated ones.
        """
        spared = 1
        while spared / self.runs <= tolerated:
            spared += 1
        ordered = sorted(self.outcomes, key=lambda run: (run.margin or 0.0, run.index))
        return ordered[spared - 1]


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
    shown: dict[int, Outcome] = {}
    for case in by_case(known):
        shown[case.outcomes[0].index] = case.deciding(tolerated)
    for outcome in known:
        if outcome.margin is None:
            shown[outcome.index] = outcome
    return [shown[index] for index in sorted(shown)]


def undecided(outcomes: Iterable[Outcome], tolerated: float) -> set[int]:
    """Return the deciding runs, by index, of failing cases with too few runs to decide.

    None where cases ran more than once and no two runs of one differ: then there is no chance.
    """
    cases = by_case(outcomes) if tolerated else []
    repeated = [case for case in cases if case.runs > 1]
    if repeated and not any(case.varies for case in repeated):
        return set()
    found = set()
    for case in cases:
        if case.share > tolerated and not is_decided(case.failures, case.runs, tolerated):
            found.add(case.deciding(tolerated).index)
    return found


@cache
def is_decided(failures: int, runs: int, tolerated: float) -> bool:
    """Return whether the runs of a failing case show that more than a share of all runs fail.

    By the posterior of Jeffreys' prior. The first failure is left out: by it the case was noticed.

    Args:
        failures: number of failing runs, 1 or more.
        runs: number of runs.
        tolerated: share of its runs in which a case may fail, above 0.
    """
    if runs >= MOST_RUNS:
        return True
    return float(betainc(failures - 0.5, runs - failures + 0.5, tolerated)) <= DOUBT


def check_tolerated(tolerated: float) -> None:
    """Raise `UserError` where a tolerated share of failing runs is not from 0 to below 1."""
    if not 0.0 <= tolerated < 1.0:
        raise UserError(
            f"`tolerated` is {tolerated}: choose the share of its runs in which a case may fail, "
            "from 0 to below 1, say 0.1"
        )


def clopper_pearson(failures: int, cases: int, confidence: float) -> tuple[float, float]:
    """Return the exact interval of a probability by independent cases; (0, 1) without any.

    Source: Clopper and Pearson (1934). Never for cases that a sampler has chosen.

    Args:
        failures: number of failures.
        cases: number of independent cases.
        confidence: confidence level of the interval.
    """
    from scipy.stats import binomtest

    if not cases:
        return 0.0, 1.0
    found = binomtest(failures, cases).proportion_ci(confidence, method="exact")
    return float(found.low), float(found.high)


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
        undecided: failing cases with too few runs to decide.
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
    """Return the summary of outcomes; a case counts once, by its deciding run.

    Args:
        outcomes: outcomes of a campaign.
        levels: levels to report, also without cases; others are added where they have cases.
        tolerated: share of its runs in which a case may fail.
    """
    unsure = undecided(outcomes, tolerated)
    by_level: dict[int, list[Outcome]] = {level: [] for level in levels}
    cases = one_per_case(outcomes, tolerated)
    for outcome in cases:
        by_level.setdefault(outcome.case.level, []).append(outcome)
    found = {level: _level(by_level[level], level, unsure) for level in sorted(by_level)}
    return Summary(
        cases=len(cases),
        failures=sum(one.failures for one in found.values()),
        ends=_tally(End, (outcome.measures.end for outcome in cases)),
        severities=_tally(Severity, (outcome.measures.severity for outcome in cases)),
        levels=found,
        undecided=len(unsure),
    )


def _tally(kinds: Iterable[StrEnum], values: Iterable[StrEnum | None]) -> dict[str, int]:
    """Return the number of values of each kind that occurs, in the order of the kinds."""
    counts = Counter(values)
    return {kind.value: counts[kind] for kind in kinds if counts[kind]}


def _level(outcomes: Sequence[Outcome], level: int, unsure: set[int]) -> LevelSummary:
    points = to_unit((outcome.case for outcome in outcomes if outcome.failed), level)
    undecided_here = len(unsure.intersection(outcome.index for outcome in outcomes))
    return LevelSummary(
        cases=len(outcomes),
        tested=sum(outcome.is_tested for outcome in outcomes),
        failures=len(points) - undecided_here,
        severities=_tally(Severity, (outcome.measures.severity for outcome in outcomes)),
        fmc=fmc(points),
        regions=int(regions(points).max(initial=-1)) + 1,
        undecided=undecided_here,
    )


MESSAGE_CHARACTERS = 300
"""Of a message that is shown; `outcomes.jsonl` has the whole."""
MOST_MESSAGES = 5
"""Messages of errors and timeouts that are printed; the report has the others."""
_VARYING = re.compile(r"0x[0-9a-fA-F]+|[-+]?\d+(?:\.\d+(?:e[-+]?\d+)?|e[-+]?\d+)")
"""Measured values and addresses."""


@dataclass(frozen=True, slots=True)
class ErrorGroup:
    """Cases that ended without a test, in the same way.

    Attributes:
        end: VUT_ERROR, SIM_ERROR or TIMEOUT.
        message: message of the first of them, on one line, without control characters.
        cases: their indices, ascending.
    """

    end: End
    message: str
    cases: tuple[int, ...]

    @property
    def count(self) -> int:
        """Number of cases."""
        return len(self.cases)


@dataclass(frozen=True, slots=True)
class Verdict:
    """The outcome of the cases of a campaign in numbers.

    Attributes:
        cases: cases that ran.
        failures: cases that fail under the criterion, but for those that are undecided.
        undecided: failing cases with too few runs to decide.
        contacts: failures in which bodies touch at or after the merge point.
        errors: cases that ended as VUT_ERROR or SIM_ERROR.
        timeouts: cases in which the VUT never reached its goal.
        error_groups: errors and timeouts by message: errors first, then the most frequent.
        goal: place that the VUT reaches in a case that is tested.
    """

    cases: int
    failures: int
    undecided: int
    contacts: int
    errors: int
    timeouts: int
    error_groups: tuple[ErrorGroup, ...]
    goal: str

    @property
    def tested(self) -> int:
        """Cases in which the VUT reached its goal."""
        return self.cases - self.errors - self.timeouts

    @property
    def nothing_tested(self) -> str:
        """A sentence, without its full stop, on a campaign in which no case was tested."""
        safely = " without an error" if self.errors else ""
        return f"nothing was tested: the VUT reached {self.goal}{safely} in no case"

    @property
    def found(self) -> list[str]:
        """The numbers in words: errors and timeouts, if there are any, then failures."""
        return self._found("")

    def _found(self, contacts: str) -> list[str]:
        parts = []
        if self.errors:
            parts.append(counted(self.errors, "error"))
        if self.timeouts:
            parts.append(counted(self.timeouts, "timeout"))
        parts.append(counted(self.failures, "failure") + contacts)
        if self.undecided:
            parts.append(f"{self.undecided} undecided")
        return parts

    @property
    def counts(self) -> str:
        """The result in a line."""
        contacts = f" ({counted(self.contacts, 'contact')})" if self.failures else ""
        *others, last = self._found(contacts)
        counts = f"{', '.join(others)} and {last}" if others else last
        return f"{counts} in {counted(self.cases, 'case')}"

    def error_lines(self) -> list[str]:
        """Return lines on errors and timeouts by message; none where there are none."""
        lines = []
        for one in self.error_groups[:MOST_MESSAGES]:
            first = f"the first in case {one.cases[0]}: {one.message}"
            lines.append(f"  {one.count} {one.end}, {first}")
        others = self.error_groups[MOST_MESSAGES:]
        if others:
            number = sum(one.count for one in others)
            lines.append(f"  {number} with {len(others)} other messages")
        return lines

    def to_record(self) -> dict[str, Any]:
        """Return contacts, errors and timeouts as JSON has them."""
        error_groups = []
        for one in self.error_groups:
            example = {"end": one.end, "message": one.message, "cases": one.count}
            error_groups.append(example | {"example": one.cases[0]})
        counts = {"contacts": self.contacts, "errors": self.errors, "timeouts": self.timeouts}
        return counts | {"error_groups": error_groups}


def judge(outcomes: Sequence[Outcome], tolerated: float = 0.0) -> Verdict:
    """Return the verdict on outcomes; a case counts once, as in `summarise`."""
    cases, unsure = one_per_case(outcomes, tolerated), undecided(outcomes, tolerated)
    groups: dict[tuple[End, str], list[Outcome]] = {}
    failures = contacts = errors = timeouts = 0
    for outcome in cases:
        end = outcome.measures.end
        if outcome.failed and outcome.index not in unsure:
            failures += 1
            contacts += outcome.measures.severity == Severity.CONTACT
        if not outcome.is_tested:
            errors += end.is_error
            timeouts += not end.is_error
            # Messages that differ in numbers and addresses alone are one.
            pattern = _VARYING.sub("#", message_of(outcome))
            groups.setdefault((end, pattern), []).append(outcome)
    error_groups = []
    for (end, _), same in groups.items():
        indices = tuple(outcome.index for outcome in same)
        error_groups.append(ErrorGroup(end, message_of(same[0]), indices))
    error_groups.sort(key=lambda one: (not one.end.is_error, -one.count, one.cases[0]))
    goal = cases[0].case.scenario.goal if cases else US23.goal
    return Verdict(
        len(cases), failures, len(unsure), contacts, errors, timeouts, tuple(error_groups), goal
    )


def message_of(outcome: Outcome) -> str:
    """Return why a case, or its follow-up, has no end, on one line that may be shown anywhere."""
    measures = outcome.measures
    if measures.error is not None:
        # Cut before it is escaped: a message may have megabytes.
        return shortened(printable(measures.error[: MESSAGE_CHARACTERS + 1]), MESSAGE_CHARACTERS)
    if measures.end.is_error:
        return "no reason given"
    return f"the VUT did not reach {outcome.case.scenario.goal} in {measures.t_end_s:g} s"


def shortened(text: str, characters: int) -> str:
    """Return a text, or its beginning where it is longer."""
    return text if len(text) <= characters else text[: characters - 3] + "..."


REGRESSIONS = "regressions"
"""The gate that counts the cases that fail and pass with an earlier version of the VUT."""
NUMBERS = ("failures", "errors", "timeouts", REGRESSIONS)
"""Gates that are met by one case."""


@dataclass(frozen=True, slots=True)
class Gate:
    """A bound that a campaign must not exceed.

    Attributes:
        what: one of `NUMBERS`, or "fmc", the coverage at some POV level.
        above: the gate is met beyond this.
    """

    what: str
    above: float = 0.0

    @property
    def name(self) -> str:
        """The gate as it is written."""
        return f"{self.what}>{self.above}" if self.what == "fmc" else self.what

    def check(self, verdict: Verdict, summary: Summary, regressions: int = 0) -> GateResult:
        """Return whether a campaign meets the gate, and the number that decides.

        Args:
            verdict: verdict on the campaign.
            summary: summary of the campaign.
            regressions: number of cases that fail now and pass with the earlier version.
        """
        if self.what == "fmc":
            most, level = 0.0, min(summary.levels, default=0)
            for one, found in summary.levels.items():
                if found.fmc > most:
                    most, level = found.fmc, one
            text = f"FMC {most:.4f} at level {level_name(level)}"
            return GateResult(self.name, most > self.above, text)
        number = regressions if self.what == REGRESSIONS else getattr(verdict, self.what)
        text = counted(number, self.what.removesuffix("s"))
        if self.what == "failures" and verdict.undecided:
            # One that is undecided may be a failure.
            number += verdict.undecided
            text += f" and {verdict.undecided} undecided"
        return GateResult(self.name, number > 0, text)


@dataclass(frozen=True, slots=True)
class GateResult:
    """The result of a gate: whether a campaign meets it, and the number found."""

    name: str
    met: bool
    found: str

    @property
    def sentence(self) -> str:
        """The result as a line."""
        return f"gate {self.name}: {'met' if self.met else 'not met'} ({self.found})"


def parse_gates(texts: Iterable[str], *, against: bool = False) -> list[Gate]:
    """Return gates by their names, each once; `UserError` for a text that names none.

    Args:
        texts: names of gates, such as "errors" or "fmc>0.1".
        against: whether the campaign is against an earlier version of the VUT.
    """
    gates: dict[str, Gate] = {}
    for text in texts:
        what, _, number = (part.strip() for part in text.partition(">"))
        if text not in NUMBERS and (what != "fmc" or ">" not in text):
            raise UserError(
                f"there is no gate {printable(text)!r}: choose {', '.join(NUMBERS)} or "
                '"fmc>X" (in quotes, or the shell takes the ">")'
            )
        if text == REGRESSIONS and not against:
            raise UserError(
                f"the gate {text} needs an earlier version of the VUT: name it with `against`"
            )
        try:
            above = 0.0 if text in NUMBERS else float(number)
        except ValueError:
            above = math.nan
        if not 0.0 <= above < 1.0:
            raise UserError(
                f'the gate {printable(text)!r} cannot be decided: X of "fmc>X" is a number from '
                "0 to below 1"
            )
        gate = Gate(what, above)
        gates[gate.name] = gate
    return list(gates.values())
