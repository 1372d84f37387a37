"""The page of two campaigns: what got fixed, what broke, in which cases, and both motions.

One HTML file without scripts that loads nothing. The two motions of a case are drawn side by side,
over the same axes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from merge_sumo.analysis.coordinates import described
from merge_sumo.analysis.verdict import counted, in_words
from merge_sumo.campaigns.run import Run
from merge_sumo.errors import UserError
from merge_sumo.reports.report import policy_hash
from merge_sumo.reports.static_map import map_of
from merge_sumo.studies.changes import Change, ComparedCase, RunComparison
from merge_sumo.system.folders import write_new
from merge_sumo.system.printable import quoted
from merge_sumo.values.scenario import DT_S, VEHICLES, VUT, level_name
from merge_sumo.values.trajectory import Trajectory

if TYPE_CHECKING:
    from jinja2 import Template

    from merge_sumo.values.case import FloatArray

SHOWN: Final = 200
"""Cases that are drawn, in the order of `RunComparison.cases`; more are counted."""
LEFT, RIGHT, TOP, BOTTOM = 34.0, 312.0, 8.0, 122.0
"""Edges of a chart in a picture of 320 by 150."""
MEANING: Final = {
    Change.BROKE: "A passes, B fails",
    Change.FIXED: "A fails, B passes",
    Change.BOTH_FAIL: "A fails, and so does B",
    Change.NO_VERDICT_OF_A: "A ends with an error or a timeout",
    Change.NO_VERDICT_OF_B: "B ends with an error or a timeout",
    Change.NO_VERDICT: "both end with an error or a timeout",
    Change.NOT_RUN_AGAIN: "known of one of the two alone",
}
MARKS: Final = {Change.BROKE: "broke", Change.FIXED: "fixed", Change.BOTH_FAIL: "safe"}
"""Marks in the maps; what is not here has none of the three verdicts."""

Motions = Mapping[tuple[str, int], Trajectory]
"""What a VUT did in a case of the other's campaign, by that campaign, "A" or "B", and index."""


@dataclass(frozen=True, slots=True)
class Line:
    """A line of a chart: CSS class and points "x,y x,y"."""

    css: str
    points: str


@dataclass(frozen=True, slots=True)
class Chart:
    """What is drawn over time, with (y, words) and (x, words) of the ticks."""

    title: str
    lines: list[Line]
    ticks: list[tuple[float, str]]
    times: list[tuple[float, str]]


@dataclass(frozen=True, slots=True)
class Side:
    """What one VUT did in a case; no charts where its motion is not known."""

    name: str
    how: str
    charts: list[Chart]


@dataclass(frozen=True, slots=True)
class Shown:
    """A case of the page."""

    case: ComparedCase
    where: str
    command: str
    sides: tuple[Side, Side]


def write_comparison(
    compared: RunComparison, a: Run, b: Run, motions: Motions, tolerance: float, path: Path
) -> None:
    """Write the page of a comparison as a new file; `UserError` where something is at `path`."""
    page = comparison_page(compared, a, b, motions, tolerance)
    write_new(path, page.encode(errors="backslashreplace"))


def comparison_page(
    compared: RunComparison, a: Run, b: Run, motions: Motions, tolerance: float = 0.0
) -> str:
    """Return the page of a comparison as HTML.

    Args:
        compared: what changed.
        a: campaign of the VUT before.
        b: campaign of the VUT after.
        motions: of the cases that were run again with the other VUT.
        tolerance: by how much B may be worse.
    """
    from markupsafe import Markup

    templates = Path(__file__).parent / "templates"
    style = "".join(
        (templates / name).read_text(encoding="utf-8") for name in ("report.css", "history.css")
    )
    runs = {"A": a, "B": b}
    shown = [_shown(case, runs, motions) for case in compared.cases[:SHOWN]]
    sections = {change: [one for one in shown if one.case.change is change] for change in MEANING}
    return _template().render(
        style=Markup(style),  # noqa: S704 (our own files)
        style_hash=policy_hash(style),
        runs=runs,
        compared=compared,
        why=compared.worse(tolerance),
        tolerance=f"{tolerance:g}",
        counts=_counts(compared),
        changes=list(Change),
        maps=_maps(compared),
        sections={change: cases for change, cases in sections.items() if cases},
        meaning=MEANING,
        more=len(compared.cases) - len(shown),
        level_name=level_name,
    )


