"""The command `history`: several versions in one page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from merge_sumo.commands.shared import JsonOption, app, print_troubles, show
from merge_sumo.system.folders import check_new_file
from merge_sumo.values.scenario import level_name


@app.command()
def history(
    runs: Annotated[list[Path], typer.Argument(help="Folders of campaigns, the oldest first.")],
    out: Annotated[Path, typer.Option(help="Page to write; nothing may be there.")] = Path(
        "history.html"
    ),
    as_json: JsonOption = False,
) -> None:
    """Show several versions of a VUT in one page: what was found, what got fixed, what broke.

    Everything is read from the records: no case runs again, and no VUT. A region in which the
    earlier version failed counts as fixed when the later one tested cases there and none failed;
    `compare-runs` runs the failures of two versions again and is the better evidence. Campaigns of
    different scenarios, criteria, initial speeds or POVs are refused.

    Example:  merge-sumo history runs/design1 runs/design2 --out runs/history.html
    """
    from merge_sumo.campaigns.run import Run
    from merge_sumo.reports.history import history_of
    from merge_sumo.reports.history_page import headline, write_history
    from merge_sumo.reports.history_steps import Became

    check_new_file(out)
    found = history_of([Run(folder) for folder in runs])
    write_history(found, out)
    if as_json:
        typer.echo(json.dumps({**found.to_record(), "page": str(out)}, allow_nan=False))
        return
    show(headline(found))
    for number, version in enumerate(found.versions, start=1):
        show(f"{number}: {version.folder} ({version.vut}): {version.verdict.counts}")
        print_troubles(version.verdict)
    for step in found.steps:
        counts = [f"{n} {became}" for became in Became if (n := step.count(became))]
        show(
            f"from {step.before} to {step.after} at POV level {level_name(step.level)}: "
            f"{'regions: ' + ', '.join(counts) if counts else 'no failures in either'}"
        )
    for note in found.notes:
        show(note)
    show(f"page: {out}")
