"""Progress of campaigns and studies: bars on a terminal, elsewhere lines of text."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn

from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.summary import summarise
from merge_sumo.printable import counted, printable
from merge_sumo.reports.report import REPORT

LINE_S = 60.0
"""Minimum time between two lines of a bar without a terminal."""
REDRAWN_S = 0.25
"""Minimum time between two pictures of a bar on a terminal."""


def is_watched() -> bool:
    """Return whether this process runs in a notebook or on a terminal."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return getattr(shell, "kernel", None) is not None or sys.stderr.isatty()


@dataclass(slots=True)
class _Bar:
    """A bar.

    Attributes:
        start_s: time of its first update.
        before: count at its first update.
        shown_s: time at which it was last shown; minus infinity before that.
        shown: count that was last shown.
        task: task of rich; None while nothing is drawn.
    """

    start_s: float
    before: int
    shown_s: float = -math.inf
    shown: int = 0
    task: TaskID | None = None


class Bars:
    """Progress bars by title; a bar appears with its first update.

    Without a terminal, they print a line at the beginning, every minute, and at the end.

    Example:
        >>> with Bars() as bars:
        ...     for done in range(101):
        ...         bars.counted("cases", done, 100, "cases")
    """

    def __init__(self, console: Console | None = None, *, shown: bool | None = True) -> None:
        """Show nothing yet.

        Args:
            console: where to print; by default standard error.
            shown: whether to show anything; None for only on a terminal and in a notebook.
        """
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

    def counted(
        self, title: str, done: int, total: int, unit: str, note: str | Callable[[], str] = ""
    ) -> None:
        """Update a bar, with the rate and the remaining time since its first update.

        Args:
            title: title of the bar.
            done: number of finished items.
            total: number of all items.
            unit: name of the items.
            note: text after the bar, or a function that makes it when it is shown.
        """
        now_s = time.monotonic()
        bar = self._bars.setdefault(title, _Bar(now_s, done))
        every_s = REDRAWN_S if self._console.is_terminal else LINE_S
        is_due = now_s - bar.shown_s >= every_s
        is_last = done >= total and done > bar.shown
        if not self._is_shown or not (is_due or is_last):
            return
        bar.shown, bar.shown_s = done, now_s
        parts = [note if isinstance(note, str) else note()]
        finished, elapsed_s = done - bar.before, now_s - bar.start_s
        if finished > 0 and elapsed_s > 0.0:
            per_s = finished / elapsed_s
            parts.append(f"{per_s:,.2f} {unit}/s")
            if done < total:
                parts.append(f"{timedelta(seconds=round((total - done) / per_s))} left")
        text = "  ".join(filter(None, parts))
        if not self._console.is_terminal:
            self.say(f"{printable(title)}: {done:,}/{total:,}  {text}")
            return
        if bar.task is None:
            self._progress.start()
            bar.task = self._progress.add_task(printable(title), total=total, note="")
        self._progress.update(bar.task, completed=done, note=text)

    def counter(self, title: str, total: int, unit: str) -> Callable[[int], None]:
        """Return a function that counts further items that have finished.

        Args:
            title: title of the bar.
            total: number of all items.
            unit: name of the items.
        """
        finished = 0

        def ended(count: int) -> None:
            nonlocal finished
            finished += count
            self.counted(title, finished, total, unit)

        ended(0)
        return ended

    def say(self, text: str) -> None:
        """Print a line above the bars.

        Args:
            text: the line.
        """
        if self._is_shown:
            self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        """Keep the bars; remove them if an error stopped the work."""
        # Ctrl-C may come between the start of the drawing and the first bar.
        if self._progress.live.is_started:
            self._progress.live.transient = error is not None
            self._progress.stop()


class CampaignBars(Bars):
    """Bars of a campaign and of the studies at its end; `ended` is a callback of the campaign."""

    def __init__(
        self,
        folder: Path,
        cases: int,
        tolerated: float = 0.0,
        *,
        shown: bool | None = True,
        console: Console | None = None,
    ) -> None:
        """Show nothing yet.

        Args:
            folder: folder of the campaign.
            cases: number of all cases.
            tolerated: share of its runs in which a case may fail.
            shown: as for `Bars`.
            console: as for `Bars`.
        """
        super().__init__(console, shown=shown)
        self._folder, self._cases, self._tolerated = folder, cases, tolerated
        self._outcomes: list[Outcome] = []

    def begin(self, title: str, before: Sequence[Outcome] = ()) -> None:
        """Print the title and the path of the report.

        Args:
            title: title of the campaign.
            before: outcomes of a campaign that is resumed; they do not count in the rate.
        """
        cases = counted(self._cases, "case")
        self.say(f"{printable(title)}: {cases}, watch {printable(str(self._folder / REPORT))}")
        self.ended(before)

    def ended(self, outcomes: Sequence[Outcome]) -> None:
        """Count cases.

        Args:
            outcomes: outcomes of cases that have finished.
        """
        self._outcomes += outcomes
        self.counted("cases", len(self._outcomes), self._cases, "cases", self._found)

    def _found(self) -> str:
        return summarise(self._outcomes, tolerated=self._tolerated).found
