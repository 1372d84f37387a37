"""What a person sees while something runs."""

from __future__ import annotations

from types import TracebackType
from typing import TYPE_CHECKING, Self

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)

from merge_sumo.score import Outcome

if TYPE_CHECKING:
    from merge_sumo.training.check import PolicyCheck
    from merge_sumo.training.ddqn import TrainingProgress


class CaseProgress:
    """A progress bar on standard error; on something that is no terminal, one line at the end."""

    def __init__(self, title: str, cases: int) -> None:
        """Show `cases` cases under a title."""
        self._failures = 0
        self._console = Console(stderr=True)
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]} cases/s  {task.fields[failures]} failures"),
            TimeRemainingColumn(),
            console=self._console,
        )
        self._task = self._progress.add_task(title, total=cases, rate="-", failures=0)

    def case_ended(self, outcome: Outcome) -> None:
        """Count a case; the bar appears with the first, so that a refused campaign shows none."""
        if not self._progress.live.is_started:
            self._progress.start()
        self._failures += outcome.failed
        task = self._progress.tasks[0]
        elapsed = task.elapsed or 0.0
        rate = f"{(task.completed + 1) / elapsed:.0f}" if elapsed > 0 else "-"
        self._progress.update(self._task, advance=1, rate=rate, failures=self._failures)

    def __enter__(self) -> Self:
        """Return the bar."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Leave the bar as it is."""
        if self._progress.live.is_started:
            self._progress.stop()


class Counter:
    """A bar with a rate that appears with the first thing counted."""

    def __init__(self, title: str, total: int, unit: str) -> None:
        """Count up to `total` things called `unit`."""
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
            TimeRemainingColumn(),
            console=Console(stderr=True),
        )
        self._unit = unit
        self._task = self._progress.add_task(title, total=total, note="")

    def ended(self, count: int, note: str = "") -> None:
        """Count things that have ended."""
        if not self._progress.live.is_started:
            self._progress.start()
        task = self._progress.tasks[0]
        rate = (task.completed + count) / task.elapsed if task.elapsed else 0.0
        shown = f"{rate:.0f} {self._unit}/s" if rate >= 10 else f"{rate:.1f} {self._unit}/s"
        self._progress.update(self._task, advance=count, note=f"{shown}  {note}")

    def __enter__(self) -> Self:
        """Return the bar."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Leave the bar as it is."""
        if self._progress.live.is_started:
            self._progress.stop()


class TrainingBar:
    """A bar per network with return and share of crashes, and its regret when it is finished."""

    def __init__(self) -> None:
        """Show nothing yet."""
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
            TimeRemainingColumn(),
            console=Console(stderr=True),
        )
        self._tasks: dict[str, TaskID] = {}

    def progressed(self, name: str, now: TrainingProgress, updates: int) -> None:
        """Show where a network is."""
        if name not in self._tasks:
            self._tasks[name] = self._progress.add_task(name, total=updates, note="")
        note = f"return {now.mean_return:.3f}  crashes {now.crash_share:.2%}"
        self._progress.update(self._tasks[name], completed=now.updates, note=note)

    def done(self, name: str, check: PolicyCheck | None) -> None:
        """Say how a network turned out, or that it was there already."""
        if check is None:
            self._progress.console.print(f"{name} is there already: same seed, settings, opponent")
        else:
            self._progress.console.print(
                f"{name}: mean regret {check.mean_regret:.2%}, "
                f"{check.avoidable_collisions} avoidable collisions in {check.cases} cases"
            )

    def __enter__(self) -> Self:
        """Start the bars."""
        self._progress.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Leave the bars as they are."""
        self._progress.stop()
