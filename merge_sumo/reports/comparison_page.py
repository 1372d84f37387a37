"""The page of a comparison: what changed from version to version, and both motions of each case.

It is one HTML file without scripts that loads nothing.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from merge_sumo.analysis.comparison import Change, Comparison, Step, compare_against, cut
from merge_sumo.campaigns.run import AGAINST, Run
from merge_sumo.files import GENERATOR, replace_own
from merge_sumo.metrics.cause import cause
from merge_sumo.metrics.summary import judge
from merge_sumo.reports.pages import X_AXIS, page
from merge_sumo.reports.text import change_in_words, comparison_headline, fmc_rows
from merge_sumo.scenario.case import FloatArray, coordinates
from merge_sumo.scenario.scenario import DT_S, VEHICLES, VUT

SHOWN = 200
"""Cases of a step that are drawn, those first that broke; of more, a heading says how many."""
DRAWN = (
    *(Change.BROKE, Change.WITHIN_CHANCE, Change.NOT_REPEATABLE, Change.NEITHER),
    *(Change.STILL_CONTACT, Change.FIXED),
)
"""Changes of which a section has both motions of each case; the template says what they mean."""
PAGE = ".html"
"""Ending of a page: a browser shows a file with another one as source."""
AGAINST_PAGE = f"{AGAINST}{PAGE}"
"""Page in the folder of a campaign against an earlier version."""
STYLES = ("report.css", "comparison.css")


def write_against(run: Run) -> None:
    """Write the page of a campaign against an earlier version into its folder; else do nothing."""
    compared = compare_against(run)
    if compared is not None:
        html = comparison_page(compared)
        content = html.encode(errors="backslashreplace")
        replace_own(run.folder / AGAINST_PAGE, content, GENERATOR)


def comparison_page(compared: Comparison) -> str:
    """Return the page of a comparison as HTML."""
    outcomes = next(version.outcomes for version in compared.versions if version.outcomes)
    return page(
        "comparison.html.jinja",
        styles=STYLES,
        compared=compared,
        headline=comparison_headline(compared),
        counts=[judge(one.outcomes, one.tolerated).counts for one in compared.versions],
        fmc=fmc_rows(compared),
        change_in_words=change_in_words,
        steps=[(step, _maps(step), _sections(step, compared)) for step in compared.steps],
        vehicles=max(outcome.case.scenario.vehicles for outcome in outcomes),
        # Regions of a level that are listed.
        most=20,
        cut=cut,
    )


def _maps(step: Step) -> dict[int, Any]:
    """Return by level its coordinates, and where cases changed; what broke lies on top."""
    maps: dict[int, Any] = {}
    for one in reversed(step.cases):
        if one.change in DRAWN:
            case = one.a.case
            axes = coordinates(case.scenario, (case.level,))
            maps.setdefault(case.level, (axes, []))[1].append((one.change, case))
    return dict(sorted(maps.items()))


def _sections(step: Step, compared: Comparison) -> list[tuple[Change, int, Any]]:
    """Return each change with the number of its cases, and of the first of them the picture.

    Of a case: what became of it; by version its number, folder, outcome, and cause; the charts;
    when the motions begin to differ.
    """
    sections, left = [], SHOWN
    numbers = (step.before, step.after)
    versions = [compared.versions[number - 1] for number in numbers]
    folders = [version.folder for version in versions]
    for change in DRAWN:
        cases = [case for case in step.cases if case.change is change]
        shown = cases[:left]
        left -= len(shown)
        pairs = [(one.a, one.b) for one in shown]
        known = [
            version.motions(outcome.index for outcome in outcomes)
            for version, outcomes in zip(versions, zip(*pairs, strict=True), strict=False)
        ]
        rows = []
        for one, pair in zip(shown, pairs, strict=True):
            found = [of.get(outcome.index) for of, outcome in zip(known, pair, strict=True)]
            motions = [None if motion is None else motion.whole for motion in found]
            words = [cause(outcome, own) for outcome, own in zip(pair, found, strict=True)]
            both = list(zip(numbers, folders, pair, words, strict=True))
            rows.append((one, both, _charts(*motions), _differ_s(*motions)))
        if cases:
            sections.append((change, len(cases), rows))
    return sections


def _differ_s(earlier: FloatArray | None, later: FloatArray | None) -> float | None:
    """Return when two motions, (T + 1, A, 3), begin to differ; None where they do not."""
    if earlier is None or later is None:
        return None
    rows = min(len(earlier), len(later))
    # In m, m/s and m/s2: motions that differ by less look alike.
    apart = (np.abs(earlier[:rows] - later[:rows]) > 0.005).any(axis=(1, 2))
    if len(earlier) == len(later) and not apart.any():
        return None
    return round((int(apart.argmax()) if apart.any() else rows - 1) * DT_S, 1)


def _charts(earlier: FloatArray | None, later: FloatArray | None) -> list[dict[str, Any]]:
    """Return speeds and positions of all cars in both motions, over the same axes."""
    known = [
        (name, one) for name, one in (("earlier", earlier), ("later", later)) if one is not None
    ]
    charts = []
    for title, k in (("speed, m/s", 1), (X_AXIS, 0)) if known else ():
        values = np.concatenate([one[:, :, k].ravel() for _, one in known])
        low, high = float(values.min()), float(values.max())
        # The VUT lies on top.
        cars = sorted(range(known[0][1].shape[1]), key=lambda car: car == VUT)
        charts.append(
            {
                "title": title,
                "low": low,
                "high": max(high, low + 1.0),
                "steps": max(1, *(len(one) - 1 for _, one in known)),
                "lines": [
                    (f"{VEHICLES[car]} {name}", np.round(one[:, car, k], 2).tolist())
                    for car in cars
                    for name, one in known
                ],
            }
        )
    return charts
