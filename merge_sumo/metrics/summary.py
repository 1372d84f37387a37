"""Summary of a campaign: failures, errors and timeouts, coverage by POV level, and gates.

A case may run several times, with other random draws; it fails where more than a tolerated share of
its runs fail.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import Any

from scipy.special import betainc

from merge_sumo.errors import UserError
from merge_sumo.metrics.fmc import fmc, regions
from merge_sumo.metrics.merge import Severity
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.printable import counted, printable
from merge_sumo.records import to_plain
from merge_sumo.scenario.case import Case, to_unit
from merge_sumo.scenario.scenario import US23, level_name
from merge_sumo.scenario.trajectory import End

CONFIDENCE = 0.95
"""Confidence level of the interval of the failure probability of a case."""
DOUBT = 0.05
"""Largest posterior probability of the contrary at which a failing case is decided."""
MOST_RUNS = 20
"""Runs after which a case counts as decided."""


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
        """Number of failing runs."""
        return sum(outcome.failed for outcome in self.outcomes)

    @property
    def share(self) -> float:
        """Share of failing runs."""
        return self.failures / self.runs

    @property
    def varies(self) -> bool:
        """Whether the runs differ in a measure."""
        return any(outcome.measures != self.outcomes[0].measures for outcome in self.outcomes)

    @property
    def in_words(self) -> str:
        """The failing runs in words, such as "2 of 5 runs fail"."""
        return f"{self.failures} of {counted(self.runs, 'run')} fail{'s' * (self.failures == 1)}"

    def deciding(self, tolerated: float = 0.0) -> Outcome:
        """Return the run that decides the case: it fails exactly where the case does.

        Of the runs, sorted from worst to best, it is the first after those that may fail.

        Args:
            tolerated: share of its runs in which a case may fail.
        """
        spared = 1
        while spared / self.runs <= tolerated:
            spared += 1
        ordered = sorted(self.outcomes, key=lambda run: (run.margin or 0.0, run.index))
        return ordered[spared - 1]


def by_case(outcomes: Iterable[Outcome]) -> list[RunsOfCase]:
    """Return outcomes with a verdict by their case, in the order of the first run of each.

    Each outcome of draw 0 begins a case; other draws join the last case with their start.

    Args:
        outcomes: outcomes of a campaign.
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
    """Return the cases that fail in more than a tolerated share of their runs.

    Args:
        outcomes: outcomes of a campaign.
        tolerated: share of its runs in which a case may fail.
    """
    return [case for case in by_case(outcomes) if case.share > tolerated]


def one_per_case(outcomes: Iterable[Outcome], tolerated: float = 0.0) -> list[Outcome]:
    """Return the deciding run of each case, and each outcome without a verdict.

    Args:
        outcomes: outcomes of a campaign.
        tolerated: share of its runs in which a case may fail.

    Returns:
        Outcomes in the order of the first run of each case; without repeats, all outcomes.
    """
    runs = list(outcomes)
    if not any(outcome.case.draw for outcome in runs):
        return runs
    shown: dict[int, Outcome] = {}
    for case in by_case(runs):
        shown[case.outcomes[0].index] = case.deciding(tolerated)
    for outcome in runs:
        if outcome.margin is None:
            shown[outcome.index] = outcome
    return [shown[index] for index in sorted(shown)]


def undecided(outcomes: Iterable[Outcome], tolerated: float) -> set[int]:
    """Return the failing cases with too few runs to decide.

    Args:
        outcomes: outcomes of a campaign.
        tolerated: share of its runs in which a case may fail.

    Returns:
        Indices of the deciding runs. Empty where cases ran more than once and no two runs of a
        case differ: then one run decides.
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

    By the posterior of Jeffreys' prior. The first failure is left out, because the case was noticed
    by it.

    Args:
        failures: number of failing runs, 1 or more.
        runs: number of runs.
        tolerated: share of its runs in which a case may fail, above 0.
    """
    if runs >= MOST_RUNS:
        return True
    return float(betainc(failures - 0.5, runs - failures + 0.5, tolerated)) <= DOUBT


