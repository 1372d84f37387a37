"""The verdict on a campaign: what ran without a result, why, and whether a gate is met.

A case is tested when the VUT reaches the merge point: there it fails or not. An error (of the
VUT or of the simulation) and a timeout say nothing about merging, so they come first wherever a
campaign is shown, and a campaign in which no case was tested has passed nothing.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from merge_sumo.errors import UserError
from merge_sumo.metrics.chance import one_per_case, undecided
from merge_sumo.metrics.score import Outcome
from merge_sumo.metrics.severity import Severity
from merge_sumo.metrics.summary import Summary
from merge_sumo.printable import counted, printable
from merge_sumo.scenario.scenario import Scenario, level_name
from merge_sumo.scenario.trajectory import End

MESSAGE_CHARACTERS: Final = 300
"""Of a message that is shown; `outcomes.jsonl` has the whole."""
MOST_MESSAGES: Final = 5
"""Messages of errors and timeouts that are printed; the report has the others."""
_VARYING: Final = re.compile(r"0x[0-9a-fA-F]+|[-+]?\d+(?:\.\d+(?:e[-+]?\d+)?|e[-+]?\d+)")
"""Measured values and addresses: messages that differ in them alone are one."""


@dataclass(frozen=True, slots=True)
class Trouble:
    """Cases that ended without a test, in the same way.

    Attributes:
        end: VUT_ERROR, SIM_ERROR or TIMEOUT.
        message: what the first of them says, on one line, without characters that do not print.
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
        undecided: failing cases that ran too seldom to tell: see `chance.undecided`.
        contacts: failures in which bodies touch.
        errors: cases that ended as VUT_ERROR or SIM_ERROR.
        timeouts: cases in which the VUT never reached its goal.
        troubles: errors and timeouts by message: errors first, then the most frequent.
        goal: what the VUT reaches in a case that is tested.
    """

    cases: int
    failures: int
    undecided: int
    contacts: int
    errors: int
    timeouts: int
    troubles: tuple[Trouble, ...]
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
        """The numbers in words: errors and timeouts, where there are any, then failures."""
        return self._found("")

    def _found(self, of_failures: str) -> list[str]:
        wrong = ((self.errors, "error"), (self.timeouts, "timeout"))
        failures = counted(self.failures, "failure") + of_failures
        unsure = [f"{self.undecided} undecided"] if self.undecided else []
        return [*(counted(n, what) for n, what in wrong if n), failures, *unsure]

    @property
    def counts(self) -> str:
        """The result in a line."""
        contacts = f" ({counted(self.contacts, 'contact')})" if self.failures else ""
        *others, last = self._found(contacts)
        counts = f"{', '.join(others)} and {last}" if others else last
        return f"{counts} in {counted(self.cases, 'case')}"

    def trouble_lines(self) -> list[str]:
        """Return lines on errors and timeouts by message; none where there are none."""
        said = [
            f"  {trouble.count} {trouble.end}, the first in case {trouble.cases[0]}: "
            f"{trouble.message}"
            for trouble in self.troubles[:MOST_MESSAGES]
        ]
        others = self.troubles[MOST_MESSAGES:]
        if others:
            number = sum(trouble.count for trouble in others)
            said.append(f"  {number} with {len(others)} other messages")
        return said

    def to_record(self) -> dict[str, Any]:
        """Return contacts, errors and timeouts as JSON has them."""
        return {
            "contacts": self.contacts,
            "errors": self.errors,
            "timeouts": self.timeouts,
            "troubles": [
                {"end": t.end, "message": t.message, "cases": t.count, "example": t.cases[0]}
                for t in self.troubles
            ],
        }


def judge(outcomes: Sequence[Outcome], tolerated: float = 0.0) -> Verdict:
    """Return the verdict on outcomes; a case counts once, as in `summarise`."""
    ran, unsure = one_per_case(outcomes, tolerated), undecided(outcomes, tolerated)
    failed = [o for o in ran if o.failed and o.index not in unsure]
    wrong = [o for o in ran if not o.is_tested]
    errors = sum(o.measures.end.is_error for o in wrong)
    groups: dict[tuple[End, str], list[Outcome]] = {}
    for outcome in wrong:
        key = outcome.measures.end, _VARYING.sub("#", message_of(outcome))
        groups.setdefault(key, []).append(outcome)
    troubles = [
        Trouble(end, message_of(same[0]), tuple(o.index for o in same))
        for (end, _), same in groups.items()
    ]
    return Verdict(
        cases=len(ran),
        failures=len(failed),
        undecided=len(unsure),
        contacts=sum(o.measures.severity == Severity.CONTACT for o in failed),
        errors=errors,
        timeouts=len(wrong) - errors,
        troubles=tuple(sorted(troubles, key=lambda t: (not t.end.is_error, -t.count, t.cases[0]))),
        goal=ran[0].case.scenario.goal if ran else Scenario.default_goal,
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


REGRESSIONS: Final = "regressions"
"""The gate that counts the cases that fail and pass with an earlier version of the VUT."""
NUMBERS: Final = ("failures", "errors", "timeouts", REGRESSIONS)
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
        """Return whether a campaign meets the gate, and what it shows.

        `regressions` are the cases that fail and pass with the version that the campaign is
        against.
        """
        if self.what == "fmc":
            by_level = {level: found.fmc for level, found in summary.levels.items()}
            level = max(by_level, key=lambda level: by_level[level], default=0)
            most = by_level.get(level, 0.0)
            said = f"FMC {most:.4f} at level {level_name(level)}"
            return GateResult(self.name, most > self.above, said)
        if self.what == "failures":  # one that is undecided may be a failure
            met = verdict.failures + verdict.undecided > 0
            unsure = f" and {verdict.undecided} undecided" if verdict.undecided else ""
            return GateResult(self.name, met, counted(verdict.failures, "failure") + unsure)
        number = regressions if self.what == REGRESSIONS else getattr(verdict, self.what)
        return GateResult(self.name, number > 0, counted(number, self.what.removesuffix("s")))


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
    """Return gates by their names, each once; `UserError` for what is none.

    `against` is whether the campaign is against an earlier version of the VUT.
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
                f'the gate {printable(text)!r} can never be told: X of "fmc>X" is a number from 0 '
                "to below 1"
            )
        gate = Gate(what, above)
        gates[gate.name] = gate
    return list(gates.values())
