"""What a person sees while something runs: bars on standard error, with rates."""

from __future__ import annotations

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


class Bars:
    """Progress bars by title; the first appears with the first thing that is counted.

    So a command that is refused shows its sentence and no bar.
    """

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

    def show(self, title: str, completed: int, total: int, note: str) -> None:
        """Set a bar."""
        if title not in self._tasks:
            self._progress.start()
            self._tasks[title] = self._progress.add_task(title, total=total, note=note)
        self._progress.update(self._tasks[title], completed=completed, note=note)

    def say(self, text: str) -> None:
        """Print a line above the bars."""
        self._progress.console.print(text)

    def elapsed_s(self, title: str) -> float:
        """Return the seconds since a bar appeared."""
        if title not in self._tasks:
            return 0.0
        return self._progress.tasks[self._tasks[title]].elapsed or 0.0

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
        elapsed_s = self.elapsed_s(self._title)
        rate = f"{self._count / elapsed_s:.3g}" if elapsed_s > 0.0 else "-"
        self.show(self._title, self._count, self._total, f"{rate} {self._unit}/s  {note}")


class CaseProgress(Counter):
    """Counts test cases, and the failures among them."""

    def __init__(self, title: str, cases: int) -> None:
        """Count up to `cases`."""
        super().__init__(title, cases, "cases")
        self._failures = 0

    def case_ended(self, outcome: Outcome) -> None:
        """Count a case."""
        self._failures += outcome.failed
        self.ended(1, f"{self._failures} failures")


class TrainingBars(Bars):
    """A bar per network with return and share of crashes, and its regret when it is finished."""

    def progressed(self, name: str, now: TrainingProgress, updates: int) -> None:
        """Show where a network is."""
        note = f"return {now.mean_return:.3f}  crashes {now.crash_share:.2%}"
        self.show(name, now.updates, updates, note)

    def done(self, name: str, check: PolicyCheck | None) -> None:
        """Say how a network turned out, or that it was there already."""
        if check is None:
            self.say(f"{name} is there already: same seed, settings, opponent")
        else:
            self.say(
                f"{name}: mean regret {check.mean_regret:.2%}, "
                f"{check.avoidable_collisions} avoidable collisions in {check.cases} cases"
            )
