"""What a person sees while cases run: a bar with the rate and the failures so far."""

from __future__ import annotations

from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from merge_sumo.score import Outcome


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
        """Count a case."""
        self._failures += outcome.failed
        task = self._progress.tasks[0]
        elapsed = task.elapsed or 0.0
        rate = f"{(task.completed + 1) / elapsed:.0f}" if elapsed > 0 else "-"
        self._progress.update(self._task, advance=1, rate=rate, failures=self._failures)

    def __enter__(self) -> Self:
        """Start the bar."""
        self._progress.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Leave the bar as it is."""
        self._progress.stop()
