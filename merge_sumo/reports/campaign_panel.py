"""What a person sees of a campaign that runs: a panel or lines on standard error, and a page."""

from __future__ import annotations

import time
from collections.abc import Callable
from html import escape
from typing import Final, Self

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from merge_sumo.reports.campaign_progress import CampaignProgress, Phase
from merge_sumo.reports.progress import notebook
from merge_sumo.reports.running_page import RunningPage
from merge_sumo.values.scenario import level_name
from merge_sumo.values.score import Outcome

FRESH_S: Final = 0.5
"""Seconds for which a coverage that is shown may be old."""


class CampaignPanel:
    """How far a campaign is and what it has found, on standard error and in a page.

    A live panel on a terminal, a line after every tenth of a phase elsewhere, nothing when quiet.
    It appears with the first case, so a command that is refused shows its sentence and no panel.
    The page, where there is one, is written whether quiet or not.
    """

    def __init__(
        self,
        progress: CampaignProgress,
        page: RunningPage | None = None,
        *,
        quiet: bool = False,
        console: Console | None = None,
    ) -> None:
        self.progress = progress
        self._page, self._quiet = page, quiet
        self._console = console or Console(stderr=True)
        self._live: Live | None = None
        self._fresh_s = 0.0
        self._update: Callable[[str, str], None] | None = None
        """Replaces what a notebook shows, as HTML and as text."""
        self._appeared = self._said_where = False

    def case_ended(self, outcome: Outcome) -> None:
        """Count a case."""
        self._appear()
        self.progress.case_ended(outcome)
        self._show()

    def ran_before(self, outcome: Outcome) -> None:
        """Count a case that ran before: it says nothing of how fast this goes."""
        self.progress.ran_before(outcome)

    def advance(self, phase: Phase, done: int, total: int) -> None:
        """Set the progress of a phase after the cases: of counterfactuals, of the report."""
        begins = self.progress.phase is not phase
        self.progress.advance(phase, done, total)
        self._show(begins=begins)

    def _appear(self) -> None:
        if self._appeared:
            return
        self._appeared = True
        if self._quiet:
            return
        shell = notebook()
        if shell is not None:
            shown = shell.display(_both("", ""), raw=True, display_id=True)
            self._update = lambda html, text: shown.update(_both(html, text), raw=True)
        elif self._console.is_terminal:
            self._live = Live(console=self._console, get_renderable=self._panel)
            self._live.start()

    def _show(self, *, begins: bool = False) -> None:
        # The report itself replaces the page.
        if self._page is not None and self.progress.phase is not Phase.REPORT:
            self._page.show(self.progress)
        if self._live is not None or self._update is not None:
            if begins or time.monotonic() - self._fresh_s > FRESH_S:
                self._refresh()
        elif not self._quiet:
            self._say_line(begins=begins)

    def _say_line(self, *, begins: bool) -> None:
        if self._where and not self._said_where:
            self._said_where = True
            self._print(f"{self.progress.title}: {self._where}")
        if self.progress.work[self.progress.phase].is_due() or begins:
            self._print(self.progress.line)

    def _print(self, line: str) -> None:
        self._console.print(line, highlight=False, markup=False, soft_wrap=True)

    @property
    def _where(self) -> str:
        """Where the page is, in words; empty where there is none (yet)."""
        file = None if self._page is None else self._page.file
        return "" if file is None else f"watch it in a browser: {file}"

    def _refresh(self) -> None:
        self.progress.refresh()
        self._fresh_s = time.monotonic()
        if self._update is not None:
            work = self.progress.work[self.progress.phase]
            bar = f'<progress value="{work.done}" max="{work.total}"></progress>'
            self._update(f"{bar} {escape(self.progress.line)}", self.progress.line)

    def _panel(self) -> Panel:
        now = self.progress
        phases = Table.grid(padding=(0, 2))
        for phase in Phase:
            work = now.work.get(phase)
            total, done = (1, 0) if work is None else (work.total or 1, work.done)
            phases.add_row(
                Text(phase, "" if phase is now.phase else "dim"),
                ProgressBar(total=total, completed=done, width=24),
                now.count(phase),
                now.rate(phase),
            )
        table = Table(box=None, padding=(0, 2), pad_edge=False, header_style="dim")
        table.add_column("POV level")
        for name in ("cases", "failures", "FMC so far"):
            table.add_column(name, justify="right")
        for level, cases in now.cases.items():
            failing = len(now.failing.get(level, ()))
            style = "bold dark_orange" if failing else ""
            table.add_row(
                *(level_name(level), str(cases), Text(str(failing), style)),
                f"{now.fmc.get(level, 0.0):.4f}",
            )
        head = Text(", ".join(filter(None, (now.found, now.left))))
        where = [Text(self._where, "dim", overflow="fold")] if self._where else []
        parts = Group(head, "", phases, "", table, *where)
        return Panel(parts, title=Text(now.title), title_align="left", expand=False)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        """Leave the last state on the terminal, and in the page where the campaign was stopped."""
        if self._live is not None or self._update is not None:
            self._refresh()
        if self._live is not None:
            self._live.stop()
        if self._page is not None and error is not None:
            self._page.stopped(self.progress)


def _both(html: str, text: str) -> dict[str, str]:
    """Return what a notebook shows, and what it shows where it can show text alone."""
    return {"text/html": html, "text/plain": text}