def clopper_pearson(
    failures: int, cases: int, confidence: float, without_verdict: int = 0
) -> tuple[float, float]:
    """Return the exact interval of a probability by independent cases; (0, 1) without any.

    Source: Clopper and Pearson (1934). Cases that a sampler has chosen are not independent.

    Args:
        failures: number of failures.
        cases: number of independent cases.
        confidence: confidence level of the interval.
        without_verdict: number of cases without a verdict; they count as safe for the lower end,
            and as failures for the upper one.

    Returns:
        Lower and upper end.
    """
    from scipy.stats import binomtest

    if not cases:
        return 0.0, 1.0
    low, _ = binomtest(failures, cases).proportion_ci(confidence, method="exact")
    most = failures + without_verdict
    _, high = binomtest(most, cases).proportion_ci(confidence, method="exact")
    return float(low), float(high)


MESSAGE_CHARACTERS = 300
"""Longest message that is shown; `outcomes.jsonl` has the whole."""
MOST_MESSAGES = 5
"""Messages of errors and timeouts that are printed; the report has the others."""
_VARYING = re.compile(r"0x[0-9a-fA-F]+|[-+]?\d+(?:\.\d+(?:e[-+]?\d+)?|e[-+]?\d+)")
"""Measured values and addresses in messages."""


@dataclass(frozen=True, slots=True)
class LevelSummary:
    """The summary of one POV level.

    Attributes:
        cases: cases that ran.
        tested: cases that are judged (`Outcome.is_tested`).
        failures: failing cases, without the undecided ones.
        fmc: failure mode coverage of the failing cases, decided or not, in the unit cube of the
            level; M(s, 0.05, -500) under the paper's criterion in up to three coordinates.
        regions: groups of these cases that are linked at the radius of FMC.
        undecided: failing cases with too few runs to decide.
    """

    cases: int
    tested: int
    failures: int
    fmc: float
    regions: int
    undecided: int = 0


@dataclass(frozen=True, slots=True)
class ErrorGroup:
    """Errors or timeouts with the same message.

    Attributes:
        end: VUT_ERROR, SIM_ERROR or TIMEOUT.
        message: message of the first case, on one line, without control characters.
        cases: indices of the cases, ascending.
    """

    end: End
    message: str
    cases: tuple[int, ...]

    @property
    def count(self) -> int:
        """Number of cases."""
        return len(self.cases)


@dataclass(frozen=True, slots=True)
class Summary:
    """The cases of a campaign in numbers.

    Attributes:
        cases: cases that ran.
        failures: failing cases, without the undecided ones.
        contacts: failures in which bodies overlap.
        errors: cases that ended as VUT_ERROR or SIM_ERROR.
        timeouts: cases in which the VUT never reached its goal, unless that is a failure.
        undecided_cases: deciding runs, by index, of failing cases with too few runs to decide.
        error_groups: errors and timeouts by message: errors first, then the most frequent.
        goal: place that the VUT is to reach.
        levels: summaries of POV levels.

    Example:
        >>> summary = summarise(run.outcomes, run.levels)
        >>> summary.counts, summary.levels[1].fmc
        ('12 failures (3 with contact) in 60 cases', 0.0213)
    """

    cases: int
    failures: int
    contacts: int
    errors: int
    timeouts: int
    undecided_cases: frozenset[int]
    error_groups: tuple[ErrorGroup, ...]
    goal: str
    levels: dict[int, LevelSummary]

    @property
    def undecided(self) -> int:
        """Number of failing cases with too few runs to decide."""
        return len(self.undecided_cases)

    @property
    def tested(self) -> int:
        """Number of cases that are judged (`Outcome.is_tested`)."""
        return self.cases - self.errors - self.timeouts

    @property
    def nothing_tested(self) -> str:
        """The sentence, without its full stop, on a campaign without a tested case."""
        safely = " without an error" if self.errors else ""
        return f"nothing was tested: the VUT never reached {self.goal}{safely}"

    @property
    def found(self) -> str:
        """Errors, timeouts, failures and undecided cases in words; failures also if 0."""
        parts = []
        if self.errors:
            parts.append(counted(self.errors, "error"))
        if self.timeouts:
            parts.append(counted(self.timeouts, "timeout"))
        contacts = f" ({self.contacts} with contact)" if self.failures else ""
        parts.append(counted(self.failures, "failure") + contacts)
        if self.undecided:
            parts.append(f"{self.undecided} undecided")
        return ", ".join(parts)

    @property
    def counts(self) -> str:
        """The line with `found` and the number of cases."""
        return f"{self.found} in {counted(self.cases, 'case')}"

    def error_lines(self) -> list[str]:
        """Return the lines on the most frequent errors and timeouts."""
        lines = []
        for group in self.error_groups[:MOST_MESSAGES]:
            first = f"the first in case {group.cases[0]}: {group.message}"
            lines.append(f"  {group.count} {group.end}, {first}")
        others = self.error_groups[MOST_MESSAGES:]
        if others:
            number = sum(group.count for group in others)
            lines.append(f"  {number} with {len(others)} other messages")
        return lines

    def to_record(self) -> dict[str, Any]:
        """Return the summary as JSON has it: counts, levels, and an example of each error."""
        record: dict[str, Any] = to_plain(self)
        del record["undecided_cases"], record["goal"]
        for group in record["error_groups"]:
            group["example"] = group["cases"][0]
            group["cases"] = len(group["cases"])
        return record | {"undecided": self.undecided}


