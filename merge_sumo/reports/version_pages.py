"""The pages of versions of a VUT: two campaigns case by case, and a history of several.

Each is one HTML file without scripts that loads nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from merge_sumo.analysis.coordinates import described
from merge_sumo.analysis.diagnosis import Kind
from merge_sumo.analysis.merging import SOURCE, MergeStatistics
from merge_sumo.analysis.verdict import in_words
from merge_sumo.campaigns.against import AGAINST, earlier_run
from merge_sumo.campaigns.store import Run
from merge_sumo.reports.pages import page
from merge_sumo.reports.static_map import map_of
from merge_sumo.studies.history import History, LevelOfVersion, RegionChange
from merge_sumo.studies.versions import Change, ComparedCase, RunComparison, compare_against
from merge_sumo.system.folders import replace_own, write_new
from merge_sumo.system.printable import counted, quoted
from merge_sumo.values.case import FloatArray
from merge_sumo.values.scenario import DT_S, VEHICLES, VUT, Bounds, lane_of, level_name
from merge_sumo.values.score import Outcome
from merge_sumo.values.severity import Severity
from merge_sumo.values.trajectory import End, Trajectory

SHOWN: Final = 200
"""Cases that are drawn, in the order of `RunComparison.cases`; more are counted."""
MOST_NAMES: Final = 12
"""Numbers of versions that are written below a chart; of more, every second or so."""
MOST_REGIONS: Final = 20
"""Regions of a step that are listed."""
MEANING: Final = {
    Change.BROKE: "A passes, B fails",
    Change.FIXED: "A fails, B passes",
    Change.BOTH_FAIL: "A fails, and so does B",
    Change.WITHIN_CHANCE: "one fails and the other does not, by no more than chance",
    Change.NO_VERDICT_OF_A: "A ends with an error or a timeout",
    Change.NO_VERDICT_OF_B: "B ends with an error or a timeout",
    Change.NO_VERDICT: "both end with an error or a timeout",
    Change.NOT_RUN_AGAIN: "known of one of the two alone",
}
"""The sections of the page of two campaigns, in their order."""
REGION_MEANING: Final = {
    RegionChange.FIXED: "the earlier version fails there; the later one tested cases there, none "
    "failed",
    RegionChange.BROKE: "the later version fails there; the earlier one tested cases there, none "
    "failed",
    RegionChange.STILL: "both fail there",
    RegionChange.NOT_SEEN_AFTER: "the earlier version fails there; the later one tested no case "
    "there",
    RegionChange.NOT_SEEN_BEFORE: "the later version fails there; the earlier one tested no case "
    "there",
}
MARKS: Final = {Change.BROKE: "broke", Change.FIXED: "fixed", Change.BOTH_FAIL: "safe"}
"""Marks in the maps; what is not here has none of the three verdicts."""


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
OVER_VERSIONS: Final = Frame(60.0, 340.0, 12.0, 150.0)


@dataclass(frozen=True, slots=True)
class Line:
    """A line of a chart.

    Attributes:
        css: its CSS class.
        parts: "x,y x,y" of each of its parts: a line ends where a version has no value.
        name: what it is, in the legend.
        points: (x, y, words) of the points that say what they are.
    """

    css: str
    parts: list[str]
    name: str = ""
    points: Sequence[tuple[float, float, str]] = ()


@dataclass(frozen=True, slots=True)
class Chart:
    """Lines over time or versions, with (y, words) and (x, words) of the ticks.

    `window` is where an acceleration lane lies, as (y, height), and `dot` the place of a merge from
    it; None without one.
    """

    title: str
    lines: list[Line]
    ticks: list[tuple[float, str]]
    names: list[tuple[float, str]]
    window: tuple[float, float] | None = None
    dot: tuple[float, float] | None = None


AGAINST_PAGE: Final = f"{AGAINST}.html"
"""Page in the folder of a campaign against an earlier version."""
STYLES: Final = ("report.css", "history.css")


def write_page(html: str, path: Path) -> None:
    """Write a page as a new file; `UserError` where something is at `path`."""
    write_new(path, html.encode(errors="backslashreplace"))


# Two campaigns.


Motions = Mapping[tuple[str, int], Trajectory]
"""What a VUT did in a case of the other's campaign, by that campaign, "A" or "B", and index."""


