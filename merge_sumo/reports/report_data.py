"""The data that the script of the report draws from: cases, motion, maps and charts, as JSON."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np

from merge_sumo.analysis.counterfactuals import causes
from merge_sumo.analysis.surface import Grid, Surface, nodes
from merge_sumo.metrics.fmc import fmc_growth, radius_for
from merge_sumo.metrics.measures import Measure, measures_in
from merge_sumo.metrics.merge import Conflict, Severity
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.summary import RunsOfCase, shortened
from merge_sumo.printable import printable
from merge_sumo.records import to_plain
from merge_sumo.reports.pages import ERROR_CHARACTERS
from merge_sumo.reports.report_model import ReportModel
from merge_sumo.reports.text import changes, name_and_unit
from merge_sumo.road.drawing import road_data
from merge_sumo.scenario.case import Coordinate, to_unit
from merge_sumo.scenario.scenario import ALL_LEVELS, DT_S, VEHICLES, Scenario, level_name
from merge_sumo.scenario.signals import to_record
from merge_sumo.scenario.trajectory import Trajectory

SPEED_UNIT_MPS = 0.002
"""Speeds are kept as whole numbers of this in 16 bits: up to 131 m/s, positions within 2 cm."""
COUNT_GRID = (32, 20)
GRID: dict[int, Grid] = {2: (49, 49, 1), 3: (33, 33, 9)}
"""Nodes of a map in its two coordinates and in the one that it moves through."""

Axes = tuple[int, int]
"""Places of two coordinates in the pool's order."""


def page_data(model: ReportModel) -> dict[str, Any]:
    """Return the data of a page as JSON has it."""
    scenario, lane_m = model.run.scenario, model.run.scenario.lane_m
    speeds, offsets = packed(model.motion)
    columns = [m for m in measures_in(scenario).values() if m.column]
    said = causes(model.run, model.shown)
    rows = [
        _row(model, o, offsets.get(o.index, 0), columns) | {"cause": said[o.index]}
        for o in model.shown
    ]
    shown = {o.index for o in model.shown}
    others = [o for o in model.cases if o.index not in shown]
    return {
        "dt": DT_S,
        "crash_m": scenario.dx_crash_m,
        "varies": model.varies,
        "lane": lane_m,
        "place": "M" if lane_m is None else scenario.place,
        "vehicles": VEHICLES[: scenario.vehicles],
        "level_names": {level: level_name(level) for level in ALL_LEVELS},
        "coordinates": [_coordinate(c) for c in model.coordinates],
        "severities": list(Severity),
        "measures": [
            {"name": m.name, "title": _title(m, scenario), "digits": m.digits}
            for m in columns
            if any(row[m.name] is not None for row in rows)
        ],
        "cases": {name: [row[name] for row in rows] for name in (rows or [{"index": 0}])[0]},
        "speeds": speeds,
        "speed_unit_mps": SPEED_UNIT_MPS,
        "signals": {i: to_record(t.signals) for i, t in model.motion.items() if t.signals},
        "why": _explanations(model),
        "boxes": [
            {"level": box.level, "cases": [index for index in box.indices if index in shown]}
            for box in model.boxes
        ],
        "maps": {
            level: map_data(
                *(scenario, level),
                [o for o in others if o.case.level == level],
                model.surfaces[level],
            )
            for level in model.levels
        },
        "search": _search(model),
        **road_data(model.road),
    }


def _title(measure: Measure[Any], scenario: Scenario) -> str:
    """Return name and unit of a measure, as the head of a column."""
    return f"{scenario.said(measure.column)} {measure.unit}".replace("s2", "s²").rstrip()


def _row(
    model: ReportModel, o: Outcome, offset: int, columns: Sequence[Measure[Any]]
) -> dict[str, Any]:
    """Return a case by column; it has no rows where its motion is not known."""
    motion, measures = model.motion.get(o.index), o.measures
    avoidance, course = model.avoidance.get(o.index), model.diagnoses.get(o.index)
    row: dict[str, Any] = {
        "index": o.index,
        "level": o.case.level,
        **{c.field: _rounded(c.of(o.case), c.digits + 2) for c in model.coordinates},
        "starts": [round(x_m, 3) for x_m, _ in o.case.starts()],
        "nearest": VEHICLES.index(measures.nearest),
        "offset": offset,
        "rows": 0 if motion is None else len(motion.whole),
        "conflict": None if motion is None else [*Conflict.of(motion)],
        "end": measures.end,
        "error": measures.error and shortened(measures.error, ERROR_CHARACTERS),
        "severity": measures.severity,
        "failed": o.failed,
        "margin": _rounded(o.margin, 3),
        "region": model.regions.get(o.index),
        "last_avoidable_s": _rounded(measures.last_avoidable_s, 1),
        **{m.name: _rounded(measures.value(m.name), 4) for m in columns},
        "vut_brakes_s": course and course.vut_brakes_s,
        "pov_brakes_s": course and course.pov_brakes_s,
        "kind": model.kinds.get(o.index),
    }
    if model.avoidance:
        row["avoided_by"] = avoidance and avoidance.avoided_by
        row["latest_takeover_s"] = avoidance and avoidance.latest_takeover_s
        row["pov_careful"] = avoidance and avoidance.pov_careful
    if model.repeated:
        row["runs"] = _runs(model.repeated.get(o.index))
    if model.undecided:
        row["undecided"] = o.index in model.undecided
    return row


