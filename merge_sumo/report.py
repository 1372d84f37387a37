"""The report of a campaign: one HTML file that needs no network."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from merge_sumo.case import V_POV0, X_POV0, to_unit
from merge_sumo.errors import UserError
from merge_sumo.fmc import RADIUS
from merge_sumo.journal import SETTINGS, Run, failures
from merge_sumo.score import Outcome
from merge_sumo.summary import summarise

REPORT: Final = "report.html"
LISTED: Final = 10
MAP_PX: Final = 360


def write_report(run: Run) -> Path:
    """Write `report.html` into the folder of a run, in place of an older one; return its path."""
    from jinja2 import Environment, PackageLoader

    environment = Environment(loader=PackageLoader("merge_sumo"), autoescape=True, trim_blocks=True)
    levels = run.settings.get("levels")
    if not isinstance(levels, list):
        raise UserError(f"{run.folder / SETTINGS} is no campaign's: it has no list of levels")
    summary = summarise(run.outcomes, levels)
    worst = failures(run.outcomes)
    near = [o for o in run.outcomes if o.measures.score is not None and not o.failed]
    near.sort(key=lambda o: (o.measures.score, o.index))
    page = environment.get_template("report.html.jinja").render(
        settings=run.settings,
        summary=summary,
        maps={level: _map(run.outcomes, level) for level in levels},
        tables={"Worst failures": worst[:LISTED], "Nearest misses": near[:LISTED]},
        folder=run.folder,
        map_px=MAP_PX,
        radius_px=RADIUS * MAP_PX,
        x=X_POV0,
        v=V_POV0,
    )
    path = run.folder / REPORT
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from error
    return path


def _map(outcomes: Sequence[Outcome], level: int) -> list[dict[str, Any]]:
    """Return the marks of a failure map, failures last so that they lie on top."""
    at_level = [o for o in outcomes if o.case.level == level]
    points = to_unit((o.case for o in at_level), level)
    marks = [
        {
            "x": round(x * MAP_PX, 1),
            "y": round((1.0 - v) * MAP_PX, 1),
            "failed": o.failed,
            "title": f"case {o.index}: x_POV0 {o.case.x_pov0_m:.1f} m, v_POV0 "
            f"{o.case.v_pov0_mps:.2f} m/s, {o.measures.end}",
        }
        for o, (x, v) in zip(at_level, points[:, :2].tolist(), strict=True)
    ]
    return sorted(marks, key=lambda mark: mark["failed"])