def summarise(
    outcomes: Sequence[Outcome], levels: Iterable[int] = (), tolerated: float = 0.0
) -> Summary:
    """Return the summary of outcomes; a case counts once, by its deciding run.

    Args:
        outcomes: outcomes of a campaign.
        levels: POV levels with a summary of their own, which takes the time of FMC.
        tolerated: share of its runs in which a case may fail.
    """
    cases, unsure = one_per_case(outcomes, tolerated), undecided(outcomes, tolerated)
    failed = [case for case in cases if case.failed and case.index not in unsure]
    untested = [case for case in cases if not case.is_tested]
    errors = sum(case.measures.end.is_error for case in untested)
    return Summary(
        cases=len(cases),
        failures=len(failed),
        contacts=sum(case.measures.severity == Severity.CONTACT for case in failed),
        errors=errors,
        timeouts=len(untested) - errors,
        undecided_cases=frozenset(unsure),
        error_groups=_error_groups(untested),
        goal=cases[0].case.scenario.goal if cases else US23.goal,
        levels={level: _of_level(cases, level, unsure) for level in levels},
    )


def _of_level(cases: Iterable[Outcome], level: int, unsure: set[int]) -> LevelSummary:
    at_level = [case for case in cases if case.case.level == level]
    failed = [case for case in at_level if case.failed]
    points = to_unit((case.case for case in failed), level)
    undecided_cases = sum(case.index in unsure for case in failed)
    return LevelSummary(
        cases=len(at_level),
        tested=sum(case.is_tested for case in at_level),
        failures=len(failed) - undecided_cases,
        fmc=fmc(points),
        regions=int(regions(points).max(initial=-1)) + 1,
        undecided=undecided_cases,
    )


def _error_groups(untested: Iterable[Outcome]) -> tuple[ErrorGroup, ...]:
    """Return cases by end and message; messages that differ in numbers or addresses are one."""
    groups: dict[tuple[End, str], list[Outcome]] = {}
    for outcome in untested:
        pattern = _VARYING.sub("#", message_of(outcome))
        groups.setdefault((outcome.measures.end, pattern), []).append(outcome)
    found = []
    for (end, _), same in groups.items():
        indices = tuple(outcome.index for outcome in same)
        found.append(ErrorGroup(end, message_of(same[0]), indices))
    found.sort(key=lambda group: (not group.end.is_error, -group.count, group.cases[0]))
    return tuple(found)