def _runs(of: RunsOfCase | None) -> dict[str, Any] | None:
    """Return how many runs of a case failed, with the interval; None where it ran once."""
    if of is None:
        return None
    low, high = of.interval()
    each = [(run.index, run.failed) for run in of.outcomes]
    return {"failed": of.failures, "number": of.runs, "low": low, "high": high, "each": each}


def _explanations(model: ReportModel) -> dict[int, dict[str, Any]]:
    """Return by index the words on a failure, and its axes with a title each."""
    found: dict[int, dict[str, Any]] = {}
    for known in model.explanations:
        case = model.run.outcome(known.index).case
        words = list(changes(known, case))
        axes = []
        for axis in known.start:
            name, unit = name_and_unit(case, axis.name)
            axes.append({**to_plain(axis), "name": name, "unit": unit})
        for axis in known.parameters:
            axes.append({**to_plain(axis), "name": f"vut: {axis.name}", "unit": ""})
        if known.vut is not None:
            vut = printable(known.vut)
            words = [f"with {vut}: {sentence}" for sentence in words]
            axes = [{**axis, "name": f"{vut}: {axis['name']}"} for axis in axes]
        of_case = found.setdefault(known.index, {"words": [], "axes": []})
        of_case["words"] += words
        of_case["axes"] += axes
    return found


def _coordinate(c: Coordinate) -> dict[str, Any]:
    known = {"name": c.name, "unit": c.unit, "digits": c.digits, **to_plain(c.dimension)}
    # Cases are shown in full this near to where the reader is in a third coordinate.
    return {**known, "near": 1.0 / 16.0 * (c.dimension.high - c.dimension.low)}


def _search(model: ReportModel) -> dict[str, Any]:
    """Return the coverage of each level after numbers of cases."""
    outcomes = len(model.run.outcomes)
    steps = [outcomes * step // 20 for step in range(21)]
    levels = []
    for level in model.levels:
        failures = [o for o in model.worst if o.case.level == level]
        failures.sort(key=lambda outcome: outcome.index)
        points = to_unit([o.case for o in failures], level, model.run.scenario)
        growth = np.concatenate([[0.0], fmc_growth(points)])
        found = np.searchsorted([o.index for o in failures], steps)
        levels.append({"level": level, "fmc": growth[found].round(5).tolist()})
    return {"cases": steps, "levels": levels}


def packed(motions: dict[int, Trajectory]) -> tuple[str, dict[int, int]]:
    """Return the speeds of all cars at every step in base64, and the first row of each motion."""
    speeds = [motion.whole[:, :, 1] for motion in motions.values()]
    whole = [np.rint(np.clip(v / SPEED_UNIT_MPS, 0, 65535)).astype("<u2").tobytes() for v in speeds]
    first = np.cumsum([0, *map(len, speeds)]).tolist()
    return base64.b64encode(b"".join(whole)).decode(), dict(zip(motions, first, strict=False))


def pairs_of(dims: int) -> list[Axes]:
    """Return the pairs of coordinates of a level that may be shown, the first one first."""
    return [(0, 1)] if dims <= 3 else list(combinations(range(dims), 2))


def map_data(
    scenario: Scenario, level: int, others: Sequence[Outcome], surface: Surface | None
) -> dict[str, Any]:
    """Return the data of the map of a level.

    A level with two coordinates has one map; with a third, the reader moves through it. Of more, a
    map shows the cases in a pair, without a chance to fail. `others` are outcomes that the page
    counts instead of showing one by one.

    Args:
        scenario: scenario of the campaign.
        level: level of the POV.
        others: outcomes that are counted and not drawn.
        surface: surrogate of the level; None for no contour.
    """
    dims = len(scenario.dimensions(level))
    return {
        "pairs": pairs_of(dims),
        "through": 2 if dims == 3 else None,
        # The ball of more coordinates is as wide as the map: its shadow says nothing.
        "radius": radius_for(dims) if dims <= 3 else None,
        "grids": [
            {
                "chance": surface and _chance(surface, dims),
                "counts": _counts(others, scenario, level, axes) if others else None,
            }
            for axes in pairs_of(dims)
        ],
    }


def _counts(
    others: Sequence[Outcome], scenario: Scenario, level: int, axes: Axes
) -> dict[str, Any]:
    nx, ny = COUNT_GRID
    grid: dict[str, Any] = {"nx": nx, "ny": ny}
    for name, failing in (("safe", False), ("failing", True)):
        cases = (o.case for o in others if o.failed is failing)
        x, y = to_unit(cases, level, scenario)[:, list(axes)].T
        cells, _, _ = np.histogram2d(y, x, bins=(ny, nx), range=((0, 1), (0, 1)))
        grid[name] = cells.astype(int).ravel().tolist()
    return grid


def _chance(surface: Surface, dims: int) -> dict[str, Any] | None:
    """Return the chance at the nodes of a map in 255ths; None of more than three coordinates."""
    if dims not in GRID:
        return None
    nx, ny, through = grid = GRID[dims]
    values = np.rint(255.0 * surface.chance(nodes(grid))).astype(np.uint8)
    data = base64.b64encode(values.tobytes()).decode()
    return {"nx": nx, "ny": ny, "np": through, "data": data}


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)
