"""A campaign made by hand, without SUMO: simple drivers, all levels, failures, and one error."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from merge_sumo.campaigns.journal import Journal
from merge_sumo.campaigns.run import Run
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
    """Return an episode: the POV brakes a little at level 1 and 2, the VUT coasts from 3 s.

    In a timeout it brakes instead, and stands until 12 s. Other cars of the mainline keep their
    speed.
    """
    rows = []
    x, v = (list(values) for values in zip(*case.starts(), strict=True))
    step = 0
    while x[VUT] < 0.0 and step * DT_S < 12.0:
        a = [0.0] * len(x)
        if case.level and 2.0 < step * DT_S < 5.0 + (case.svo_rad or 0.0):
            a[POV] = -0.5
        a[VUT] = (
            1.0
            if step * DT_S < 3.0
            else max(US23.a_min_mps2, -v[VUT] / DT_S) * (1.0 if timeout else 0.05)
        )
        rows.append(list(zip(x, v, a, strict=True)))
        x = [place + speed * DT_S for place, speed in zip(x, v, strict=True)]
        v = [speed + change * DT_S for speed, change in zip(v, a, strict=True)]
        step += 1
    rows.append(list(zip(x, v, [0.0] * len(x), strict=True)))
    end = End.TIMEOUT if timeout else End.MERGED if error is None else End.VUT_ERROR
    return Trajectory(case, np.array(rows), end, error)


def cases_of(level: int, count: int, scenario: Scenario = US23) -> list[Case]:
    """Return cases, half of them near the place where both arrive together."""
    rng = np.random.default_rng([7, level])
    points = rng.random((count, len(scenario.dimensions(level))))
    cases = from_unit(points, level, scenario=scenario)
    meets = {0: 8.9, 1: 8.8, 2: 8.7}[level]
    near = [
        replace(
            case,
            x_pov0_m=max(-340.0, -meets * case.v_pov0_mps + float(rng.normal(0.0, 6.0))),
        )
        for case in cases[::2]
    ]
    return cases[1::2] + near


def write_run(
    folder: Path,
    per_level: int = 60,
    levels: tuple[int, ...] = (0, 1, 2),
    error: str | None = "answered nan",
    errors: Mapping[int, str] | None = None,
    timeouts: Collection[int] = (),
    scenario: Scenario = US23,
    **settings: Any,
) -> Run:
    """Write a campaign of `per_level` cases at each level and return it.

    The last case errs, or instead of it those in `errors` and `timeouts`, by index.
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
        errors = {len(cases) - 1: error} if error is not None and not timeouts else {}
    journal = Journal.create(folder, record)
    for batch, first in enumerate(range(0, len(cases), BATCH)):
        ran = []
        for index, case in enumerate(cases[first : first + BATCH], start=first):
            trajectory = drive(case, errors.get(index), timeout=index in timeouts)
            ran.append(Episode(Outcome(index, batch, case, Measures.of(trajectory)), trajectory))
        journal.append(ran)
    return Run(folder)
