"""The page of a campaign that runs: what is known so far, in `report.html`, for a browser to watch.

It is replaced as a whole every few seconds and asks the browser to load it again; it has no script
and loads nothing. The report replaces it in the end and asks for nothing.
"""

from __future__ import annotations

import time
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Final

from merge_sumo.errors import UserError
from merge_sumo.reports.campaign_progress import CampaignProgress, Phase
from merge_sumo.reports.pages import page
from merge_sumo.reports.report import REPORT, check_report
from merge_sumo.reports.static_map import StaticMap, map_of
from merge_sumo.system.folders import replace_own
from merge_sumo.system.printable import quoted
from merge_sumo.values.score import Outcome
from merge_sumo.values.severity import Severity

FIRST_S: Final = 2.0
"""Seconds after which the page first appears: a shorter campaign goes without."""
EVERY_S: Final = 5
"""Seconds between two pages."""
MOST_SHARE: Final = 0.05
"""Of the time of a campaign that its page may take."""


class RunningPage:
    """Writes the page of a campaign into its folder when it is time to.

    It never stops a campaign: where the page cannot be written, or `report.html` is of somebody
    else's making, there is none. Both are said when the report itself is written.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / REPORT
        self._due_s = time.monotonic() + FIRST_S
        self._is_there = self._is_given_up = False

    @property
    def file(self) -> Path | None:
        """The page; None where there is none."""
        return self._path if self._is_there else None

    def show(self, progress: CampaignProgress) -> None:
        """Write the page if its time has come."""
        start_s = time.monotonic()
        if start_s >= self._due_s and not self._is_given_up:
            self._write(progress, stopped=False)
            took_s = time.monotonic() - start_s
            self._due_s = start_s + max(EVERY_S, took_s / MOST_SHARE)

    def stopped(self, progress: CampaignProgress) -> None:
        """Write the last page of a campaign that ends before its report is written."""
        if self._is_there:
            self._write(progress, stopped=True)

    def _write(self, progress: CampaignProgress, *, stopped: bool) -> None:
        self._is_there, self._is_given_up = False, True
        with suppress(UserError):
            check_report(self._path.parent)
            html = running_page(progress, self._path.parent, stopped=stopped)
            replace_own(self._path, html.encode(errors="backslashreplace"))
            self._is_there, self._is_given_up = True, False


def running_page(progress: CampaignProgress, folder: Path, *, stopped: bool = False) -> str:
    """Return the page of a campaign as HTML; of one that was `stopped`, with how to go on."""
    progress.refresh()
    return page(
        "running.html.jinja",
        styles=("report.css",),
        every_s=EVERY_S,
        now=progress,
        stopped=stopped,
        resume=f"merge-sumo campaign --resume {quoted(folder)}",
        replay=f"merge-sumo replay {quoted(folder)}",
        time=f"{datetime.now().astimezone():%H:%M:%S}",
        phases=list(Phase),
        maps=_maps(progress),
        worst=progress.worst,
        severities=list(Severity),
    )


def _maps(progress: CampaignProgress) -> dict[int, StaticMap]:
    """Return a map by level; failures lie on top."""
    shown = [*(o for o in progress.newest if not o.failed), *progress.failures]
    return {
        level: map_of([(o.case, _mark(o)) for o in at_level])
        for level in progress.cases
        if (at_level := [o for o in shown if o.case.level == level])
    }


def _mark(outcome: Outcome) -> str:
    """Return the CSS classes of a mark: the severity, and whether the case fails."""
    kind = outcome.measures.severity or ("unclassed" if outcome.failed else "error")
    return f"{kind} fail" if outcome.failed else kind
