"""The command `history`: several versions in one page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from merge_sumo.commands import complete
from merge_sumo.commands.shared import JsonOption, app, show


@app.command()
def history(
    runs: Annotated[
        list[Path],
        typer.Argument(
            help="Folders of campaigns, the oldest first.", autocompletion=complete.runs
        ),
    ],
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
    from merge_sumo import api

    found = api.history(runs, out=out)
    if as_json:
        typer.echo(json.dumps({**found.to_record(), "page": str(out)}, allow_nan=False))
        return
    for line in found.lines():
        show(line)
    show(f"page: {out}")
