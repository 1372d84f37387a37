"""The page of a comparison in one file: failures, changes, and a list of cases with a player."""

from __future__ import annotations

from typing import Any

from merge_sumo.analysis.comparison import (
    Change,
    ComparedCase,
    Comparison,
    VersionChange,
    outcome_word,
)
from merge_sumo.campaigns.printed_commands import command
from merge_sumo.campaigns.recorded import AGAINST
from merge_sumo.metrics.timeline import timeline
from merge_sumo.reports.pages import page
from merge_sumo.reports.report_data import columns, motion_row, packed, player_data
from merge_sumo.reports.text import change_in_words
from merge_sumo.road.loader import centre_lines, road_or_shipped

SHOWN = 1000
"""Maximum number of cases of a page that are listed, with both motions."""
PAGE = ".html"
"""Ending of a page; a browser shows a file with another ending as source."""
AGAINST_PAGE = f"{AGAINST}{PAGE}"
"""Page in the folder of a campaign against an earlier version."""
ShownCases = list[tuple[VersionChange, ComparedCase]]


def comparison_page(compared: Comparison) -> str:
    """Return the page of a comparison as HTML.

    Args:
        compared: the comparison.
    """
    shown: ShownCases = []
    lists = []
    for version_change in compared.version_changes:
        for change in Change:
            cases = []
            for one in version_change.cases:
                is_alike = outcome_word(one.earlier) == outcome_word(one.later)
                if one.change is change and not (is_alike and change is Change.BOTH):
                    cases.append(one)
            first, cases_shown = len(shown), cases[: SHOWN - len(shown)]
            shown += [(version_change, one) for one in cases_shown]
            if cases:
                rows = list(enumerate(cases_shown, start=first))
                lists.append((version_change, change, len(cases), rows))
    return page(
        "comparison.html.jinja",
        styles=("report.css", "tally.css", "comparison.css"),
        scripts=("player.js", "comparison.js") if shown else (),
        compared=compared,
        change_in_words=change_in_words,
        outcome_word=outcome_word,
        lists=lists,
        maps=_maps(shown),
        data=_data(compared, shown) if shown else None,
    )


def _maps(shown: ShownCases) -> dict[tuple[int, int], Any]:
    """Return coordinates and marks by version and level, with the first marks on top."""
    maps: dict[tuple[int, int], Any] = {}
    for number, (version_change, one) in reversed(list(enumerate(shown))):
        case = one.earlier.case
        axes = case.scenario.dimensions(case.level)
        found = maps.setdefault((version_change.number, case.level), (axes, []))
        found[1].append((one.change, case, number))
    return dict(sorted(maps.items()))


def _data(compared: Comparison, shown: ShownCases) -> dict[str, Any]:
    """Return the data of the scripts, with two entries of `cases` for each case shown."""
    scenario = shown[0][1].later.case.scenario
    road = road_or_shipped(scenario)
    road_lines = centre_lines(road)
    motions, rows = [], []
    for version_change, one in shown:
        later = version_change.number
        for number, outcome in ((later - 1, one.earlier), (later, one.later)):
            version, replay = compared.versions[number - 1], ""
            motion = version.motion(outcome.index)
            if motion is not None:
                motions.append(motion)
            if version.folder is not None:
                replay = command("replay", version.folder, outcome.index, gui=True)
            row = motion_row(outcome, motion, timeline(outcome, motion, road_lines))
            rows.append(row | {"version": f"{number}  {version.vut}", "replay": replay})
    return {"cases": columns(rows), "speeds": packed(motions), **player_data(scenario, road)}
