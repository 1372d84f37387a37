"""The page of a repair: values, what they cost, the fresh campaigns.

It is one HTML file without scripts that loads nothing.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from merge_sumo.analysis.coordinates import described
from merge_sumo.campaigns.run import Run
from merge_sumo.reports.comparison_page import STYLES, comparison_page
from merge_sumo.reports.pages import page
from merge_sumo.studies.comparison import cut
from merge_sumo.studies.repair import CHANGES, MEASURED_BY, PAGE, RESULT, Repair
from merge_sumo.system.folders import replace_own
from merge_sumo.system.printable import quoted
from merge_sumo.system.records import to_json

MOST_STAYING: Final = 50
"""Cases that are listed of those that still fail."""


def write_repair(repair: Repair, before: Run) -> None:
    """Write the result of a repair, its page, and the page of its last comparison."""
    content = to_json(repair.to_record(), indent=1).decode()
    files = {RESULT: content, PAGE: repair_page(repair, before)}
    best = repair.best
    if best.compared is not None:
        files[CHANGES] = comparison_page(best.compared, [None, best.campaign])
    for name, text in files.items():
        replace_own(Path(repair.folder) / name, text.encode(errors="backslashreplace"))


def repair_page(repair: Repair, before: Run) -> str:
    """Return the page of a repair as HTML; `before` is the campaign that it repairs."""
    chosen = repair.chosen
    spec = repair.spec
    return page(
        "repair.html.jinja",
        styles=STYLES,
        repair=repair,
        before=before,
        chosen=chosen,
        costs=MEASURED_BY,
        stays=[(index, described(before.outcome(index).case)) for index in repair.stays][
            :MOST_STAYING
        ],
        stays_cut=cut(len(repair.stays), MOST_STAYING),
        change=0.0 if chosen is None else repair.change(chosen),
        command=None if spec is None else f"merge-sumo campaign --vut {quoted(spec)}",
        changes=CHANGES,
    )
