"""What changed from one VUT to another, case by case and level by level, and whether it is worse.

Volumes are failure mode coverages of what is known of both.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any, Final

from merge_sumo.analysis.result import Result
from merge_sumo.analysis.verdict import counted
from merge_sumo.values.case import Case
from merge_sumo.values.scenario import level_name
from merge_sumo.values.trajectory import End

FIRST_LOOKS: Final = 10
VOLUME_NOISE: Final = 2e-4
"""Share of a volume in three dimensions that is rounding of the integral (see `fmc`)."""
SHARE_ROUNDING: Final = 1e-9


class Change(StrEnum):
    """What became of a case from A to B; an error or a timeout is no verdict."""

    FIXED = "fixed"
    BROKE = "broke"
    BOTH_FAIL = "both fail"
    NO_VERDICT_OF_A = "no verdict of A"
    NO_VERDICT_OF_B = "no verdict of B"
    NO_VERDICT = "no verdict"
    NOT_RUN_AGAIN = "not run again"


@dataclass(frozen=True, slots=True)
class ComparedCase:
    """A case in which at least one of the two VUTs failed or gave no verdict.

    Attributes:
        run: "A" or "B", the campaign that has the case.
        index: its index there.
        case: the case.
        score_a: P of A; None where an error ended it or A was not run.
        score_b: P of B.
        end_a: how it ended with A; None where A was not run.
        end_b: how it ended with B.
        severity_a: contact, conflict, harsh or safe with A; None where it has none.
        severity_b: the same with B.
        change: what became of it.
    """

    run: str
    index: int
    case: Case
    score_a: float | None
    score_b: float | None
    end_a: End | None
    end_b: End | None
    severity_a: str | None
    severity_b: str | None
    change: Change


@dataclass(frozen=True, slots=True)
class Untested:
    """Cases at a level in which a VUT did not reach the merge point.

    Attributes:
        cases: cases that were looked at: those of both campaigns where both VUTs were run again,
            else those of its own.
        errors: that ended in an error.
        timeouts: in which it never reached the merge point.
        nothing_tested: whether its own campaign has cases at this level, and none was tested.
    """

    cases: int
    errors: int
    timeouts: int
    nothing_tested: bool = False

    def share(self, number: int) -> float:
        """Return a number of the cases as a share of them."""
        return number / self.cases if self.cases else 0.0


@dataclass(frozen=True, slots=True)
class LevelChange:
    """What changed at a POV level; volumes in the level's unit cube.

    Attributes:
        untested_a: cases without a verdict of A.
        untested_b: the same of B.
        fmc_a: coverage of the cases in which A is known to fail.
        fmc_b: the same of B.
        fmc_fixed: volume that A's failures cover and B's do not; failures on which B gives no
            verdict are not fixed.
        fmc_broke: volume that B's failures cover and A's do not, in the same way.
        changes: number of cases by what became of them.
    """

    untested_a: Untested
    untested_b: Untested
    fmc_a: float
    fmc_b: float
    fmc_fixed: float
    fmc_broke: float
    changes: dict[str, int]


@dataclass(frozen=True, slots=True, repr=False)
class RunComparison(Result):
    """What changed from campaign A to campaign B.

    Attributes:
        levels: by POV level.
        cases: every case in which one failed or gave no verdict; what broke comes first, the
            worst of B first.
        evidence: how the verdicts of the other VUT came about, as a sentence.
    """

    levels: dict[int, LevelChange]
    cases: list[ComparedCase]
    evidence: str

    def worse(self, tolerance: float) -> list[str]:
        """Return in sentences why B is worse than A; empty where it is not.

        At some level B reached the merge point in no case of its campaign, or one of these grew by
        more than the tolerance: the share of cases with an error, the share of cases with an error
        or a timeout, FMC.
        """
        return [
            why for level, found in self.levels.items() for why in _worse(level, found, tolerance)
        ]

    def to_record(self) -> dict[str, Any]:
        """Return what `--json` prints."""
        return asdict(self)

    def lines(self) -> list[str]:
        """Return a table of what changed, level by level, and how that is known."""
        said = [
            f"{'level':<6} {'FMC A':>8} {'FMC B':>8} {'fixed':>8} {'broke':>8}   "
            f"cases: {', '.join(Change)}"
        ]
        for level, found in self.levels.items():
            changes = ", ".join(str(found.changes[change]) for change in Change)
            said.append(
                f"{level_name(level):<6} {found.fmc_a:8.4f} {found.fmc_b:8.4f} "
                f"{found.fmc_fixed:8.4f} {found.fmc_broke:8.4f}   {changes}"
            )
        return [*said, f"evidence: {self.evidence}"]

    def __repr__(self) -> str:
        """Return FMC of both in a line."""
        levels = (
            f"level {level_name(level)}: FMC {found.fmc_a:.4f} -> {found.fmc_b:.4f}"
            for level, found in self.levels.items()
        )
        return f"<RunComparison: {', '.join(levels)}>"

    def look_first(self) -> list[ComparedCase]:
        """Return the cases to look at first: those that broke, then those without a verdict."""
        telling = (Change.BROKE, Change.NO_VERDICT_OF_B, Change.NOT_RUN_AGAIN)
        return [case for case in self.cases if case.change in telling][:FIRST_LOOKS]


def _worse(level: int, found: LevelChange, tolerance: float) -> list[str]:
    at, a, b = f"at POV level {level_name(level)}", found.untested_a, found.untested_b
    why = []
    if b.nothing_tested:
        why.append(f"{at} B reached the merge point in no case of its campaign")
    for what, number_a, number_b in (
        ("error", a.errors, b.errors),
        ("error or timeout", a.errors + a.timeouts, b.errors + b.timeouts),
    ):
        if b.share(number_b) - a.share(number_a) > tolerance + SHARE_ROUNDING:
            why.append(
                f"{at} B has an {what} in {number_b} of {counted(b.cases, 'case')}, "
                f"A in {number_a} of {a.cases}"
            )
    if found.fmc_b - found.fmc_a > tolerance + VOLUME_NOISE * found.fmc_b:
        why.append(f"{at} FMC is {found.fmc_b:.4f} with B, {found.fmc_a:.4f} with A")
    return why