def _counts(compared: RunComparison) -> str:
    """Return in words what became of how many cases."""
    found = [(sum(c.change is change for c in compared.cases), change) for change in MEANING]
    parts = [f"{number} {change.value}" for number, change in found if number]
    if not parts:
        return "No case of either campaign fails or ends without a verdict."
    return f"{counted(len(compared.cases), 'case')}: {in_words(parts)}."


def _maps(compared: RunComparison) -> dict[int, object]:
    """Return a map by level; what broke lies on top."""
    return {
        level: map_of([(c.case, MARKS.get(c.change, "unknown")) for c in reversed(at_level)])
        for level in compared.levels
        if (at_level := [c for c in compared.cases if c.case.level == level])
    }


def _shown(case: ComparedCase, runs: Mapping[str, Run], motions: Motions) -> Shown:
    known = {case.run: _recorded(runs[case.run], case.index)}
    known["B" if case.run == "A" else "A"] = motions.get((case.run, case.index))
    ends = {
        "A": (case.end_a, case.severity_a, case.score_a),
        "B": (case.end_b, case.severity_b, case.score_b),
    }
    both = [motion for motion in known.values() if motion is not None]
    sides = []
    for name, (end, severity, score) in ends.items():
        how = "not run" if end is None else end.value.replace("_", " ").lower()
        how += "" if severity is None else f", {severity}"
        how += "" if score is None else f", score {score:.0f}".replace("-", "−")
        motion = known[name]
        sides.append(Side(name, how, [] if motion is None else _charts(motion, both)))
    command = f"merge-sumo replay {quoted(runs[case.run].folder)} {case.index} --gui"
    return Shown(case, described(case.case), command, (sides[0], sides[1]))


def _recorded(run: Run, index: int) -> Trajectory | None:
    try:
        return run.trajectory(index)
    except UserError:  # lost: the page goes without
        return None


def _charts(motion: Trajectory, both: Sequence[Trajectory]) -> list[Chart]:
    """Return speeds and distances to M of all cars, over the axes of both motions of the case."""
    end_s = max(m.t_end_s for m in both) or DT_S
    return [
        _chart(title, motion.motion[:, :, k], [m.motion[:, :, k] for m in both], end_s)
        for title, k in (("speed, m/s", 1), ("distance to M, m", 0))
    ]


def _chart(title: str, rows: FloatArray, both: Sequence[FloatArray], end_s: float) -> Chart:
    """Return a chart of values, (T + 1, A)."""
    finite = np.concatenate([values.ravel() for values in both])
    low, high = float(finite.min()), float(finite.max())
    span = max(high - low, 1.0)

    def across(time_s: float) -> float:
        return round(LEFT + (RIGHT - LEFT) * time_s / end_s, 1)

    def up(value: float) -> float:
        return round(BOTTOM - (BOTTOM - TOP) * (value - low) / span, 1)

    lines = [
        Line(
            VEHICLES[who],
            " ".join(f"{across(row * DT_S)},{up(v)}" for row, v in enumerate(column)),
        )
        # The VUT lies on top.
        for who, column in sorted(enumerate(rows.T.tolist()), key=lambda pair: pair[0] == VUT)
    ]
    ticks = [
        (up(value), f"{value:.0f}".replace("-", "−"))
        for value in (low, low + span / 2.0, low + span)
    ]
    return Chart(title, lines, ticks, [(across(t), f"{t:g}") for t in (0.0, end_s)])


@cache
def _template() -> Template:
    """Return the template, which is compiled once."""
    from jinja2 import Environment, PackageLoader

    loader = PackageLoader("merge_sumo.reports")
    environment = Environment(loader=loader, autoescape=True, trim_blocks=True)
    return environment.get_template("comparison.html.jinja")