def write_against(run: Run) -> None:
    """Write the page of a campaign against an earlier version into its folder; else do nothing."""
    compared, earlier = compare_against(run), earlier_run(run)
    if compared is None or earlier is None:
        return
    recorded = earlier.trajectories(case.index for case in compared.cases[:SHOWN])
    motions = {("B", index): trajectory for index, trajectory in recorded.items()}
    html = comparison_page(compared, earlier, run, motions, same_cases=True)
    replace_own(run.folder / AGAINST_PAGE, html.encode(errors="backslashreplace"))


def comparison_page(
    compared: RunComparison,
    a: Run,
    b: Run,
    motions: Motions,
    tolerance: float = 0.0,
    *,
    same_cases: bool = False,
) -> str:
    """Return the page of a comparison of two campaigns as HTML, with both motions of each case.

    `motions` are those of the cases that were run again with the other VUT; B may be worse by
    `tolerance`. `same_cases` says that both campaigns have the same cases.
    """
    runs, lane_m = {"A": a, "B": b}, lane_of(a.scenario)
    shown = [_shown(case, runs, motions) for case in compared.cases[:SHOWN]]
    sections = {
        change: [one for one in shown if one["case"].change is change] for change in MEANING
    }
    by_level = {
        level: [case for case in compared.cases if case.case.level == level]
        for level in compared.levels
    }
    return page(
        "comparison.html.jinja",
        styles=STYLES,
        runs=runs,
        compared=compared,
        same_cases=same_cases,
        why=compared.worse(tolerance),
        tolerance=tolerance,
        counts=_counts(compared),
        changes=compared.named_changes,
        # What broke lies on top.
        maps={
            level: map_of([(c.case, MARKS.get(c.change, "unknown")) for c in reversed(cases)])
            for level, cases in by_level.items()
            if cases
        },
        sections={change: cases for change, cases in sections.items() if cases},
        meaning=MEANING,
        more=len(compared.cases) - len(shown),
        lane_m=lane_m,
        places={name: found for name, found in compared.merging.items() if lane_m is not None},
        source=SOURCE,
    )


def _counts(compared: RunComparison) -> str:
    """Return in words what became of how many cases."""
    numbers = [(sum(c.change is change for c in compared.cases), change) for change in MEANING]
    parts = [f"{number} {change.value}" for number, change in numbers if number]
    if not parts:
        return "No case of either campaign fails or ends without a verdict."
    return f"{counted(len(compared.cases), 'case')}: {in_words(parts)}."


def _shown(case: ComparedCase, runs: Mapping[str, Run], motions: Motions) -> dict[str, Any]:
    """Return what the page says of a case; a VUT has no charts where its motion is not known."""
    known = {name: motions.get((case.run, case.index)) for name in runs}
    known[case.run] = runs[case.run].trajectories([case.index]).get(case.index)
    both = [motion for motion in known.values() if motion is not None]
    sides = []
    for name, outcome in (("A", case.a), ("B", case.b)):
        motion = known[name]
        charts = [] if motion is None else _motion_charts(motion, both)
        sides.append({"name": name, "how": _how(outcome), "charts": charts})
    command = f"merge-sumo replay {quoted(runs[case.run].folder)} {case.index} --gui"
    return {"case": case, "where": described(case.case), "command": command, "sides": sides}


def _how(outcome: Outcome | None) -> str:
    """Return how a case went with a VUT, in a few words."""
    if outcome is None:
        return "not run"
    words = [outcome.measures.end.value.replace("_", " ").lower()]
    if outcome.measures.severity is not None:
        words.append(outcome.measures.severity)
    if outcome.score is not None:
        words.append(f"score {outcome.score:.0f}".replace("-", "−"))
    return ", ".join(words)


def _motion_charts(motion: Trajectory, both: Sequence[Trajectory]) -> list[Chart]:
    """Return speeds and distances to M of all cars, over the axes of both motions of the case."""
    end_s = max(m.t_end_s for m in both) or DT_S
    speeds, places = (
        _motion_chart(title, motion.motion[:, :, k], [m.motion[:, :, k] for m in both], end_s)
        for title, k in (("speed, m/s", 1), ("distance to M, m", 0))
    )
    lane_m = lane_of(motion.case.scenario)
    return [speeds, places if lane_m is None else _with_lane(places, motion, both, lane_m)]


