"""The data that the script of the report draws: cases, motion, maps and charts, as JSON."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from dataclasses import astuple
from itertools import combinations
from typing import Any

import numpy as np

from merge_sumo.analysis.surface import Grid, Surface, nodes
from merge_sumo.metrics.bodies import WIDTH_M
from merge_sumo.metrics.fmc import fmc_growth, radius_for
from merge_sumo.metrics.measures import recorded_measures
from merge_sumo.metrics.merge import Conflict, Severity
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.summary import CONFIDENCE, clopper_pearson, shortened
from merge_sumo.metrics.timeline import Timeline
from merge_sumo.printable import printable
from merge_sumo.records import to_plain
from merge_sumo.reports.pages import ERROR_CHARACTERS
from merge_sumo.reports.report_model import ReportModel
from merge_sumo.reports.text import axes_of, changes
from merge_sumo.road.drawing import road_data
from merge_sumo.road.loader import centre_lines
from merge_sumo.road.road import Road
from merge_sumo.scenario.case import FloatArray, to_unit
from merge_sumo.scenario.scenario import ALL_LEVELS, DT_S, VEHICLES, Scenario, level_name
from merge_sumo.scenario.signals import to_runs
from merge_sumo.scenario.trajectory import Trajectory

SPEED_UNIT_MPS = 0.002
"""Unit of speeds, which are whole numbers in 16 bits: up to 131 m/s, positions within 2 cm."""
COUNT_GRID = (32, 20)
"""Cells of a map, across and up, in which further cases are counted."""
GRID: dict[int, Grid] = {2: (49, 49, 1), 3: (33, 33, 9)}
"""Nodes of the surrogate by number of coordinates; a map moves through the third one."""


def page_data(model: ReportModel) -> dict[str, Any]:
    """Return the data of a report, as values that msgspec writes as JSON.

    Args:
        model: the content of the report.

    Returns:
        `cases` has the columns of `_row`. From it, `allCases` in report.js makes the table All
        cases, with a column for each entry of `measures` that some case has. `speeds` is the result
        of `packed`.
    """
    scenario = model.run.scenario
    measures = []
    for name, measure in recorded_measures(scenario).items():
        if measure.column:
            title = scenario.wording(measure.column)
            shown = {"name": name, "title": title, "unit": measure.unit, "digits": measure.digits}
            measures.append(shown)
    return {
        "varies": model.varies,
        "level_names": {level: level_name(level) for level in ALL_LEVELS},
        "coordinates": model.coordinates,
        "severities": list(Severity),
        "measures": measures,
        "cases": columns(_row(model, outcome) for outcome in model.shown),
        "speeds": packed(model.motion.values()),
        "signals": {i: to_runs(t.signals) for i, t in model.motion.items() if t.signals},
        "why": _explanations(model),
        "regions": model.described,
        "count_grid": COUNT_GRID,
        "maps": {level: _map(model, level) for level in model.levels},
        "search": _search(model),
        **player_data(scenario, model.road),
    }


def player_data(scenario: Scenario, road: Road) -> dict[str, Any]:
    """Return the data of player.js apart from cases and speeds.

    Args:
        scenario: the scenario of the cases.
        road: its road.
    """
    return {
        "dt": DT_S,
        "crash_m": scenario.dx_crash_m,
        "lane": scenario.lane_m,
        "vehicles": VEHICLES[: scenario.vehicles],
        "lengths_m": scenario.lengths_m,
        "width_m": WIDTH_M,
        "speed_unit_mps": SPEED_UNIT_MPS,
        **road_data(road),
    }


def columns(rows: Iterable[dict[str, Any]]) -> dict[str, list[Any]]:
    """Return the values of all rows by name.

    Args:
        rows: rows with the same names.
    """
    found: dict[str, list[Any]] = {"index": []}
    for row in rows:
        for name, value in row.items():
            found.setdefault(name, []).append(value)
    return found


def motion_row(outcome: Outcome, motion: Trajectory | None, told: Timeline) -> dict[str, Any]:
    """Return motion and events of a case, apart from its speeds.

    Args:
        outcome: the outcome of the case.
        motion: its motion; None where it is lost, which gives 0 rows.
        told: its timeline.
    """
    return {
        "index": outcome.index,
        "starts": [round(x_m, 3) for x_m, _ in outcome.case.starts()],
        "nearest": VEHICLES.index(outcome.measures.nearest),
        "rows": 0 if motion is None else len(motion.whole),
        "end": outcome.measures.end,
        "t_end_s": outcome.measures.t_end_s,
        "events": [astuple(event) for event in told.events],
        "result": told.result,
    }


def _row(model: ReportModel, outcome: Outcome) -> dict[str, Any]:
    """Return a case by the names of `cases`."""
    index, measures = outcome.index, outcome.measures
    motion, told = model.motion.get(index), model.timelines[index]
    row: dict[str, Any] = {
        **motion_row(outcome, motion, told),
        "level": outcome.case.level,
        "conflict": None if motion is None else [*Conflict.of(motion, centre_lines(model.road))],
        "error": measures.error and shortened(measures.error, ERROR_CHARACTERS),
        "severity": measures.severity,
        "failed": outcome.failed,
        "margin": _rounded(outcome.margin, 3),
        "region": model.regions.get(index),
        "kind": told.kind,
        "undecided": index in model.summary.undecided_cases,
        "avoidance": model.avoidance.get(index),
    }
    for coordinate in model.coordinates:
        row[coordinate.field] = _rounded(coordinate.of(outcome.case), coordinate.digits + 2)
    for name, measure in recorded_measures(outcome.case.scenario).items():
        if measure.column:
            row[name] = _rounded(measures.value(name), 4)
    if model.repeated:
        row["runs"] = None
        if runs := model.repeated.get(index):
            low, high = clopper_pearson(runs.failures, runs.runs, CONFIDENCE)
            each = [(run.index, run.failed) for run in runs.outcomes]
            row["runs"] = {"each": each, "low": low, "high": high}
    return row


def _explanations(model: ReportModel) -> dict[int, dict[str, Any]]:
    """Return the changes that make failures pass, by index: in words, and as axes with titles."""
    found: dict[int, dict[str, Any]] = {}
    for known in model.explanations:
        case = model.run.outcome(known.index).case
        of_case = found.setdefault(known.index, {"words": [], "axes": []})
        # An explanation of another VUT in the same case.
        prefix = "" if known.vut is None else f"with {printable(known.vut)}: "
        for words in changes(known, case):
            of_case["words"].append(prefix + words)
        for axis, name, unit in axes_of(known, case):
            of_case["axes"].append(to_plain(axis) | {"name": prefix + name, "unit": unit})
    return found


def _search(model: ReportModel) -> dict[str, Any]:
    """Return the coverage of each level after numbers of cases."""
    outcomes = len(model.run.outcomes)
    steps = [outcomes * step // 20 for step in range(21)]
    levels = []
    failed = sorted(model.worst, key=lambda outcome: outcome.index)
    for level in model.levels:
        at_level = [outcome for outcome in failed if outcome.case.level == level]
        points = to_unit((one.case for one in at_level), level, model.run.scenario)
        growth = np.concatenate([[0.0], fmc_growth(points)])
        found = np.searchsorted([one.index for one in at_level], steps)
        levels.append({"level": level, "fmc": growth[found].round(5).tolist()})
    return {"cases": steps, "levels": levels}


def packed(motions: Iterable[Trajectory]) -> str:
    """Return the speeds of all cars at every step in base64.

    Args:
        motions: trajectories, in the order of the cases.

    Returns:
        Speeds as 16-bit little-endian numbers, row by row, in units of `SPEED_UNIT_MPS`.
    """
    content = b""
    for motion in motions:
        speeds = np.rint(np.clip(motion.whole[:, :, 1] / SPEED_UNIT_MPS, 0, 65535))
        content += speeds.astype("<u2").tobytes()
    return base64.b64encode(content).decode()


def _map(model: ReportModel, level: int) -> dict[str, Any]:
    """Return the map of a level: the counts of its further cases, and the failure probability.

    A level with two coordinates has one map. With three, a slider moves through the third. With
    more, a map shows the cases in a pair of coordinates, without a failure probability.
    """
    dims, surface = len(model.axes[level]), model.surfaces[level]
    probability = _probability(surface, GRID[dims]) if surface and dims in GRID else None
    others = [
        o for o in model.run.cases if o.case.level == level and o.index not in model.timelines
    ]
    points = to_unit((outcome.case for outcome in others), level, model.run.scenario)
    failed = np.array([outcome.failed for outcome in others], dtype=bool)
    pairs = [(0, 1)] if dims <= 3 else list(combinations(range(dims), 2))
    counts = []
    for axes in pairs if others else ():
        places = points[:, axes]
        counts.append([_counts(places[~failed]), _counts(places[failed])])
    return {
        "dims": dims,
        "pairs": pairs,
        "radius": radius_for(dims),
        "probability": probability,
        "counts": counts,
    }


def _counts(places: FloatArray) -> list[int]:
    """Return the number of places, (n, 2), in each cell of a map, row by row."""
    nx, ny = COUNT_GRID
    x, y = places.T
    cells, _, _ = np.histogram2d(y, x, bins=(ny, nx), range=((0, 1), (0, 1)))
    counts: list[int] = cells.astype(int).ravel().tolist()
    return counts


def _probability(surface: Surface, grid: Grid) -> dict[str, Any]:
    """Return the failure probability at the nodes of a map in 255ths."""
    nx, ny, through = grid
    values = np.rint(255.0 * surface(nodes(grid))).astype(np.uint8)
    data = base64.b64encode(values.tobytes()).decode()
    return {"nx": nx, "ny": ny, "np": through, "data": data}


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)
