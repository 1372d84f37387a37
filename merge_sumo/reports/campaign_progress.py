"""How far a campaign is: its phases with their counts and rates, the time left, what it found."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from enum import StrEnum
from typing import Final

from merge_sumo.analysis.verdict import in_counts
from merge_sumo.campaigns.store import failures
from merge_sumo.reports.progress import Work, clock_text, rate_text
from merge_sumo.studies.counterfactuals import MOST
from merge_sumo.system.printable import printable
from merge_sumo.values.case import Case, to_unit
from merge_sumo.values.chance import RunsOfCase, fails_above
from merge_sumo.values.fmc import fmc
from merge_sumo.values.score import Outcome
from merge_sumo.values.trajectory import End


class Phase(StrEnum):
    """What a campaign does, in this order."""

    CASES = "cases"
    CAREFUL = "careful drivers"
    REPORT = "report"


UNITS: Final = {Phase.CASES: "cases", Phase.CAREFUL: "failures", Phase.REPORT: "parts"}
"""What is counted in each phase."""
FAILURE_S: Final = 0.02
"""Expected time per failure and worker of the phase `CAREFUL`, before it is measured.

4.8 s for 238 failures of `design1` on one worker of a server of 2023.
"""
LEVEL_S: Final = 1.5
"""Expected time per level of the phase `REPORT`: 4.5 s for the three levels of 400 cases."""
KEPT: Final = 2000
"""Newest outcomes, and newest failures, that are kept for the drawing."""
WORST: Final = 10
"""Listed failures."""


class CampaignProgress:
    """Counts the cases of a campaign and the parts of what follows them."""

    def __init__(
        self,
        title: str,
        cases: int,
        levels: Sequence[int],
        workers: int = 1,
        *,
        tolerated: float = 0.0,
    ) -> None:
        self.title = printable(title)
        self.phase = Phase.CASES
        self.work = {Phase.CASES: Work(cases, time.monotonic())}
        self.cases = dict.fromkeys(levels, 0)
        self.failing: dict[int, dict[int, Case]] = {level: {} for level in levels}
        """Cases that fail in more than a tolerated share of their runs, by their first run."""
        self._tolerated = tolerated
        self._runs: dict[Case, list[Outcome]] = {}
        """Runs with a verdict of the last case with a start."""
        self.fmc = dict.fromkeys(levels, 0.0)
        """Coverage of the failures of a level when `refresh` was last called."""
        self.errors = self.timeouts = 0
        self.newest: deque[Outcome] = deque(maxlen=KEPT)
        self.failures: deque[Outcome] = deque(maxlen=KEPT)
        self.worst: list[Outcome] = []
        self.workers = workers
        self._stale: set[int] = set()

    def case_ended(self, outcome: Outcome) -> None:
        """Count a case."""
        level = outcome.case.level
        self.work[Phase.CASES].done += 1
        # After --force, a campaign may have cases of a level outside its settings.
        self.cases[level] = self.cases.get(level, 0) + 1
        self.errors += outcome.measures.end.is_error
        self.timeouts += outcome.measures.end is End.TIMEOUT
        self.newest.append(outcome)
        if outcome.score is not None:
            self._count_run(outcome)
        if outcome.failed:
            self.failures.append(outcome)
            self.worst = failures([*self.worst, outcome])[:WORST]

    def _count_run(self, outcome: Outcome) -> None:
        """Count a run of a case: it may make the case a failing one, or none any more."""
        start, level = outcome.case.start, outcome.case.level
        if outcome.case.draw == 0 or start not in self._runs:
            self._runs[start] = []
        runs = self._runs[start]
        runs.append(outcome)
        failing, first = self.failing.setdefault(level, {}), runs[0].index
        if fails_above(RunsOfCase(start, tuple(runs)), self._tolerated):
            failing[first] = start
        elif first in failing:
            del failing[first]
        else:
            return
        self._stale.add(level)

    def ran_before(self, outcome: Outcome) -> None:
        """Count a case that ran before a resume; it does not count for the rate."""
        self.case_ended(outcome)
        work = self.work[Phase.CASES]
        work.before = work.said = work.done
        work.start_s = time.monotonic()

    def advance(self, phase: Phase, done: int, total: int) -> None:
        """Set the progress of a phase after the cases; the phase before it has ended."""
        if phase not in self.work:
            now_s = time.monotonic()
            self.work[self.phase].end_s = now_s
            self.phase, self.work[phase] = phase, Work(total, now_s)
        self.work[phase].done = done

    def refresh(self) -> None:
        """Bring the coverages up to date."""
        for level in self._stale:
            self.fmc[level] = fmc(to_unit(self.failing[level].values(), level))
        self._stale.clear()

    @property
    def left_s(self) -> float | None:
        """Seconds until the report is written, at the rate of this phase; None if unknown."""
        left_s = self.work[self.phase].left_s
        if left_s is None:
            left_s = self._expected_s(self.phase)
        to_come = list(Phase)[list(Phase).index(self.phase) + 1 :]
        expected = [self._expected_s(phase) for phase in to_come]
        return None if left_s is None else left_s + sum(s for s in expected if s is not None)

    def _expected_s(self, phase: Phase) -> float | None:
        """Return the expected time of a phase; None for the cases, whose rate is unknown."""
        if phase is Phase.CASES:
            return None
        if phase is Phase.REPORT:
            return LEVEL_S * len(self.cases)
        cases = self.work[Phase.CASES]
        found = sum(map(len, self.failing.values()))
        if self.phase is Phase.CASES:
            found = round(found * max(cases.total, cases.done) / max(cases.done, 1))
        return FAILURE_S * min(found, MOST) / self.workers

    @property
    def found(self) -> str:
        """The numbers of errors, timeouts and failures in words."""
        failures = sum(map(len, self.failing.values()))
        return ", ".join(in_counts(self.errors, self.timeouts, failures))

    @property
    def left(self) -> str:
        """The time that is left for the whole, in words; empty where nobody knows."""
        return "" if self.left_s is None else f"about {clock_text(self.left_s)} left"

    def count(self, phase: Phase) -> str:
        """Return how far a phase is: "40/800 cases"; empty where it has not begun."""
        work = self.work.get(phase)
        return "" if work is None else f"{work.done}/{work.total} {UNITS[phase]}"

    def rate(self, phase: Phase) -> str:
        """Return the rate of a phase in words; empty where it has none, as parts of a report."""
        work = self.work.get(phase)
        if work is None or work.done == work.before or phase is Phase.REPORT:
            return ""
        return rate_text(work.done - work.before, work.elapsed_s, UNITS[phase])

    @property
    def line(self) -> str:
        """How far the campaign is, in a line."""
        named = "" if self.phase is Phase.CASES else f"{self.phase}, "
        found = [self.found] if self.phase is Phase.CASES else []
        parts = [self.count(self.phase), *found, self.rate(self.phase), self.left]
        return f"{self.title}: {named}{', '.join(filter(None, parts))}"