def _with_lane(
    chart: Chart, motion: Trajectory, both: Sequence[Trajectory], lane_m: Bounds
) -> Chart:
    """Return the chart of the places of cars with an acceleration lane and the merge from it."""
    shown = np.concatenate([m.motion[:, :, 0].ravel() for m in both])
    low, span = float(shown.min()), max(float(np.ptp(shown)), 1.0)
    bottom, top = (OVER_TIME.y(min(max((x_m - low) / span, 0.0), 1.0)) for x_m in lane_m)
    dot = None
    if motion.end is End.MERGED:
        end_s = max(m.t_end_s for m in both) or DT_S
        share = (float(motion.x_vut_m[-1]) - low) / span
        dot = OVER_TIME.x(motion.t_end_s / end_s), OVER_TIME.y(share)
    return replace(chart, window=(top, round(bottom - top, 1)), dot=dot)


def _motion_chart(title: str, rows: FloatArray, both: Sequence[FloatArray], end_s: float) -> Chart:
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
        lines.append(Line(VEHICLES[vehicle], [" ".join(points)]))
    ticks = [
        (OVER_TIME.y(share), f"{low + span * share:.0f}".replace("-", "−"))
        for share in (0.0, 0.5, 1.0)
    ]
    return Chart(
        title, lines, ticks, [(OVER_TIME.x(share), f"{share * end_s:g}") for share in (0.0, 1.0)]
    )


# A history.


def history_page(history: History) -> str:
    """Return the page of a history as HTML."""
    return page(
        "history.html.jinja",
        styles=STYLES,
        history=history,
        charts=_history_charts(history),
        tables={level: _table(history, level) for level in history.levels},
        RegionChange=RegionChange,
        meaning=REGION_MEANING,
        most=MOST_REGIONS,
    )


def _history_charts(history: History) -> list[Chart]:
    def by_level(title: str, value: Callable[[LevelOfVersion], float | None]) -> Chart:
        rows = {
            (f"level {level_name(level)}", f"level{level}"): [
                value(version.levels[level]) if level in version.levels else None
                for version in history.versions
            ]
            for level in history.levels
        }
        return _version_chart(title, rows)

    kinds: dict[tuple[str, str], list[float | None]] = {
        (kind.value, f"kind{number}"): [
            # A sum over fewer levels is no smaller number of failures.
            float(sum(level.kinds.get(kind, 0) for level in version.levels.values()))
            if len(version.levels) == len(history.levels)
            else None
            for version in history.versions
        ]
        for number, kind in enumerate(Kind)
    }
    return [
        by_level("Failure mode coverage (FMC)", lambda level: level.fmc),
        by_level(
            "Failures",
            lambda level: float(level.verdict.failures) if level.verdict.tested else None,
        ),
        by_level("Regions", lambda level: level.regions),
        _version_chart(
            "Kinds of failure, all levels", {key: row for key, row in kinds.items() if any(row)}
        ),
        *([_places_chart(history)] if any(version.merging for version in history.versions) else []),
    ]


def _places_chart(history: History) -> Chart:
    """Return where on an acceleration lane the versions merge, by level."""
    rows = {
        (f"level {level_name(level)}", f"level{level}"): [
            _place(version.merging.get(level)) for version in history.versions
        ]
        for level in history.levels
    }
    return _version_chart("Place of the merge, median share of the lane", rows)


def _place(found: MergeStatistics | None) -> float | None:
    """Return the median place; a merge where the lane ends is beyond it by the way of a step."""
    share = None if found is None else found.lane_share
    return None if share is None else min(share, 1.0)


