"""The page of a repair: values, what they cost, the fresh campaigns.

It is one HTML file without scripts that loads nothing.
"""

from __future__ import annotations

from typing import Final

from merge_sumo.campaigns.run import Run
from merge_sumo.reports.comparison_page import STYLES, comparison_page
from merge_sumo.reports.pages import page
from merge_sumo.studies.comparison import cut
from merge_sumo.studies.repair import MEASURED_BY, RepairResult
from merge_sumo.system.folders import replace_own
from merge_sumo.system.records import to_json

PAGE: Final = "repair.html"
CHANGES: Final = "changes.html"


def write_repair(repair: RepairResult, before: Run) -> None:
    """Write the result of a repair of a campaign, its page, and that of its last comparison."""
    html = page(
        "repair.html.jinja",
        styles=STYLES,
        repair=repair,
        before=before,
        costs=MEASURED_BY,
        cut=cut,
        changes=CHANGES,
    )
    files = {"repair.json": to_json(repair.to_record(), indent=1).decode(), PAGE: html}
    if (best := repair.best) is not None:
        files[CHANGES] = comparison_page(best.compared)
    for name, text in files.items():
        replace_own(repair.folder / name, text.encode(errors="backslashreplace"))
