"""Progress of what runs: bars on a terminal, elsewhere a line now and then."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn

from merge_sumo.metrics.cause import failure_boxes
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.summary import judge, one_per_case
from merge_sumo.printable import counted, printable
from merge_sumo.reports.report import REPORT
from merge_sumo.scenario.scenario import level_name

PER = ((1.0, "s"), (60.0, "min"), (3600.0, "h"))
"""Seconds of what a rate may be per; the first at which it is 1 or more is taken."""
LINES = 10
"""Maximum number of progress lines without a terminal."""


def rate_text(count: float, elapsed_s: float, unit: str) -> str:
    """Return a readable rate: "7,140 cases/s", "12 cases/s", "3.5 cases/min".

    Args:
        count: number of things done.
        elapsed_s: time that they took.
        unit: name of the things.
    """
    if count <= 0.0 or elapsed_s <= 0.0:
        return f"- {unit}/s"
    rates = [(count / elapsed_s * seconds, name) for seconds, name in PER]
    rate, per = next(((rate, name) for rate, name in rates if rate >= 1.0), rates[-1])
    return f"{rate:,.0f} {unit}/{per}" if rate >= 10.0 else f"{rate:.1f} {unit}/{per}"


def is_watched() -> bool:
    """Return whether this process runs in a notebook or on a terminal."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return getattr(shell, "kernel", None) is not None or sys.stderr.isatty()


@dataclass(slots=True)
class _Bar:
    """A bar: its total, since when it counts, and how much was done before.

    `said` and `said_s` are what was done, and when, as it was last shown; `task` draws it.
    """

    total: int
    start_s: float
    before: int = 0
    said: int = 0
    said_s: float = -1e9
    task: TaskID | None = None

    def is_due(self, done: int, *, drawn: bool) -> bool:
        """Return whether to show it: on a terminal what is fresh, else a tenth; the end always.

        Where things take long, each of them is.
        """
        now_s = time.monotonic()
        since, since_s = done - self.said, now_s - self.said_s
        # Time after which every new count is printed.
        slow = now_s - max(self.said_s, self.start_s) >= 60.0
        enough = drawn or since * LINES >= self.total or (since > 0 and slow)
        # Minimum time between two of these lines.
        # Maximum age of a bar on a terminal.
        due = enough and since_s >= (0.25 if drawn else 1.0)
        if due or (done >= self.total and since > 0):
            self.said, self.said_s = done, now_s
            return True
        return False

    def note(self, done: int, unit: str) -> str:
        """Return the rate, and the time that is left at it."""
        counted, elapsed_s = done - self.before, time.monotonic() - self.start_s
        rate = rate_text(counted, elapsed_s, unit)
        if done >= self.total or counted <= 0:
            return rate
        left = timedelta(seconds=round((self.total - done) * elapsed_s / counted))
        return f"{rate}  {left} left"


class Bars:
    """Progress bars by title; the first appears with the first thing that is counted.

    So a command that is refused shows its sentence and no bar. Where there is no terminal to draw
    on, a line stands after every tenth of a bar.
    """

    def __init__(self, console: Console | None = None, *, shown: bool | None = True) -> None:
        """Show nothing yet, or never where it is not to be `shown`; None is where it is watched."""
        self._console = console or Console(stderr=True, force_jupyter=False)
        self._is_shown = is_watched() if shown is None else shown
        self._progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}", markup=False),
            console=self._console,
        )
        self._bars: dict[str, _Bar] = {}
        self._opened_s = time.monotonic()

    def counted(
        self, title: str, done: int, total: int, unit: str, note: str | Callable[[], str] = ""
    ) -> None:
        """Set a bar that counts things called `unit`, with their rate and the time left.

        A `note` that takes time to make is a function; it is called when it is shown.

        Args:
            title: title of the bar.
            done: number of things done.
            total: number of all things.
            unit: name of the things.
            note: text after the bar.
        """
        # What ends first began before: with the others, or when the bar before was full.
        start_s = self._opened_s if done else time.monotonic()
        bar = self._bars.setdefault(title, _Bar(total, start_s))
        if done >= total:
            self._opened_s = time.monotonic()
        drawn = self._console.is_terminal
        if not (self._is_shown and bar.is_due(done, drawn=drawn)):
            return
        text = note if isinstance(note, str) else note()
        said = "  ".join(filter(None, (text.strip(), bar.note(done, unit))))
        if not drawn:
            self.say(f"{printable(title)}: {done:,}/{total:,}  {said}")
            return
        if bar.task is None:
            self._progress.start()
            bar.task = self._progress.add_task(printable(title), total=total, note="")
        self._progress.update(bar.task, completed=done, note=said)

    def say(self, text: str) -> None:
        """Print a line above the bars."""
        if self._is_shown:
            self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        """Leave the bars as they are; remove them where the work was stopped."""
        # Not by the bars: Ctrl-C may have come before the first of them was noted.
        if self._progress.live.is_started:
            self._progress.live.transient = error is not None
            self._progress.stop()


class Counter(Bars):
    """A bar that counts things called `unit`, with their rate."""

    def __init__(self, title: str, total: int, unit: str, *, shown: bool | None = True) -> None:
        super().__init__(shown=shown)
        self._title, self._total, self._unit = title, total, unit
        self._count = 0

    def ended(self, count: int, note: str = "") -> None:
        """Count things that have ended."""
        self._count += count
        self.counted(self._title, self._count, self._total, self._unit, note)


class CampaignBars(Bars):
    """Bars of a campaign and its careful drivers: `ended` is a callback of the campaign."""

    def __init__(
        self,
        folder: Path,
        cases: int,
        tolerated: float = 0.0,
        *,
        shown: bool | None = True,
        console: Console | None = None,
    ) -> None:
        super().__init__(console, shown=shown)
        self._folder, self._cases, self._tolerated = folder, cases, tolerated
        self._outcomes: list[Outcome] = []

    def begin(self, title: str, before: Sequence[Outcome] = ()) -> None:
        """Print what begins, and where its report is: the first case may take long.

        Cases that ran `before` a resume do not count in the rate.
        """
        cases = counted(self._cases, "case")
        self.say(f"{printable(title)}: {cases}, watch {printable(str(self._folder / REPORT))}")
        self._outcomes += before
        self._bars["cases"] = _Bar(self._cases, time.monotonic(), len(before))
        self.counted("cases", len(before), self._cases, "cases")

    def ended(self, outcomes: Sequence[Outcome]) -> None:
        """Count cases."""
        before = len(self._outcomes)
        self._outcomes += outcomes
        self.counted("cases", len(self._outcomes), self._cases, "cases", self._found)
        # Cases after which a campaign of more prints where failures lie so far.
        if before < 100 <= len(self._outcomes) < self._cases:
            self._say_where()

    def _say_where(self) -> None:
        """Print where the failures so far lie, in the largest region of each level."""
        cases = one_per_case(self._outcomes, self._tolerated)
        self.say(f"so far {judge(self._outcomes, self._tolerated).counts}")
        for level in sorted({outcome.case.level for outcome in cases}):
            for box in failure_boxes(cases, level)[:1]:
                inside = f"{box.failures} of {counted(box.cases, 'case')} fail"
                self.say(f"  POV level {level_name(level)}, {box.where}: {inside}")

    def _found(self) -> str:
        return ", ".join(judge(self._outcomes, self._tolerated).found)
