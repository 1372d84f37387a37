"""The page of a history: one HTML file without scripts that loads nothing."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from merge_sumo.analysis.diagnosis import Kind
from merge_sumo.reports.report import policy_hash
from merge_sumo.studies.history import History, LevelOfVersion
from merge_sumo.studies.history_steps import MEANING, Became
from merge_sumo.system.folders import write_new
from merge_sumo.values.scenario import level_name
from merge_sumo.values.severity import Severity

if TYPE_CHECKING:
    from jinja2 import Template

LEFT: Final = 48.0
RIGHT: Final = 352.0
TOP: Final = 12.0
BOTTOM: Final = 150.0
MOST_NAMES: Final = 12
"""Numbers of versions that are written below a chart; of more, every second or so."""
MOST_REGIONS: Final = 20
"""Regions of a step that are listed."""


@dataclass(frozen=True, slots=True)
class Line:
    """A line of a chart: its CSS class, its parts, and (x, y, words) of its points."""

    name: str
    css: str
    parts: list[str]
    points: list[tuple[float, float, str]]


@dataclass(frozen=True, slots=True)
class Chart:
    """Lines over versions, with (y, words) and (x, words) of the ticks."""

    title: str
    lines: list[Line]
    ticks: list[tuple[float, str]]
    names: list[tuple[float, str]]


def write_history(history: History, path: Path) -> None:
    """Write the page of a history as a new file; `UserError` where something is at `path`."""
    write_new(path, history_page(history).encode(errors="backslashreplace"))


def history_page(history: History) -> str:
    """Return the page of a history as HTML."""
    from markupsafe import Markup

    templates = Path(__file__).parent / "templates"
    style = "".join(
        (templates / name).read_text(encoding="utf-8") for name in ("report.css", "history.css")
    )
    return _template().render(
        style=Markup(style),  # noqa: S704 (our own files)
        style_hash=policy_hash(style),
        history=history,
        charts=_charts(history),
        tables={level: _table(history, level) for level in history.levels},
        Became=Became,
        meaning=MEANING,
        most=MOST_REGIONS,
        level_name=level_name,
    )


def _charts(history: History) -> list[Chart]:
    def by_level(title: str, value: Callable[[LevelOfVersion], float | None]) -> Chart:
        rows = {
            (f"level {level_name(level)}", f"level{level}"): [
                None if (found := version.levels.get(level)) is None else value(found)
                for version in history.versions
            ]
            for level in history.levels
        }
        return _chart(title, rows)

    kinds: dict[tuple[str, str], list[float | None]] = {
        (kind.value, f"kind{number}"): [
            # A sum over fewer levels is no smaller number of failures.
            float(sum(found.kinds.get(kind, 0) for found in version.levels.values()))
            if len(version.levels) == len(history.levels)
            else None
            for version in history.versions
        ]
        for number, kind in enumerate(Kind)
    }
    return [
        by_level("Failure mode coverage (FMC)", lambda found: found.fmc),
        by_level("Failures", lambda found: float(found.failures) if found.tested else None),
        by_level("Regions", lambda found: found.regions),
        _chart(
            "Kinds of failure, all levels", {key: row for key, row in kinds.items() if any(row)}
        ),
    ]


def _chart(title: str, rows: dict[tuple[str, str], list[float | None]]) -> Chart:
    """Return a chart; a row has a value for each version, None where there is none."""
    count = len(next(iter(rows.values()), []))
    top = _top([value for row in rows.values() for value in row if value is not None])

    def across(place: int) -> float:
        return round(LEFT + 12.0 + (RIGHT - LEFT - 24.0) * place / max(count - 1, 1), 1)

    def up(value: float) -> float:
        return round(BOTTOM - (BOTTOM - TOP) * value / top, 1)

    lines = []
    for (name, css), row in rows.items():
        parts: list[list[str]] = [[]]
        points = []
        for place, value in enumerate(row):
            if value is None:
                parts.append([])
                continue
            x, y = across(place), up(value)
            parts[-1].append(f"{x},{y}")
            points.append((x, y, f"version {place + 1}, {name}: {value:.4g}"))
        lines.append(Line(name, css, [" ".join(part) for part in parts if len(part) > 1], points))
    every = math.ceil(count / MOST_NAMES)
    return Chart(
        title,
        lines,
        [(up(value), f"{value:g}") for value in (0.0, top / 2.0, top)],
        [(across(place), str(place + 1)) for place in range(0, count, every or 1)],
    )


def _top(values: Sequence[float]) -> float:
    """Return the end of an axis: 2, 4 or 10 times a power of ten, so that its half is round."""
    most = max(values, default=0.0)
    if most <= 0.0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(most))
    return float(f"{next(step * power for step in (2, 4, 10, 20) if step * power >= most):.12g}")


def _table(history: History, level: int) -> list[tuple[str, list[str]]]:
    """Return the rows of a level's table: a name, and a cell for each version."""
    found = [version.levels.get(level) for version in history.versions]
    rows: list[tuple[str, Callable[[LevelOfVersion], Any]]] = [
        ("FMC", lambda one: "–" if one.fmc is None else f"{one.fmc:.4f}"),
        ("failures", lambda one: one.failures if one.tested else "–"),
        ("of these contacts", lambda one: one.contacts if one.tested else "–"),
        *((f"{word} in all", partial(_of_severity, word)) for word in Severity),
        ("of tested cases", lambda one: one.tested),
    ]
    if any(one is not None and (one.errors or one.timeouts) for one in found):
        rows.append(("errors", lambda one: one.errors))
        rows.append(("timeouts", lambda one: one.timeouts))
    rows.append(("regions", lambda one: "–" if one.regions is None else one.regions))
    for kind in Kind:
        if any(one is not None and kind in one.kinds for one in found):
            rows.append((kind.value, partial(_of_kind, kind)))
    if any(one is not None and one.avoidance_known for one in found):
        rows.append(("avoided by a careful driver", _avoided))
    return [
        (name, ["" if one is None else str(value(one)) for one in found]) for name, value in rows
    ]


def _of_severity(severity: Severity, one: LevelOfVersion) -> int | str:
    return one.severities.get(severity, 0) if one.tested else "–"


def _of_kind(kind: Kind, one: LevelOfVersion) -> int:
    return one.kinds.get(kind, 0)


def _avoided(one: LevelOfVersion) -> str:
    if not one.avoidance_known:
        return "–"
    return f"{one.avoided / one.avoidance_known:.0%} ({one.avoided} of {one.avoidance_known})"


@cache
def _template() -> Template:
    """Return the template, which is compiled once."""
    from jinja2 import Environment, PackageLoader

    loader = PackageLoader("merge_sumo.reports")
    environment = Environment(loader=loader, autoescape=True, trim_blocks=True)
    return environment.get_template("history.html.jinja")
