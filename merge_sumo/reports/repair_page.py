"""The page of a repair: values, what they cost, the fresh campaigns.

It is one HTML file without scripts that loads nothing.
"""

from __future__ import annotations

from pathlib import Path

from merge_sumo.campaigns.run import Run
from merge_sumo.reports.comparison_page import STYLES, comparison_page
from merge_sumo.reports.pages import page
from merge_sumo.studies.comparison import cut
from merge_sumo.studies.repair import CHANGES, MEASURED_BY, PAGE, RESULT, Repair
from merge_sumo.system.folders import replace_own
from merge_sumo.system.records import to_json


def write_repair(repair: Repair, before: Run) -> None:
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
    files = {RESULT: to_json(repair.to_record(), indent=1).decode(), PAGE: html}
    best = repair.best
    if best.compared is not None:
        files[CHANGES] = comparison_page(best.compared, [None, best.campaign])
    for name, text in files.items():
        replace_own(Path(repair.folder) / name, text.encode(errors="backslashreplace"))
