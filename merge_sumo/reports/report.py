"""The report of a campaign: one HTML file that needs no network.

What a reader needs is in the page as text and tables; maps, motion and charts are drawn by
`templates/player.js` and `report.js` from JSON in the page. Names and messages come from outside,
so the template escapes them, the JSON holds no "<", the script sets text and never markup, and the
page's own policy lets nothing run but that script and lets nothing load at all.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final

from markupsafe import Markup

from merge_sumo.analysis.summary import Summary
from merge_sumo.campaigns.store import Run
from merge_sumo.errors import UserError
from merge_sumo.reports.pages import page
from merge_sumo.reports.report_data import page_data
from merge_sumo.reports.report_model import OnPart, ReportModel
from merge_sumo.reports.report_sections import head_words, sections_of, shared_words
from merge_sumo.reports.version_pages import AGAINST_PAGE, write_against
from merge_sumo.system.folders import cannot_write, check_own, replace_own
from merge_sumo.system.workers import Workers

REPORT: Final = "report.html"
GENERATOR: Final = b'<meta name="generator" content="merge-sumo">'
"""By this a report is known as ours, and may be replaced by a newer one."""
HEAD_BYTES: Final = 1000


def write_report(
    run: Run,
    summary: Summary | None = None,
    workers: Workers | None = None,
    on_part: OnPart = lambda _done, _total: None,
) -> Path:
    """Write `report.html` into the folder of a run, in place of an older one; return its path.

    A campaign against an earlier version of the VUT has a page of what broke beside it. See
    `ReportModel` for the other arguments. Raises `UserError` when it cannot be written, or what is
    there is no report of ours.
    """
    check_report(run.folder)
    path = run.folder / REPORT
    html = report_page(run, summary, workers, on_part)
    replace_own(path, html.encode(errors="backslashreplace"))
    write_against(run)
    return path


def check_report(folder: Path) -> None:
    """Raise `UserError` where `report.html` in a folder is something else than our report."""
    check_page(folder / REPORT)
    check_own(folder / AGAINST_PAGE)


def check_page(path: Path) -> None:
    """Raise `UserError` where a path is taken by something else than a page of ours."""
    check_own(path)
    try:
        with path.open("rb") as file:
            ours = GENERATOR in file.read(HEAD_BYTES)
    except FileNotFoundError:
        return
    except OSError as error:
        raise cannot_write(path, error) from error
    if not ours:
        raise UserError(f"{path} is no report of merge-sumo and is not replaced: move it away")


def report_page(
    run: Run,
    summary: Summary | None = None,
    workers: Workers | None = None,
    on_part: OnPart = lambda _done, _total: None,
) -> str:
    """Return the report of a run as HTML."""
    model = ReportModel(run, summary, workers, on_part)
    words = shared_words(model)
    sections = sections_of(model, words)
    model.part_ended()
    data = json.dumps(page_data(model), allow_nan=False, separators=(",", ":"))
    # No "<" in the JSON: nothing in it can end its element.
    data = data.replace("<", "\\u003c")
    model.part_ended()
    return page(
        "report.html.jinja",
        styles=("report.css",),
        scripts=("player.js", "report.js"),
        sections=sections,
        data=Markup(data),  # noqa: S704 (JSON without "<")
        **words,
        **head_words(model),
    )
