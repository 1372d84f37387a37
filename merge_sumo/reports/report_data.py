"""What the report draws from: maps, motion and charts as plain JSON for the script of the page."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from merge_sumo.analysis.coordinates import Coordinate
from merge_sumo.analysis.diagnosis import Diagnosis, Kind
from merge_sumo.analysis.predictions import prediction_error_m
from merge_sumo.analysis.verdict import shortened
from merge_sumo.reports.player import motion_row, packed, player_data
from merge_sumo.reports.report_maps import maps_of
from merge_sumo.reports.report_model import ERROR_CHARACTERS, ReportModel
from merge_sumo.studies.explanation import in_words, name_and_unit
from merge_sumo.system.records import to_plain
from merge_sumo.values.case import FloatArray, to_unit
from merge_sumo.values.chance import RunsOfCase
from merge_sumo.values.fmc import fmc
from merge_sumo.values.measures import Measure
from merge_sumo.values.scenario import (
    ALL_LEVELS,
    Scenario,
    level_name,
)
from merge_sumo.values.score import measures_in
from merge_sumo.values.severity import Severity
from merge_sumo.values.signals import to_record

SVO_NEAR_RAD: Final = 0.1
NEAR_SHARE: Final = 1.0 / 16.0
MOST_STEPS: Final = 20
"""Batches, or groups of batches, in the charts of the search."""
MOST_BALLS: Final = 20_000
"""Balls that are counted for a level's curve of coverage: of more failures it has fewer points."""


UNKNOWN: Final = Diagnosis(None, None, False, False, None)
"""Of a case whose motion is lost."""


def page_data(facts: ReportModel) -> dict[str, Any]:
    """Return what the script draws from: plain JSON."""
    speeds, offsets = packed(facts.motion)
    scenario = facts.run.scenario
    return {
        "goal": scenario.goal,
        "level_names": {level: level_name(level) for level in ALL_LEVELS},
        "coordinates": [_coordinate(c) for c in facts.coordinates],
        "severities": [severity.value for severity in Severity],
        "kinds": [kind.value for kind in Kind],
        "measures": _headings(facts),
        "cases": _columns(facts, offsets),
        "boxes": _boxes(facts),
        "errors": {
            o.index: shortened(o.measures.error, ERROR_CHARACTERS)
            for o in facts.shown
            if o.measures.error
        },
        "signals": {i: to_record(t.signals) for i, t in facts.motion.items() if t.signals},
        "maps": _maps(facts),
        "search": _search(facts),
        "replay": f"merge-sumo replay {_quoted(facts.run.folder)}",
        "why": _explanations(facts),
        "explain": f"merge-sumo explain {_quoted(facts.run.folder)}",
        "report": f"merge-sumo report {_quoted(facts.run.folder)}",
        **player_data(scenario, facts.road, speeds),
    }


def listed_measures(scenario: Scenario) -> list[Measure]:
    """Return the measures that the table of all cases of a scenario has a column for."""
    return [measure for measure in measures_in(scenario) if measure.column]


def _headings(facts: ReportModel) -> list[dict[str, Any]]:
    """Return the columns of the table: measures of which a case has a value."""
    scenario = facts.run.scenario
    return [
        {"name": m.name, "title": m.title_in(scenario), "digits": m.digits}
        for m in listed_measures(scenario)
        if any(o.measures.value(m.name) is not None for o in facts.shown)
    ]


def _boxes(facts: ReportModel) -> list[dict[str, Any]]:
    """Return level and cases of the regions in words, of the cases that are shown."""
    shown = {o.index for o in facts.shown}
    return [
        {"level": box.level, "cases": [index for index in box.indices if index in shown]}
        for box in facts.boxes
    ]


def _columns(facts: ReportModel, offsets: Mapping[int, int]) -> dict[str, list[Any]]:
    kinds, severities = list(Kind), list(Severity)
    listed = listed_measures(facts.run.scenario)
    columns: dict[str, list[Any]] = {}
    for o in facts.shown:
        found = facts.diagnoses.get(o.index, UNKNOWN)
        row = {
            "index": o.index,
            "level": o.case.level,
            **{c.field: _rounded(c.of(o.case), c.digits + 2) for c in facts.coordinates},
            **motion_row(o, facts.motion.get(o.index), offsets.get(o.index, 0)),
            "severity": None
            if o.measures.severity is None
            else severities.index(Severity(o.measures.severity)),
            "failed": int(o.failed),
            **{m.name: _rounded(o.measures.value(m.name), 4) for m in listed},
            "margin": _rounded(o.margin, 3),
            "region": facts.regions.get(o.index),
            **_avoidance(facts, o.index),
            "way_out": _rounded(o.measures.last_avoidable_s, 1),
            "vut_brakes": found.vut_brakes_s,
            "pov_brakes": found.pov_brakes_s,
            "vut_accelerates": int(found.vut_accelerates),
            "pov_accelerates": int(found.pov_accelerates),
            "kind": kinds.index(facts.kinds[o.index]) if o.index in facts.kinds else None,
        }
        if facts.repeated:
            row["runs"] = _runs(facts.repeated.get(o.index))
        for name, value in row.items():
            columns.setdefault(name, []).append(value)
    return columns or {"index": []}


