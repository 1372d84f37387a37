"""The report of a campaign: one HTML file that needs no network.

What a reader needs is in the page as text and tables; maps, motion and charts are drawn by
`templates/player.js` and `report.js` from JSON in the page. Names and messages come from outside,
so the template escapes them, the JSON holds no "<", the script sets text and never markup, and the
page's own policy lets nothing run but that script and lets nothing load at all.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Self

import msgspec
from markupsafe import Markup

from merge_sumo.campaigns.run import OUTCOMES, Run
from merge_sumo.drivers.reference import REFERENCES
from merge_sumo.errors import UserError
from merge_sumo.files import GENERATOR, check_ours, replace_own
from merge_sumo.metrics.cause import BRAKED_MPS
from merge_sumo.metrics.fmc import radius_for
from merge_sumo.metrics.merge import meanings
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.summary import Summary
from merge_sumo.reports.comparison_page import AGAINST_PAGE, write_against
from merge_sumo.reports.facts import STARTS_THAT_FAIL, by_level, headline
from merge_sumo.reports.pages import page
from merge_sumo.reports.report_data import page_data, pairs_of
from merge_sumo.reports.report_model import OnPart, ReportModel
from merge_sumo.reports.text import comparison_headline, robustness

REPORT = "report.html"
"""By this a report is known as ours, and may be replaced by a newer one."""
FIRST_S = 2.0
"""Seconds after which the report of a running campaign first appears."""
EVERY_S = 5
"""Minimum time between two reports of a running campaign, in s."""


def write_report(
    run: Run, summary: Summary | None = None, on_part: OnPart = lambda _done, _total: None
) -> Path:
    """Write `report.html` into the folder of a campaign, in place of an older one.

    A campaign against an earlier version of the VUT also gets a page of what broke.

    Args:
        run: the campaign.
        summary: its summary, where that is known.
        on_part: called with the number of levels whose surrogate is learned, and of all levels.

    Returns:
        The path of the report.

    Raises:
        UserError: if it cannot be written, or the file that is there is not a report of ours.
    """
    _replace(run, report_page(run, summary, on_part))
    write_against(run)
    return run.folder / REPORT


def _replace(run: Run, html: str) -> None:
    replace_own(run.folder / REPORT, html.encode(errors="backslashreplace"), GENERATOR)


class RunningReport:
    """The report of a campaign that runs, rewritten every few seconds: a callback of the campaign.

    It has no surrogates, which take seconds to learn. It never stops a campaign: if it cannot be
    written, or `report.html` is not ours, the last report raises the error.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._due_s = time.monotonic() + FIRST_S
        self._is_there = False

    def rewrite(self, _: Sequence[Outcome] = ()) -> None:
        """Write the report if its time has come."""
        start_s = time.monotonic()
        if start_s >= self._due_s and (self._folder / OUTCOMES).is_file():
            self._write(running=True)
            took_s = time.monotonic() - start_s
            # Maximum share of the time of a campaign that its report takes while it runs.
            self._due_s = start_s + max(EVERY_S, took_s / 0.1)
            if not self._is_there:
                self._due_s = math.inf

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        """Write the cases that ran into the report of a campaign that was stopped."""
        if error is not None and self._is_there:
            self._write(running=False)

    def _write(self, *, running: bool) -> None:
        self._is_there = False
        with suppress(UserError):
            run = Run(self._folder)
            _replace(run, report_page(run, learns=False, running=running))
            self._is_there = True


def check_report(folder: Path) -> None:
    """Raise `UserError` where `report.html` in a folder is not a report of ours."""
    check_ours(folder / REPORT)
    check_ours(folder / AGAINST_PAGE)


LEVEL_ABOUT = {
    0: "keeps its speed",
    1: "makes room for a VUT that accelerates",
    2: "expects a VUT that thinks; psi 0 is egoistic, pi/2 cares for the VUT",
}
"""What the POV of a level does, in the words of a caption."""


def report_page(
    run: Run,
    summary: Summary | None = None,
    on_part: OnPart = lambda _done, _total: None,
    *,
    learns: bool = True,
    running: bool = False,
) -> str:
    """Return the report of a campaign as HTML.

    Args:
        run: the campaign.
        summary: its summary, where that is known.
        on_part: called with the number of levels whose surrogate is learned, and of all levels.
        learns: whether the page has surrogates.
        running: whether the campaign runs: a browser then loads the page again and again.
    """
    model, scenario = ReportModel(run, summary, on_part, learns=learns), run.scenario
    # No "<" in the JSON: nothing in it can end its element.
    data = msgspec.json.encode(page_data(model)).decode().replace("<", "\\u003c")
    return page(
        "report.html.jinja",
        styles=("report.css",),
        scripts=("player.js", "report.js"),
        every_s=EVERY_S if running else 0,
        now=f"{datetime.now().astimezone():%H:%M:%S}",
        data=Markup(data),  # noqa: S704 (JSON without "<")
        model=model,
        run=run,
        vut=run.vut,
        scenario=scenario,
        level_about=LEVEL_ABOUT,
        lane_m=scenario.lane_m,
        traffic=scenario.vehicles > 2,
        meanings=meanings,
        by_level=by_level,
        headline=headline(run, model.facts),
        comparison_headline=comparison_headline,
        robustness=robustness,
        starts_that_fail=STARTS_THAT_FAIL,
        pairs_of=pairs_of,
        radius_for=radius_for,
        references=list(REFERENCES),
        braked_mps=BRAKED_MPS,
    )
