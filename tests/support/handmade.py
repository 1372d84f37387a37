"""A campaign made by hand, without SUMO: simple drivers, all levels, failures, and one error."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from merge_sumo.campaigns.journal import Journal
from merge_sumo.campaigns.recorded import RecordedCampaign
from merge_sumo.metrics.measures import FOLLOW_UP, OURS, Measures
from merge_sumo.metrics.outcome import Episode, Outcome
from merge_sumo.scenario.case import Case, from_unit
from merge_sumo.scenario.scenario import DT_S, POV, US23, VUT, Scenario
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.simulation.plan import versions

BATCH = 20
FOLLOWED_UP = [name for name, one in OURS.items() if one.only_with == FOLLOW_UP]
"""Measures of the follow-up."""


def drive(case: Case, error: str | None = None, *, timeout: bool = False) -> Trajectory:
    """Return an episode: the POV brakes a little at levels 1 and 2, the VUT coasts from 3 s.

    In a timeout the VUT brakes to a stop instead, for 12 s. Other cars of the mainline keep their
    speeds.
    """
    starts = np.array(case.starts())
    x, v = starts[:, 0], starts[:, 1]
    rows: list[np.ndarray] = []
    while x[VUT] < 0.0 and len(rows) * DT_S < 12.0:
        t_s = len(rows) * DT_S
        a = np.zeros(len(x))
        if case.level and 2.0 < t_s < 5.0 + (case.svo_rad or 0.0):
            a[POV] = -0.5
        a[VUT] = 1.0
        if t_s >= 3.0:
            hardest = max(US23.a_min_mps2, -v[VUT] / DT_S)
            a[VUT] = hardest if timeout else 0.05 * hardest
        rows.append(np.stack((x, v, a), axis=1))
        x, v = x + v * DT_S, v + a * DT_S
    rows.append(np.stack((x, v, np.zeros(len(x))), axis=1))
    end = End.MERGED if error is None else End.VUT_ERROR
    return Trajectory(case, np.array(rows), End.TIMEOUT if timeout else end, error)


def cases_of(level: int, count: int, scenario: Scenario = US23) -> list[Case]:
    """Return cases, half of them near the place where both arrive together."""
    rng = np.random.default_rng([7, level])
    points = rng.random((count, len(scenario.dimensions(level))))
    cases = from_unit(points, level, scenario=scenario)
    meets_s = (8.9, 8.8, 8.7)[level]
    near = []
    for case in cases[::2]:
        x_m = -meets_s * case.v_pov0_mps + float(rng.normal(0.0, 6.0))
        near.append(replace(case, x_pov0_m=max(-340.0, x_m)))
    return cases[1::2] + near


def write_run(
    folder: Path,
    per_level: int = 60,
    levels: tuple[int, ...] = (0, 1, 2),
    errors: Mapping[int, str] | None = None,
    timeouts: Collection[int] = (),
    scenario: Scenario = US23,
    **settings: Any,
) -> RecordedCampaign:
    """Write a campaign of `per_level` cases at each level and return it.

    By default the last case has an error, else those in `errors` and `timeouts`, by index.
    """
    by_level = [cases_of(level, per_level, scenario) for level in levels]
    cases = [case for group in zip(*by_level, strict=True) for case in group]
    record = {
        "vut": "handmade",
        "levels": list(levels),
        "sampler": "uniform",
        "cases": len(cases),
        "batch": BATCH,
        "seed": 1,
        "versions": versions(),
        **({} if scenario == US23 else {"scenario": asdict(scenario)}),
        **settings,
    }
    if errors is None:
        errors = {} if timeouts else {len(cases) - 1: "answered nan"}
    journal = Journal.create(folder, record)
    for batch, first in enumerate(range(0, len(cases), BATCH)):
        ran = []
        for index, case in enumerate(cases[first : first + BATCH], start=first):
            trajectory = drive(case, errors.get(index), timeout=index in timeouts)
            ran.append(Episode(Outcome(index, batch, case, Measures.of(trajectory)), trajectory))
        journal.append(ran)
    return RecordedCampaign(folder)