def _version_chart(title: str, rows: dict[tuple[str, str], list[float | None]]) -> Chart:
    """Return a chart; a row has a value for each version, None where there is none."""
    count = len(next(iter(rows.values()), []))
    top = axis_end([value for row in rows.values() for value in row if value is not None])
    across = [OVER_VERSIONS.x(place / max(count - 1, 1)) for place in range(count)]
    lines = []
    for (name, css), row in rows.items():
        parts: list[list[str]] = [[]]
        points = []
        for place, value in enumerate(row):
            if value is None:
                parts.append([])
                continue
            x, y = across[place], OVER_VERSIONS.y(value / top)
            parts[-1].append(f"{x},{y}")
            points.append((x, y, f"version {place + 1}, {name}: {value:.4g}"))
        lines.append(Line(css, [" ".join(part) for part in parts if len(part) > 1], name, points))
    every = math.ceil(count / MOST_NAMES) or 1
    return Chart(
        title,
        lines,
        [(OVER_VERSIONS.y(share), f"{share * top:g}") for share in (0.0, 0.5, 1.0)],
        [(across[place], str(place + 1)) for place in range(0, count, every)],
    )


def axis_end(values: Sequence[float]) -> float:
    """Return the end of an axis: 2, 4 or 10 times a power of ten, so that its half is round."""
    most = max(values, default=0.0)
    if most <= 0.0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(most))
    return float(f"{next(step * power for step in (2, 4, 10, 20) if step * power >= most):.12g}")


def _table(history: History, level: int) -> list[tuple[str, list[str]]]:
    """Return the rows of a level's table: a name, and a cell for each version."""
    of_versions = [version.levels.get(level) for version in history.versions]
    known = [one for one in of_versions if one is not None]

    def if_tested(value: Callable[[LevelOfVersion], Any]) -> Callable[[LevelOfVersion], Any]:
        return lambda one: value(one) if one.verdict.tested else "–"

    rows: list[tuple[str, Callable[[LevelOfVersion], Any]]] = [
        ("FMC", if_tested(lambda one: f"{one.fmc:.4f}")),
        ("failures", if_tested(lambda one: one.verdict.failures)),
        ("of these contacts", if_tested(lambda one: one.verdict.contacts)),
        *((f"{word} in all", if_tested(partial(_of_severity, word))) for word in Severity),
        ("of tested cases", lambda one: one.verdict.tested),
    ]
    if any(one.verdict.errors or one.verdict.timeouts for one in known):
        rows.append(("errors", lambda one: one.verdict.errors))
        rows.append(("timeouts", lambda one: one.verdict.timeouts))
    rows.append(("regions", if_tested(lambda one: one.regions)))
    rows += [
        (kind.value, partial(_of_kind, kind))
        for kind in Kind
        if any(kind in one.kinds for one in known)
    ]
    if any(one.avoidance_known for one in known):
        rows.append(("avoided by a careful driver", _avoided))
    table = [
        (name, ["" if one is None else str(value(one)) for one in of_versions])
        for name, value in rows
    ]
    return [*table, *_merging_rows(history, level)]


def _merging_rows(history: History, level: int) -> list[tuple[str, list[str]]]:
    """Return the rows of a level's table on merges from an acceleration lane; none without one."""
    found = [version.merging.get(level) for version in history.versions]
    if not any(found):
        return []
    rows: list[tuple[str, Callable[[MergeStatistics], str]]] = [
        ("place of the merge, median", lambda one: _or_dash(one.lane_share, ".0%")),
        ("merges at the end of the lane", lambda one: str(one.forced)),
        ("stood on the lane", lambda one: str(one.stood)),
        ("time gap ahead, median s", lambda one: _or_dash(one.time_gap_ahead_s, ".2f")),
        ("time gap behind, median s", lambda one: _or_dash(one.time_gap_behind_s, ".2f")),
    ]
    return [(name, ["" if one is None else value(one) for one in found]) for name, value in rows]


def _or_dash(value: float | None, digits: str) -> str:
    return "–" if value is None else format(value, digits)


def _of_severity(severity: Severity, one: LevelOfVersion) -> int:
    return one.severities.get(severity, 0)


def _of_kind(kind: Kind, one: LevelOfVersion) -> int:
    return one.kinds.get(kind, 0)


def _avoided(one: LevelOfVersion) -> str:
    if not one.avoidance_known:
        return "–"
    return f"{one.avoided / one.avoidance_known:.0%} ({one.avoided} of {one.avoidance_known})"
