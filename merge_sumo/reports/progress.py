"""What a person sees while something runs: bars on standard error, with rates."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn

from merge_sumo.system.printable import printable

if TYPE_CHECKING:
    from merge_sumo.training.check import PolicyCheck
    from merge_sumo.training.helix import TrainingProgress


PER: Final = ((1.0, "s"), (60.0, "min"), (3600.0, "h"))
"""Seconds of what a rate may be per; the first at which it is 1 or more is taken."""
LINES: Final = 10
"""Lines that are said of what goes on where there is no terminal to draw on."""


@dataclass(slots=True)
class Work:
    """Progress of some work: items done of a total, and its time by the monotonic clock.

    What was done `before` a resume says nothing of the rate; `said` is what was done when a line
    was last said of it.
    """

    total: int
    start_s: float
    done: int = 0
    before: int = 0
    end_s: float | None = None
    said: int = 0

    @property
    def elapsed_s(self) -> float:
        """Seconds that it has taken so far."""
        return (time.monotonic() if self.end_s is None else self.end_s) - self.start_s

    @property
    def left_s(self) -> float | None:
        """Seconds that are left at the rate so far; None where nothing was done yet."""
        done = self.done - self.before
        if self.done >= self.total:
            return 0.0
        return (self.total - self.done) * self.elapsed_s / done if done > 0 else None

    def is_due(self) -> bool:
        """Return whether to say a line where there is no terminal: after each tenth, and last."""
        since = self.done - self.said
        due = since >= -(-self.total // LINES) or (self.done >= self.total and since > 0)
        self.said = self.done if due else self.said
        return due


def rate_text(count: float, elapsed_s: float, unit: str) -> str:
    """Return a rate as people read it: "7,140 cases/s", "12 cases/s", "3.5 cases/min"."""
    if count <= 0.0 or elapsed_s <= 0.0:
        return f"- {unit}/s"
    rates = [(count / elapsed_s * seconds, name) for seconds, name in PER]
    rate, per = next(((rate, name) for rate, name in rates if rate >= 1.0), rates[-1])
    return f"{rate:,.0f} {unit}/{per}" if rate >= 10.0 else f"{rate:.1f} {unit}/{per}"


def clock_text(duration_s: float) -> str:
    """Return a duration as a clock shows it: "0:05", "12:30", "2:00:00"."""
    whole_s = round(duration_s)
    hours, minutes = divmod(whole_s // 60, 60)
    return f"{hours}:{minutes:02d}:{whole_s % 60:02d}" if hours else f"{minutes}:{whole_s % 60:02d}"


def notebook() -> Any:
    """Return IPython's display module where this runs in a notebook, else None."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    if getattr(shell, "kernel", None) is None:
        return None
    from importlib import import_module

    return import_module("IPython.display")


def is_watched() -> bool:
    """Return whether a person sees what this process shows: in a notebook or on a terminal."""
    return notebook() is not None or sys.stderr.isatty()


class Bars:
    """Progress bars by title; the first appears with the first thing that is counted.

    So a command that is refused shows its sentence and no bar. Where there is no terminal to draw
    on, a line stands after every tenth of a bar.
    """

    def __init__(self, console: Console | None = None, *, shown: bool | None = True) -> None:
        """Show nothing yet, or never where it is not to be `shown`; None is where it is watched."""
        self._console = console or Console(stderr=True)
        self._is_shown = is_watched() if shown is None else shown
        self._progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}", markup=False),
            console=self._console,
        )
        self._tasks: dict[str, TaskID] = {}
        self._work: dict[str, Work] = {}
        self._opened_s = time.monotonic()

    def _work_of(self, title: str, total: int) -> Work:
        # What ends first began before: with the others, or when the bar before was full.
        return self._work.setdefault(title, Work(total, self._opened_s))

    def show(self, title: str, completed: int, total: int, note: str) -> None:
        """Set a bar."""
        work = self._work_of(title, total)
        work.done = completed
        left_s = work.left_s if completed < total else None
        left = "" if left_s is None else f"{clock_text(left_s)} left"
        said = "  ".join(filter(None, (note.strip(), left)))
        if self._is_shown and not self._console.is_terminal:
            if work.is_due():
                line = f"{printable(title)}: {completed:,}/{total:,}, {said}"
                self._console.print(line, highlight=False, markup=False, soft_wrap=True)
        elif self._is_shown and title in self._tasks:
            self._progress.update(self._tasks[title], completed=completed, note=said)
        elif self._is_shown:
            self._progress.start()
            self._tasks[title] = self._progress.add_task(
                printable(title), total=total, completed=completed, note=said
            )
        if completed >= total:
            self._opened_s = time.monotonic()

    def counted(self, title: str, done: int, total: int, unit: str, note: str = "") -> None:
        """Set a bar that counts things called `unit`, with their rate."""
        elapsed_s = self._work_of(title, total).elapsed_s
        self.show(title, done, total, f"{rate_text(done, elapsed_s, unit)}  {note}")

    def say(self, text: str) -> None:
        """Print a line above the bars."""
        if self._is_shown:
            self._console.print(text)

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


class TrainingBars(Bars):
    """A bar per network with return and share of crashes, and its regret when it is finished."""

    def __init__(self, *, shown: bool | None = True) -> None:
        super().__init__(shown=shown)
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