def _runs(of: RunsOfCase | None) -> dict[str, Any] | None:
    """Return how many runs of a case failed, with the interval; None where it ran once."""
    if of is None:
        return None
    low, high = of.interval()
    return {
        "failed": of.failures,
        "number": of.runs,
        "low": round(low, 3),
        "high": round(high, 3),
        "each": [[run.index, int(run.failed)] for run in of.outcomes],
    }


def _avoidance(facts: ReportModel, index: int) -> dict[str, Any]:
    """Return who would have avoided a case, where that is known."""
    if not facts.avoidance:
        return {}
    found = facts.avoidance.get(index)
    return {
        "avoided_by": None if found is None else list(found.avoided_by),
        "latest_takeover": None if found is None else found.latest_takeover_s,
        "pov_careful": None if found is None else int(found.pov_careful),
    }


def _explanations(facts: ReportModel) -> dict[int, dict[str, Any]]:
    """Return by index the words on a failure, and its axes with a title each."""
    found = {}
    for o in facts.shown:
        known = facts.explanations.get(o.index)
        if known is not None:
            titles = [
                *(name_and_unit(o.case, axis.name) for axis in known.start),
                *((f"vut: {axis.name}", "") for axis in known.parameters),
            ]
            found[o.index] = {
                "words": list(in_words(known, o, facts.avoidance.get(o.index))),
                "axes": [
                    {**to_plain(axis), "name": name, "unit": unit}
                    for (name, unit), axis in zip(
                        titles, (*known.start, *known.parameters), strict=True
                    )
                ],
            }
    return found


def _coordinate(c: Coordinate) -> dict[str, Any]:
    low, high = c.dimension.low, c.dimension.high
    return {
        "field": c.field,
        "name": c.name,
        "unit": c.unit,
        "digits": c.digits,
        "low": round(low, 4),
        "high": round(high, 4),
        # Cases are shown in full this near to where the reader is in a third coordinate.
        "near": SVO_NEAR_RAD if c.unit == "rad" else NEAR_SHARE * (high - low),
    }


def _maps(facts: ReportModel) -> dict[int, dict[str, Any]]:
    shown = {o.index for o in facts.shown}
    others = [o for o in facts.cases if o.index not in shown]
    return {
        level: maps_of(
            facts.run.scenario,
            level,
            [o for o in others if o.case.level == level],
            facts.surfaces[level],
            facts.truths[level],
        )
        for level in facts.levels
    }


def _search(facts: ReportModel) -> dict[str, Any]:
    """Return coverage, and error of predictions, of each level after groups of batches."""
    batches = sorted({o.batch for o in facts.cases})
    width = -(-len(batches) // MOST_STEPS) or 1
    groups = batches[::width]
    levels = []
    for level in facts.levels:
        at = [o for o in facts.cases if o.case.level == level]
        group = np.array([o.batch // width for o in at], dtype=np.int64)
        failed = np.array([o.failed for o in at], dtype=bool)
        points = to_unit((o.case for o in at), level, facts.run.scenario)
        covered: list[float | None] = []
        stride = -(-len(groups) * int(failed.sum()) // MOST_BALLS) or 1
        last = len(groups) - 1
        for number in range(len(groups)):
            so_far = points[failed & (group <= number)]
            wanted = (last - number) % stride == 0
            covered.append(round(fmc(so_far), 5) if wanted else None)
        off = np.array([prediction_error_m(o) for o in at], dtype=np.float64)
        levels.append(
            {
                "level": level,
                "fmc": covered,
                "off": [_median(off[group == number]) for number in range(len(groups))],
            }
        )
    return {"batch": groups, "width": width, "levels": levels}


def _median(values: FloatArray) -> float | None:
    """Return the median of those that are numbers, if there are any."""
    known = values[~np.isnan(values)]
    return round(float(np.median(known)), 3) if len(known) else None


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)
