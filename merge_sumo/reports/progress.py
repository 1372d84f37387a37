"""What a person sees while something runs: a panel or bars on standard error, with rates."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from html import escape
from typing import TYPE_CHECKING, Any, Final, Self

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
)
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from merge_sumo.reports.verdict import in_counts
from merge_sumo.system.printable import printable
from merge_sumo.values.case import Case, to_unit
from merge_sumo.values.fmc import fmc
from merge_sumo.values.scenario import level_name
from merge_sumo.values.score import Outcome
from merge_sumo.values.trajectory import End

if TYPE_CHECKING:
    from merge_sumo.training.check import PolicyCheck
    from merge_sumo.training.helix import TrainingProgress


def rate_text(count: float, elapsed_s: float, unit: str) -> str:
    """Return a rate as people read it: "7,140 cases/s", "12 cases/s", "3.5 cases/min"."""
    if count <= 0.0 or elapsed_s <= 0.0:
        return f"- {unit}/s"
    per_s = count / elapsed_s
    rate, per = next(
        ((per_s * seconds, name) for seconds, name in PER if per_s * seconds >= 1.0),
        (per_s * PER[-1][0], PER[-1][1]),
    )
    return f"{rate:,.0f} {unit}/{per}" if rate >= 10.0 else f"{rate:.1f} {unit}/{per}"


PER: Final = ((1.0, "s"), (60.0, "min"), (3600.0, "h"))
"""Seconds of what a rate may be per; the first at which it is 1 or more is taken."""


def left_text(count: int, total: int, elapsed_s: float) -> str:
    """Return how long it takes still, at the rate so far; empty where nobody knows."""
    if count <= 0:
        return ""
    left_s = round((total - count) * elapsed_s / count)
    hours, minutes = divmod(left_s // 60, 60)
    return (
        f"{hours}:{minutes:02d}:{left_s % 60:02d} left"
        if hours
        else (f"{minutes}:{left_s % 60:02d} left")
    )


def _notebook() -> Any:
    """Return IPython's display module where this runs in a notebook, else None."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    if getattr(shell, "kernel", None) is None:
        return None
    from importlib import import_module

    return import_module("IPython.display")


def _both(html: str, text: str) -> dict[str, str]:
    """Return what a notebook shows, and what it shows where it can show text alone."""
    return {"text/html": html, "text/plain": text}


def is_watched() -> bool:
    """Return whether a person sees what this process shows: in a notebook or on a terminal."""
    return _notebook() is not None or sys.stderr.isatty()


PLAIN_LINES: Final = 10
"""Lines that are said of what goes on where there is no terminal to draw on."""


