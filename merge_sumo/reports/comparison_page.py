"""The page of a comparison: what changed from version to version, and both motions of each case.

It is one HTML file without scripts that loads nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from merge_sumo.campaigns.run import AGAINST, Run
from merge_sumo.reports.pages import page
from merge_sumo.scenario.coordinates import coordinates
from merge_sumo.scenario.scenario import VEHICLES, VUT
from merge_sumo.scenario.trajectory import Trajectory
from merge_sumo.studies.comparison import Change, Comparison, Step, compare_against, cut
from merge_sumo.studies.counterfactuals import causes
from merge_sumo.system.folders import replace_own
from merge_sumo.verdict.campaign_verdict import judge

SHOWN: Final = 200
"""Cases of a step that are drawn, those first that broke; of more, a heading says how many."""
MOST_REGIONS: Final = 20
"""Regions of a level that are listed."""
DRAWN: Final = (
    *(Change.BROKE, Change.WITHIN_CHANCE, Change.NEITHER, Change.STILL_CONTACT, Change.FIXED),
)
"""Changes of which a section has both motions of each case; the template says what they mean."""
AGAINST_PAGE: Final = f"{AGAINST}.html"
"""Page in the folder of a campaign against an earlier version."""
STYLES: Final = ("report.css", "comparison.css")


def write_against(run: Run) -> None:
    """Write the page of a campaign against an earlier version into its folder; else do nothing."""
    compared, earlier = compare_against(run), run.earlier()
    if compared is not None:
        html = comparison_page(compared, [earlier, run])
        replace_own(run.folder / AGAINST_PAGE, html.encode(errors="backslashreplace"))


def comparison_page(compared: Comparison, runs: Sequence[Run | None]) -> str:
    """Return the page of a comparison as HTML; `runs` have the motions of the versions, if any."""
    outcomes = next(version.outcomes for version in compared.versions if version.outcomes)
    return page(
        "comparison.html.jinja",
        styles=STYLES,
        compared=compared,
        counts=[judge(one.outcomes, one.tolerated).counts for one in compared.versions],
        steps=[(step, _maps(step), _sections(step, runs)) for step in compared.steps],
        vehicles=max(outcome.case.scenario.vehicles for outcome in outcomes),
        most=MOST_REGIONS,
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


def _sections(step: Step, runs: Sequence[Run | None]) -> list[tuple[Change, int, Any]]:
    """Return each change with the number of its cases, and of the first of them both motions.

    A case is shown as the pair of the versions, each with its run, its outcome, its cause, and
    its charts, which are none without a motion.
    """
    sections, left = [], SHOWN
    of_versions = runs[step.before - 1], runs[step.after - 1]
    for change in DRAWN:
        cases = [case for case in step.cases if case.change is change]
        shown = cases[:left]
        left -= len(shown)
        outcomes = [one.a for one in shown], [one.b for one in shown]
        sides = list(zip(of_versions, outcomes, strict=True))
        motions = [
            {} if run is None else run.trajectories(o.index for o in own) for run, own in sides
        ]
        said = [{} if run is None else causes(run, own) for run, own in sides]
        rows = []
        for one in shown:
            own = [found.get(o.index) for found, o in zip(motions, (one.a, one.b), strict=True)]
            both = [motion for motion in own if motion is not None]
            charts = [[] if motion is None else _charts(motion, both) for motion in own]
            words = said[0].get(one.a.index), said[1].get(one.b.index)
            rows.append((one, list(zip(of_versions, (one.a, one.b), words, charts, strict=True))))
        if cases:
            sections.append((change, len(cases), rows))
    return sections


def _charts(motion: Trajectory, both: Sequence[Trajectory]) -> list[dict[str, Any]]:
    """Return speeds and distances to M of all cars, over the axes of both motions of the case."""
    charts = []
    # The VUT lies on top.
    cars = sorted(range(motion.motion.shape[1]), key=lambda car: car == VUT)
    for title, k in (("speed, m/s", 1), ("distance to M, m", 0)):
        values = np.concatenate([one.motion[:, :, k].ravel() for one in both])
        low, high = float(values.min()), float(values.max())
        charts.append(
            {
                "title": title,
                "low": low,
                "high": max(high, low + 1.0),
                "steps": max(1, *(len(one.motion) - 1 for one in both)),
                "lines": [
                    (VEHICLES[car], np.round(motion.motion[:, car, k], 2).tolist()) for car in cars
                ],
            }
        )
    return charts
