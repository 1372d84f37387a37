"""The page of a comparison: changes, and both motions of each case, in one file without scripts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from merge_sumo.analysis.comparison import Change, Comparison, VersionChange
from merge_sumo.campaigns.recorded import AGAINST
from merge_sumo.files import GENERATOR, replace_own
from merge_sumo.metrics.cause import cause
from merge_sumo.reports.pages import X_AXIS, page
from merge_sumo.reports.text import change_in_words, comparison_headline, fmc_rows
from merge_sumo.scenario.case import FloatArray, coordinates
from merge_sumo.scenario.scenario import VEHICLES, VUT

SHOWN = 200
"""Maximum number of cases of a change of version that are drawn, in the order of tables."""
DRAWN = (
    Change.BROKE,
    Change.WITHIN_CHANCE,
    Change.NOT_REPEATABLE,
    Change.NEITHER,
    Change.STILL_CONTACT,
    Change.FIXED,
)
"""Changes that have a section with both motions of each case; the template explains them."""
PAGE = ".html"
"""Ending of a page; a browser shows a file with another ending as source."""
AGAINST_PAGE = f"{AGAINST}{PAGE}"
"""Page in the folder of a campaign against an earlier version."""
STYLES = ("report.css", "comparison.css")


def write_against(folder: Path, compared: Comparison) -> None:
    """Write the page of a campaign against an earlier version, in place of an older one.

    Args:
        folder: folder of the campaign.
        compared: the comparison with the earlier version.

    Raises:
        UserError: it cannot be written, or merge-sumo did not create the file in its place.
    """
    content = comparison_page(compared).encode(errors="backslashreplace")
    replace_own(folder / AGAINST_PAGE, content, GENERATOR)


def comparison_page(compared: Comparison) -> str:
    """Return the page of a comparison as HTML.

    Args:
        compared: the comparison.
    """
    rows = [(one, _maps(one), _sections(one, compared)) for one in compared.version_changes]
    outcomes = [version.outcomes[0] for version in compared.versions if version.outcomes]
    return page(
        "comparison.html.jinja",
        styles=STYLES,
        compared=compared,
        headline=comparison_headline(compared),
        fmc=fmc_rows(compared),
        change_in_words=change_in_words,
        version_changes=rows,
        vehicles=outcomes[0].case.scenario.vehicles,
    )


def _maps(version_change: VersionChange) -> dict[int, Any]:
    """Return by level its coordinates, and where cases changed; those that broke lie on top."""
    maps: dict[int, Any] = {}
    for one in reversed(version_change.cases):
        if one.change in DRAWN:
            case = one.earlier.case
            axes = coordinates(case.scenario, (case.level,))
            maps.setdefault(case.level, (axes, []))[1].append((one.change, case))
    return dict(sorted(maps.items()))


def _sections(version_change: VersionChange, compared: Comparison) -> list[tuple[Change, int, Any]]:
    """Return a section for each change: the change, its number of cases, a row for each case shown.

    A row has the case, its versions (number, folder, outcome, cause), and the charts.
    """
    sections, left = [], SHOWN
    for change in DRAWN:
        cases = [case for case in version_change.cases if case.change is change]
        shown = cases[:left]
        left -= len(shown)
        rows = []
        for one in shown:
            versions, motions = [], {}
            for name, number in (
                ("earlier", version_change.number - 1),
                ("later", version_change.number),
            ):
                outcome, version = getattr(one, name), compared.versions[number - 1]
                motion = version.motion(outcome.index)
                versions.append((number, version.folder, outcome, cause(outcome, motion)))
                if motion is not None:
                    motions[name] = motion.whole
            rows.append((one, versions, _charts(motions)))
        if cases:
            sections.append((change, len(cases), rows))
    return sections


def _charts(motions: Mapping[str, FloatArray]) -> list[dict[str, Any]]:
    """Return speeds and positions of all cars in both motions, over the same axes."""
    charts = []
    for title, k in (("speed, m/s", 1), (X_AXIS, 0)) if motions else ():
        lines = []
        # The VUT lies on top.
        for car in sorted(range(next(iter(motions.values())).shape[1]), key=lambda car: car == VUT):
            for name, motion in motions.items():
                values = np.round(motion[:, car, k], 2).tolist()
                lines.append((f"{VEHICLES[car]} {name}", values))
        drawn = np.concatenate([motion[:, :, k].ravel() for motion in motions.values()])
        low, high = (round(float(end), 2) for end in (drawn.min(), drawn.max()))
        steps = max(map(len, motions.values())) - 1
        chart = {"title": title, "low": low, "high": max(high, low + 1.0), "lines": lines}
        charts.append(chart | {"steps": max(1, steps)})
    return charts