def message_of(outcome: Outcome) -> str:
    """Return the reason of an error or a timeout, on one line that may be shown anywhere.

    Args:
        outcome: a case that was not tested, or has an error in its follow-up.
    """
    measures = outcome.measures
    if measures.error is not None:
        # Cut before it is escaped: a message may have megabytes.
        return shortened(printable(measures.error[: MESSAGE_CHARACTERS + 1]), MESSAGE_CHARACTERS)
    if measures.end.is_error:
        return "no reason given"
    return f"the VUT did not reach {outcome.case.scenario.goal} in {measures.t_end_s:g} s"


def shortened(text: str, characters: int) -> str:
    """Return a text, or its beginning where it is longer.

    Args:
        text: the text.
        characters: maximum length of the result.
    """
    return text if len(text) <= characters else text[: characters - 3] + "..."


REGRESSIONS = "regressions"
"""The gate that counts the cases that fail and pass with an earlier version of the VUT."""
NUMBERS = ("failures", "errors", "timeouts", REGRESSIONS)
"""Gates that are met by one case."""
_COVERAGE = re.compile(r"fmc\s*>\s*(.*)")


@dataclass(frozen=True, slots=True)
class GateResult:
    """The result of a gate.

    Attributes:
        name: the gate as a user writes it.
        met: whether the campaign meets it, and so does not pass.
        found: the number that decides, in words.
    """

    name: str
    met: bool
    found: str

    @property
    def sentence(self) -> str:
        """The result as a line."""
        return f"gate {self.name}: {'met' if self.met else 'not met'} ({self.found})"


@dataclass(frozen=True, slots=True)
class Gate:
    """A bound that a campaign must not exceed.

    Attributes:
        what: one of `NUMBERS`, or "fmc", the largest coverage at a POV level.
        above: the gate is met beyond this value.

    Example:
        >>> Gate("fmc", 0.05).check(summary).sentence
        'gate fmc>0.05: met (FMC 0.0712 at level 1)'
    """

    what: str
    above: float = 0.0

    @property
    def name(self) -> str:
        """The gate as a user writes it."""
        return f"{self.what}>{self.above}" if self.what == "fmc" else self.what

    def check(self, summary: Summary, regressions: int = 0) -> GateResult:
        """Return the result of the gate; undecided cases count as failures.

        Args:
            summary: summary of the campaign, with its levels.
            regressions: number of cases that fail now and pass with the earlier version.
        """
        if self.what == "fmc":
            level = max(summary.levels, key=lambda level: summary.levels[level].fmc)
            most = summary.levels[level].fmc
            text = f"FMC {most:.4f} at level {level_name(level)}"
            return GateResult(self.name, most > self.above, text)
        number = regressions if self.what == REGRESSIONS else getattr(summary, self.what)
        text = counted(number, self.what.removesuffix("s"))
        if self.what == "failures" and summary.undecided:
            number += summary.undecided
            text += f" and {summary.undecided} undecided"
        return GateResult(self.name, number > 0, text)


def parse_gates(texts: Iterable[str], *, against: bool = False) -> list[Gate]:
    """Return gates by their texts, each once.

    Args:
        texts: gates as a user writes them, such as "errors" or "fmc>0.1".
        against: whether the campaign is against an earlier version of the VUT.

    Raises:
        UserError: a text is not a gate, or its gate needs an earlier version.
    """
    gates: dict[str, Gate] = {}
    for text in texts:
        gate = _parsed_gate(text)
        if gate.what == REGRESSIONS and not against:
            raise UserError(
                f"the gate {text} needs an earlier version of the VUT: name it with `against`"
            )
        gates[gate.name] = gate
    return list(gates.values())


def _parsed_gate(text: str) -> Gate:
    if text in NUMBERS:
        return Gate(text)
    if bound := _COVERAGE.fullmatch(text.strip()):
        with suppress(ValueError):
            above = float(bound[1])
            if 0.0 <= above < 1.0:
                return Gate("fmc", above)
    raise UserError(
        f'unknown gate {printable(text)!r}: choose {", ".join(NUMBERS)} or "fmc>X" with X from 0 '
        'to below 1 (in quotes, or the shell takes the ">")'
    )
