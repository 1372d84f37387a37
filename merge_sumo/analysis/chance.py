"""What the repeats of a campaign show of chance, in a few numbers."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

from merge_sumo.values.chance import MOST_RUNS, by_case, fails_above, is_decided
from merge_sumo.values.score import Outcome


@dataclass(frozen=True, slots=True)
class ChanceSummary:
    """Cases of a campaign that ran more than once.

    Attributes:
        runs: runs of all cases, those that ran once among them.
        cases: cases.
        repeated: cases that ran more than once.
        varied: those of them whose runs differ in a measure: chance is in them.
        both_ways: those of them that fail in some runs and pass in others.
        tolerated: the share of its runs in which a case may fail.
        failures: cases that fail in more than that.
        undecided: failing cases that ran too seldom to tell (`is_decided`).
    """

    runs: int
    cases: int
    repeated: int
    varied: int
    both_ways: int
    tolerated: float
    failures: int
    undecided: int

    def to_record(self) -> dict[str, Any]:
        """Return what JSON shows."""
        return asdict(self)


def chance_in(outcomes: Iterable[Outcome], tolerated: float = 0.0) -> ChanceSummary | None:
    """Return what repeats show; None where no case ran more than once and none is tolerated."""
    known = list(outcomes)
    if not (tolerated or any(outcome.case.draw for outcome in known)):
        return None
    cases = by_case(known)
    repeated = [one for one in cases if one.runs > 1]
    failing = [one for one in cases if fails_above(one, tolerated)]
    varied = [one for one in repeated if one.varies]
    untold = [
        one
        for one in failing
        if tolerated and one.runs < MOST_RUNS and not is_decided(one.failures, one.runs, tolerated)
    ]
    return ChanceSummary(
        runs=sum(one.runs for one in cases),
        cases=len(cases),
        repeated=len(repeated),
        varied=len(varied),
        both_ways=sum(0 < one.failures < one.runs for one in varied),
        tolerated=tolerated,
        failures=len(failing),
        undecided=len(untold),
    )