def _tenth(total: int) -> int:
    return -(-total // PLAIN_LINES)


class Bars:
    """Progress bars by title; the first appears with the first thing that is counted.

    So a command that is refused shows its sentence and no bar. Where there is no terminal to draw
    on, a line stands after every tenth of a bar.
    """

    def __init__(self, console: Console | None = None) -> None:
        """Show nothing yet."""
        self._console = console or Console(stderr=True)
        self._progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}", markup=False),
            console=self._console,
        )
        self._tasks: dict[str, TaskID] = {}
        self._start_s: dict[str, float] = {}
        self._shown: dict[str, int] = {}
        """How much of each bar was done in its last line."""
        self._opened_s = time.monotonic()

    def show(self, title: str, completed: int, total: int, note: str) -> None:
        """Set a bar."""
        if title not in self._start_s:
            # What ends first began before: with the others, or when the bar before was full.
            self._start_s[title] = self._opened_s
        left = left_text(completed, total, self.elapsed_s(title)) if completed < total else ""
        said = "  ".join(filter(None, (note.strip(), left)))
        if not self._console.is_terminal:
            self._say_line(title, completed, total, said)
        elif title in self._tasks:
            self._progress.update(self._tasks[title], completed=completed, note=said)
        else:
            self._progress.start()
            self._tasks[title] = self._progress.add_task(
                printable(title), total=total, completed=completed, note=said
            )
        if completed >= total:
            self._opened_s = time.monotonic()

    def _say_line(self, title: str, completed: int, total: int, said: str) -> None:
        since = completed - self._shown.get(title, 0)
        if since >= _tenth(total) or (completed >= total and since):
            self._shown[title] = completed
            line = f"{printable(title)}: {completed:,}/{total:,}, {said}"
            self._console.print(line, highlight=False, markup=False, soft_wrap=True)

    def say(self, text: str) -> None:
        """Print a line above the bars."""
        self._console.print(text)

    def elapsed_s(self, title: str) -> float:
        """Return the seconds since the work of a bar began."""
        return time.monotonic() - self._start_s.get(title, self._opened_s)

    def __enter__(self) -> Self:
        """Return the bars."""
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the bars as they are."""
        if self._tasks:
            self._progress.stop()


class Counter(Bars):
    """A bar that counts things called `unit`, with their rate."""

    def __init__(self, title: str, total: int, unit: str) -> None:
        """Count up to `total`."""
        super().__init__()
        self._title, self._total, self._unit = title, total, unit
        self._count = 0

    def ended(self, count: int, note: str = "") -> None:
        """Count things that have ended."""
        self._count += count
        rate = rate_text(self._count, self.elapsed_s(self._title), self._unit)
        self.show(self._title, self._count, self._total, f"{rate}  {note}")


FRESH_S: Final = 0.5
"""Seconds for which a coverage that is shown may be old."""


class CampaignPanel:
    """What a campaign has found so far, on standard error.

    A live panel on a terminal, a line after every tenth of the cases elsewhere, nothing when quiet.
    It appears with the first case, so a command that is refused shows its sentence and no panel.
    """

    def __init__(
        self,
        title: str,
        cases: int,
        levels: Sequence[int],
        *,
        quiet: bool = False,
        console: Console | None = None,
    ) -> None:
        """Show nothing yet."""
        self._title, self._total, self._quiet = printable(title), cases, quiet
        self._console = console or Console(stderr=True)
        self._live: Live | None = None
        self._start_s = time.monotonic()
        self._fresh_s = 0.0
        self._update: Callable[[str, str], None] | None = None
        """Replaces what a notebook shows, as HTML and as text."""
        self._before = 0
        """Cases that ran before this process took over."""
        self._ran = self._errors = self._timeouts = 0
        self._cases = dict.fromkeys(levels, 0)
        self._failing: dict[int, list[Case]] = {level: [] for level in levels}
        self._fmc = dict.fromkeys(levels, 0.0)
        self._stale: set[int] = set()

    def case_ended(self, outcome: Outcome) -> None:
        """Count a case."""
        if self._ran == self._before:
            self._appear()
        self._count(outcome)
        if self._live is not None or self._update is not None:
            if time.monotonic() - self._fresh_s > FRESH_S:
                self._refresh()
        elif not self._quiet and self._is_plain_line():
            self._console.print(self._line(), highlight=False, markup=False, soft_wrap=True)

    def ran_before(self, outcome: Outcome) -> None:
        """Count a case that ran before: it says nothing of how fast this goes."""
        self._count(outcome)
        self._before += 1
        self._start_s = time.monotonic()

    def _appear(self) -> None:
        if self._quiet:
            return
        notebook = _notebook()
        if notebook is not None:
            shown = notebook.display(_both("", ""), raw=True, display_id=True)
            self._update = lambda html, text: shown.update(_both(html, text), raw=True)
        elif self._console.is_terminal:
            self._live = Live(console=self._console, get_renderable=self._panel)
            self._live.start()

    def _count(self, outcome: Outcome) -> None:
        level = outcome.case.level
        self._ran += 1
        # A campaign that was forced on may have cases of a level that it has no more.
        self._cases[level] = self._cases.get(level, 0) + 1
        self._errors += outcome.measures.end.is_error
        self._timeouts += outcome.measures.end is End.TIMEOUT
        if outcome.failed:
            self._failing.setdefault(level, []).append(outcome.case)
            self._stale.add(level)

    def _is_plain_line(self) -> bool:
        return self._ran % _tenth(self._total) == 0 or self._ran == self._total

    def _refresh(self) -> None:
        """Bring the coverages up to date."""
        for level in self._stale:
            self._fmc[level] = fmc(to_unit(self._failing[level], level))
        self._stale.clear()
        self._fresh_s = time.monotonic()
        if self._update is not None:
            bar = f'<progress value="{self._ran}" max="{self._total}"></progress>'
            self._update(f"{bar} {escape(self._line())}", self._line())

    def _rate(self) -> str:
        return rate_text(self._ran - self._before, time.monotonic() - self._start_s, "cases")

    def _left(self) -> str:
        elapsed_s = time.monotonic() - self._start_s
        return left_text(self._ran - self._before, self._total - self._before, elapsed_s)

    def _found(self) -> str:
        failures = sum(map(len, self._failing.values()))
        return ", ".join(in_counts(self._errors, self._timeouts, failures))

    def _line(self) -> str:
        return (
            f"{self._title}: {self._ran}/{self._total} cases, {self._found()}, "
            f"{self._rate()}, {self._left()}"
        )

    def _panel(self) -> Panel:
        head = Table.grid(padding=(0, 2))
        head.add_row(
            ProgressBar(total=self._total, completed=self._ran, width=30),
            f"{self._ran}/{self._total} cases",
            self._found(),
            self._rate(),
            self._left(),
        )
        table = Table(box=None, padding=(0, 2), pad_edge=False, header_style="dim")
        table.add_column("POV level")
        for name in ("cases", "failures", "FMC so far"):
            table.add_column(name, justify="right")
        for level, cases in self._cases.items():
            failing = len(self._failing.get(level, ()))
            style = "bold dark_orange" if failing else ""
            table.add_row(
                *(level_name(level), str(cases), Text(str(failing), style)),
                f"{self._fmc.get(level, 0.0):.4f}",
            )
        title = Text(self._title)
        return Panel(Group(head, "", table), title=title, title_align="left", expand=False)

    def __enter__(self) -> Self:
        """Return the panel."""
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the last state on the terminal."""
        if self._live is not None or self._update is not None:
            self._refresh()
        if self._live is not None:
            self._live.stop()


class TrainingBars(Bars):
    """A bar per network with return and share of crashes, and its regret when it is finished."""

    def __init__(self) -> None:
        """Show nothing yet."""
        super().__init__()
        self._regret: dict[str, str] = {}

    def progressed(self, now: TrainingProgress) -> None:
        """Show where a network is."""
        note = f"return {now.mean_return:.3f}"
        if now.crash_share is not None:
            note += f"  crashes {now.crash_share:.2%}"
        if now.regret is not None:
            self._regret[now.network] = f"  regret at least {now.regret:.2%}"
        note += self._regret.get(now.network, "")
        self.show(f"{now.network} {now.stage}", now.done, now.total, note)

    def done(self, name: str, check: PolicyCheck | None) -> None:
        """Say how a network turned out, or that it was there already."""
        if check is None:
            self.say(f"{name} is there already: same seed, settings, opponent")
        else:
            self.say(
                f"{name}: mean regret {check.mean_regret:.2%}, "
                f"{check.avoidable_collisions} avoidable collisions in {check.cases} cases"
            )
