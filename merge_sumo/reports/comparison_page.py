"""The page of a comparison: what changed from version to version, and both motions of each case.

It is one HTML file without scripts that loads nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from merge_sumo.analysis.coordinates import described
from merge_sumo.analysis.merging import merging_of
from merge_sumo.analysis.verdict import judge
from merge_sumo.campaigns.run import AGAINST, Run
from merge_sumo.reports.pages import page
from merge_sumo.reports.static_map import map_of
from merge_sumo.studies.comparison import Change, Comparison, Step, compare_against, cut
from merge_sumo.system.folders import replace_own
from merge_sumo.system.printable import quoted
from merge_sumo.values.case import FloatArray
from merge_sumo.values.scenario import DT_S, VEHICLES, VUT
from merge_sumo.values.score import Outcome
from merge_sumo.values.trajectory import Trajectory

SHOWN: Final = 200
"""Cases of a step that are drawn, those first that broke; of more, a heading says how many."""
MOST_REGIONS: Final = 20
"""Regions of a level that are listed."""
MEANING: Final = {
    Change.BROKE: "It passes with the earlier version, and does not with the later one",
    Change.WITHIN_CHANCE: "Its runs differ between the versions by no more than chance",
    Change.NEITHER: "It passes with neither version",
    Change.STILL_CONTACT: "The criterion is met with the later version, and bodies touch",
    Change.FIXED: "It passes with the later version, and does not with the earlier one",
}
"""The sections of a step with both motions."""
MARKS: Final = {
    Change.BROKE: "broke",
    Change.FIXED: "fixed",
    Change.NEITHER: "safe",
    Change.STILL_CONTACT: "unknown",
    Change.WITHIN_CHANCE: "unknown",
}
AGAINST_PAGE: Final = f"{AGAINST}.html"
"""Page in the folder of a campaign against an earlier version."""
STYLES: Final = ("report.css", "comparison.css")


@dataclass(frozen=True, slots=True)
class Frame:
    """Edges of what a chart draws, in pixels of its picture."""

    left: float
    right: float
    top: float
    bottom: float

    def x(self, share: float) -> float:
        """Return the pixel at a share of the way from left to right."""
        return round(self.left + (self.right - self.left) * share, 1)

    def y(self, share: float) -> float:
        """Return the pixel at a share of the way from the bottom up."""
        return round(self.bottom - (self.bottom - self.top) * share, 1)


OVER_TIME: Final = Frame(34.0, 312.0, 8.0, 122.0)


@dataclass(frozen=True, slots=True)
class Chart:
    """Lines over time, as (CSS class, "x,y x,y"), and (pixel, words) of the ticks."""

    title: str
    lines: list[tuple[str, str]]
    ticks: list[tuple[float, str]]
    times: list[tuple[float, str]]


def write_against(run: Run) -> None:
    """Write the page of a campaign against an earlier version into its folder; else do nothing."""
    compared, earlier = compare_against(run), run.earlier()
    if compared is not None:
        html = comparison_page(compared, [earlier, run])
        replace_own(run.folder / AGAINST_PAGE, html.encode(errors="backslashreplace"))


def comparison_page(compared: Comparison, runs: Sequence[Run | None]) -> str:
    """Return the page of a comparison as HTML; `runs` have the motions of the versions, if any."""
    return page(
        "comparison.html.jinja",
        styles=STYLES,
        compared=compared,
        versions=[
            (version, judge(version.cases).counts, merging_of(version.cases))
            for version in compared.versions
        ],
        steps=[(step, _maps(step), _sections(step, runs)) for step in compared.steps],
        vehicles=max(outcome.case.scenario.vehicles for outcome in _outcomes(compared)),
        meaning=MEANING,
        most=MOST_REGIONS,
        cut=cut,
    )


def _outcomes(compared: Comparison) -> Sequence[Outcome]:
    return next(version.outcomes for version in compared.versions if version.outcomes)


def _maps(step: Step) -> dict[int, Any]:
    """Return by level where cases changed; what broke lies on top."""
    changed = [case for case in reversed(step.cases) if case.change in MARKS]
    return {
        level: map_of([(c.a.case, MARKS[c.change]) for c in changed if c.a.case.level == level])
        for level in sorted({case.a.case.level for case in changed})
    }


def _sections(step: Step, runs: Sequence[Run | None]) -> list[tuple[Change, int, Any]]:
    """Return each change with the number of its cases, and what is shown of the first of them."""
    sections, left = [], SHOWN
    of_versions = runs[step.before - 1], runs[step.after - 1]
    for change in MEANING:
        cases = [case for case in step.cases if case.change is change]
        if not cases:
            continue
        shown = cases[:left]
        left -= len(shown)
        outcomes = list(zip(*((case.a, case.b) for case in shown), strict=True)) or [(), ()]
        motions = [
            {} if run is None else run.trajectories(outcome.index for outcome in own)
            for run, own in zip(of_versions, outcomes, strict=True)
        ]
        rows = [_shown(case.a, case.b, case.became, of_versions, motions) for case in shown]
        sections.append((change, len(cases), rows))
    return sections


def _shown(
    a: Outcome,
    b: Outcome,
    became: str,
    runs: Sequence[Run | None],
    motions: Sequence[dict[int, Trajectory]],
) -> dict[str, Any]:
    """Return what the page says of a case; a version has no charts without its motion."""
    own = [motion.get(outcome.index) for motion, outcome in zip(motions, (a, b), strict=True)]
    both = [motion for motion in own if motion is not None]
    commands = [
        f"merge-sumo replay {quoted(run.folder)} {outcome.index} --gui"
        for run, outcome in zip(runs, (a, b), strict=True)
        if run is not None
    ]
    return {
        "index": b.index,
        "level": b.case.level,
        "where": described(b.case),
        "became": became,
        "charts": [[] if motion is None else _charts(motion, both) for motion in own],
        "commands": commands,
    }


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
    lines = []
    # The VUT lies on top.
    for vehicle in sorted(range(rows.shape[1]), key=lambda vehicle: vehicle == VUT):
        points = (
            f"{OVER_TIME.x(row * DT_S / end_s)},{OVER_TIME.y((value - low) / span)}"
            for row, value in enumerate(rows[:, vehicle].tolist())
        )
        lines.append((VEHICLES[vehicle], " ".join(points)))
    ticks = [
        (OVER_TIME.y(share), f"{low + span * share:.0f}".replace("-", "−"))
        for share in (0.0, 0.5, 1.0)
    ]
    times = [(OVER_TIME.x(share), f"{share * end_s:g}") for share in (0.0, 1.0)]
    return Chart(title, lines, ticks, times)
