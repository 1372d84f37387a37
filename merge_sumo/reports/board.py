"""The page for a safety board, and the same as JSON for a safety case.

Both show the topics of `board_statements` and nothing else. The page has no script and loads
nothing; printed on A4 it has two or three pages.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from merge_sumo.campaigns.store import OUTCOMES, SETTINGS, Run
from merge_sumo.errors import UserError
from merge_sumo.reports.board_statements import BoardModel, Topic
from merge_sumo.reports.pages import page
from merge_sumo.reports.report import check_page
from merge_sumo.studies.crosscheck import check_crosscheck_of
from merge_sumo.studies.stress import check_stress_of
from merge_sumo.system.arrays import regular
from merge_sumo.system.folders import check_own, replace_own

PAGE: Final = "board.html"
RECORD: Final = "board.json"
SCHEMA: Final = "merge-sumo board 1"
"""Name and version of what `board.json` holds."""
IN_SHORT: Final = ("often", "simulators", "robust")
"""Topics whose first sentence stands at the top of the page."""


def write_board(run: Run) -> list[Path]:
    """Write `board.html` and `board.json` into the folder of a run, and return their paths.

    Raises `UserError` where a file that is read is not as it was written or of another campaign, or
    one of the two is there and is not ours.
    """
    html, record = run.folder / PAGE, run.folder / RECORD
    check_page(html)
    _check_record(record)
    model = BoardModel(run)
    if model.stress is not None:
        check_stress_of(run, model.stress)
    if model.crosscheck is not None:
        check_crosscheck_of(run, model.crosscheck)
    topics = model.topics()
    files = _hashes(model, topics)
    replace_own(html, board_page(run, topics, files).encode(errors="backslashreplace"))
    content = json.dumps(board_record(run, topics, files), indent=2, allow_nan=False) + "\n"
    replace_own(record, content.encode(errors="backslashreplace"))
    return [html, record]


def board_page(run: Run, topics: list[Topic], files: dict[str, str]) -> str:
    """Return the page as HTML."""
    by_name = {topic.name: topic for topic in topics}
    return page(
        "board.html.jinja",
        styles=("board.css",),
        vut=run.vut,
        scenario=run.scenario.name,
        interruption=run.interruption,
        in_short=[by_name[name] for name in IN_SHORT if name in by_name],
        topics=topics,
        files=files,
    )


def board_record(run: Run, topics: list[Topic], files: dict[str, str]) -> dict[str, Any]:
    """Return what `board.json` holds."""
    return {
        "schema": SCHEMA,
        "vut": run.vut,
        "scenario": run.scenario.name,
        "interruption": run.interruption,
        "files": files,
        "topics": [asdict(topic) for topic in topics],
    }


def _hashes(model: BoardModel, topics: list[Topic]) -> dict[str, str]:
    """Return the SHA-256 of each file that a sentence names, by its name."""
    named = {one.file for topic in topics for said in topic.statements for one in said.figures}
    found: dict[str, str] = {}
    for name in sorted(named | {SETTINGS, OUTCOMES}):
        own = model.run.folder / name
        for path in (own, model.kept.get(name, own)):
            if path.is_file():
                found[name] = hashlib.sha256(regular(path).read_bytes()).hexdigest()
                break
    return found


def _check_record(path: Path) -> None:
    """Raise `UserError` where something else than our JSON is at its path."""
    check_own(path)
    try:
        ours = SCHEMA.encode() in regular(path).read_bytes()[:200]
    except FileNotFoundError:
        return
    if not ours:
        raise UserError(f"{path} is no file of merge-sumo and is not replaced: move it away")
