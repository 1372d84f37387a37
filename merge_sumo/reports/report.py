"""The report of a campaign: one HTML file that needs no network.

`write_report` writes it; `RunningReport` rewrites it while a campaign runs.

Names and messages may be hostile: the template escapes them, the JSON has no "<", and the script
sets text and no markup. The policy of the page allows only this script and loads nothing.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Self

import msgspec
from markupsafe import Markup

from merge_sumo.campaigns.printed_commands import campaign_command
from merge_sumo.campaigns.recorded import OUTCOMES, RecordedCampaign
from merge_sumo.campaigns.repeatability import read_second_runs, unrepeatable
from merge_sumo.controllers.process import LOG, end_of
from merge_sumo.drivers.reference_drivers import REFERENCE_DRIVERS
from merge_sumo.errors import UserError
from merge_sumo.files import check_generated
from merge_sumo.metrics.fmc import radius_for
from merge_sumo.metrics.merge import meanings
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.timeline import KINDS
from merge_sumo.reports import facts
from merge_sumo.reports.comparison_page import AGAINST_PAGE, comparison_page
from merge_sumo.reports.pages import page, replace_page
from merge_sumo.reports.report_data import page_data
from merge_sumo.reports.report_model import ReportModel
from merge_sumo.reports.text import notes_of, robustness

REPORT = "report.html"
FIRST_REPORT_S = 2.0
"""Time after which the report of a running campaign first appears, in s."""
REPORT_EVERY_S = 5
"""Minimum time between two reports of a running campaign, in s."""
REPORTS_SHARE = 0.1
"""Maximum share of the time of a campaign for its reports."""


def write_report(run: RecordedCampaign) -> Path:
    """Write `report.html` into the folder of a campaign, in place of an older one.

    A campaign against an earlier version of the VUT also gets a page of the changes.

    Args:
        run: the campaign.

    Returns:
        The path of the report.

    Raises:
        UserError: it cannot be written, or merge-sumo did not create the file in its place.
    """
    model = ReportModel(run)
    replace_page(run.folder / REPORT, report_page(model))
    if model.against is not None:
        replace_page(run.folder / AGAINST_PAGE, comparison_page(model.against))
    return run.folder / REPORT


def report_page(model: ReportModel, *, running: bool = False) -> str:
    """Return the report of a campaign as HTML.

    Args:
        model: the content of the report.
        running: whether the campaign runs; a browser then loads the page every few seconds.

    Example:
        >>> html = report_page(ReportModel(ms.open_run("runs/latest").recorded, learns=False))
    """
    run = model.run
    # No "<" in the JSON: nothing in it can end its element.
    data = msgspec.json.encode(page_data(model)).decode().replace("<", "\\u003c")
    return page(
        "report.html.jinja",
        styles=("report.css", "tally.css"),
        scripts=("player.js", "report.js"),
        every_s=REPORT_EVERY_S if running else 0,
        now=f"{datetime.now().astimezone():%H:%M:%S}",
        data=Markup(data),  # noqa: S704 (JSON without "<")
        # Of this campaign.
        model=model,
        warning=unrepeatable(read_second_runs(run)),
        notes=notes_of(run),
        printed=end_of(run.folder / LOG),
        of={fact.name: fact for fact in model.facts if fact.level is None},
        kinds=Counter(one.kind for one in model.timelines.values() if one.kind).most_common(),
        # Constants of the sections.
        names=facts,
        kind_meanings=KINDS,
        references=REFERENCE_DRIVERS,
        # Functions that the sections call.
        campaign_command=campaign_command,
        meanings=meanings,
        robustness=robustness,
        radius_for=radius_for,
        log10=math.log10,
    )


def check_report(folder: Path) -> None:
    """Check that the report of a campaign can be replaced.

    Args:
        folder: folder of the campaign.

    Raises:
        UserError: merge-sumo did not create the report in it.
    """
    check_generated(folder / REPORT)
    check_generated(folder / AGAINST_PAGE)


class RunningReport:
    """The report of a running campaign, rewritten every few seconds: a callback of the campaign.

    It has no surrogates, which take seconds to learn. An error does not stop the campaign; it
    appears when the last report is written.

    Example:
        >>> with RunningReport(folder) as report:
        ...     run_campaign(settings, plan, folder, (report.rewrite,))
    """

    def __init__(self, folder: Path) -> None:
        """Write nothing yet.

        Args:
            folder: folder of the campaign.
        """
        self._folder = folder
        self._due_s = time.monotonic() + FIRST_REPORT_S
        self._is_there = False

    def rewrite(self, _: Sequence[Outcome] = ()) -> None:
        """Write the report if it is due.

        Args:
            _: outcomes that a campaign passes to its callbacks; the report reads the folder.
        """
        start_s = time.monotonic()
        if start_s < self._due_s or not (self._folder / OUTCOMES).is_file():
            return
        self._is_there = self._write(running=True)
        took_s = time.monotonic() - start_s
        self._due_s = start_s + max(REPORT_EVERY_S, took_s / REPORTS_SHARE)
        if not self._is_there:
            self._due_s = math.inf  # no second attempt: the last report gives the reason

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        """Write the finished cases into the report of a campaign that was stopped."""
        if error is not None and self._is_there:
            self._is_there = self._write(running=False)

    def _write(self, *, running: bool) -> bool:
        """Write the report of the cases so far; return whether that was possible."""
        try:
            run = RecordedCampaign(self._folder)
            html = report_page(ReportModel(run, learns=False), running=running)
            replace_page(self._folder / REPORT, html)
        except UserError:
            return False
        return True
