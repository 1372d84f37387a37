"""Cases files: the choice of cases, and their text."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import fields, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from merge_sumo.analysis.cases_file import (
    CasesFile,
    Head,
    policies_of,
    short,
    verdict_of,
)
from merge_sumo.analysis.comparison import Change, Comparison
from merge_sumo.campaigns.recorded import RecordedCampaign, spread_failures
from merge_sumo.errors import notice
from merge_sumo.files import check_new, make_folder, write_new
from merge_sumo.metrics.criterion import condition_of
from merge_sumo.metrics.fmc import radius_for
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.summary import one_per_case
from merge_sumo.metrics.timeline import timeline
from merge_sumo.printable import printable
from merge_sumo.records import toml_value
from merge_sumo.reports.text import change_in_words
from merge_sumo.road.loader import centre_lines, road_or_shipped
from merge_sumo.road.scenario_file import SUFFIX
from merge_sumo.scenario.case import to_unit
from merge_sumo.scenario.scenario import Scenario
from merge_sumo.scenario.trajectory import End

MOST = 40
"""Maximum number of cases of a file where the user names none."""
ABOUT = """\
# `merge-sumo rerun THIS-FILE --vut SPEC` exits with 1 if a case no longer passes, ends in a new
# error, or passes with a new contact. With a line `tolerance = 0.2` before `cases`, it also exits
# with 1 if a margin drops by more than 0.2. To accept a failure, add to its line: accepted = "WHY"
"""


def with_file(compared: Comparison, file: CasesFile, path: Path) -> Comparison:
    """Return the comparison of a cases file with its new text, and notes on the changes.

    Args:
        compared: the comparison.
        file: the cases file.
        path: path of a file with the new text, to which its net is relative.
    """
    (version_change,), (_, now) = compared.version_changes, compared.versions
    outcomes = {one.index: one for one in (*file.outcomes, *now.outcomes)}
    before = cases_toml(file, file.outcomes, path, file.settings.vut)
    text = cases_toml(file, outcomes.values(), path, now.vut)
    notes: list[str] = []
    road_lines = centre_lines(road_or_shipped(file.scenario))
    for one in version_change.cases:
        index = one.later.index
        reason = file.accepted.get(index)
        if one.change.group == "worse":
            told = timeline(one.later, now.motion(index), road_lines)
            notes.append(f"case {index}, {one.change}: {told.in_a_line}")
        elif one.change is Change.WEAKER:
            notes.append(f"case {index}, {one.change}: {change_in_words(one)}")
        elif reason:
            result = "passes now: remove the mark" if one.later.passes else "fails, not counted"
            notes.append(f"case {index} is accepted ({reason}) and {result}")
    for old, new in zip(before.splitlines(), text.splitlines(), strict=True):
        if old != new:
            notes += [f"- {old.strip()}", f"+ {new.strip()}"]
    if not any(one.is_tested for one in now.outcomes):
        notes.append(now.summary.nothing_tested)
    notes += compared.notes
    return replace(compared, text=text, notes=tuple(map(printable, notes)))


def watching(run: RecordedCampaign) -> list[Outcome]:
    """Return at most 40 outcomes of a campaign that detect changes of a controller.

    A quarter are the worst failures of regions. The others pass, if enough cases pass. They are
    chosen from the levels in turn: first the case of least margin that is at least a radius from
    the chosen cases, then the case that is farthest from them.

    Args:
        run: the campaign; all of its outcomes if there are not more.
    """
    if len(run.outcomes) <= MOST:
        return run.outcomes
    cases, scenario = one_per_case(run.outcomes, run.tolerated), run.scenario
    failing = spread_failures(cases)
    chosen = failing[: MOST // 4]
    for turn, level in product(range(MOST), run.levels):
        left = [o for o in cases if o.case.level == level and o.passes and o not in chosen]
        if not left or len(chosen) == MOST:
            continue
        known = to_unit((o.case for o in chosen if o.case.level == level), level, scenario)
        points = to_unit((one.case for one in left), level, scenario)
        away = cKDTree(known).query(points)[0]
        if turn % 2 == 1:
            place = away.argmax()
        else:
            is_near = away <= radius_for(points.shape[1])
            margins = np.array([one.margin for one in left], dtype=float)
            # The last key decides first.
            place = np.lexsort((margins, is_near))[0]
        chosen.append(left[place])
    return [*chosen, *failing[MOST // 4 :]][:MOST]


def new_file_in(target: Path, name: str) -> Path:
    """Return the path of a new file: `target` if it has an ending, else `name` in that folder.

    Args:
        target: path of the new file, or a folder for it, which is created.
        name: name of a file in a folder.

    Raises:
        UserError: no such file can be created, or `target` has another ending than `name`.
    """
    ending = Path(name).suffix
    if target.suffix == ending or (target.suffix and not target.is_dir()):
        check_new(target, endings=(ending,))
        return target
    make_folder(target, exist_ok=True)
    return target / name


def write_cases(run: RecordedCampaign, indices: Sequence[int], target: Path) -> Path:
    """Write a cases file.

    Args:
        run: the campaign.
        indices: the cases; without any, the cases of `watching`.
        target: the new file, or a folder for it.

    Returns:
        The path of the file.

    Raises:
        UserError: a case does not exist, or the file cannot be written.
    """
    outcomes = [run.outcome(index) for index in dict.fromkeys(indices)] or watching(run)
    path = new_file_in(target, f"cases{SUFFIX}")
    write_new(path, cases_toml(run, outcomes, path, run.settings.vut).encode())
    if not indices and len(outcomes) < len(run.outcomes):
        notice(
            f"the file has {len(outcomes)} of {len(run.outcomes):,} cases, chosen to detect "
            "changes of a controller; name other cases by their index"
        )
    return path


def cases_toml(run: RecordedCampaign, outcomes: Iterable[Outcome], path: Path, vut: str) -> str:
    """Return the text of a cases file.

    Args:
        run: the campaign.
        outcomes: its cases to write.
        path: path of the file.
        vut: the VUT that drove.
    """
    ordered = sorted(outcomes, key=lambda one: (one.case.level, one.index))
    changed = {
        "vut": vut,
        "scenario": _scenario(run.scenario, path),
        "policies_sha256": policies_of(run, ordered),
        "tolerance": run.tolerance if isinstance(run, CasesFile) else None,
    }
    lines = []
    for name in Head.__struct_fields__:
        value = changed.get(name, run.record.get(name))
        if value is not None and name != "cases":
            lines.append(f"{name} = {toml_value(value)}")
    lines.append("cases = [")
    for outcome in ordered:
        lines.append(f"  {_line(run, outcome)},")
    return ABOUT + "\n".join([*lines, "]"]) + "\n"


def _scenario(scenario: Scenario, path: Path) -> dict[str, Any]:
    """Return the name of a scenario, and its values that differ from the defaults."""
    record = scenario.to_record()
    if len(Path(scenario.net or "").parts) > 1:
        record["net"] = f"./{Path(os.path.relpath(str(scenario.net), path.parent)).as_posix()}"
    for field in fields(scenario):
        if field.name != "name" and record.get(field.name) == field.default:
            record.pop(field.name, None)
    return record


def _line(run: RecordedCampaign, outcome: Outcome) -> str:
    """Return the line of a case: verdict, deciding measures, start, and reason of acceptance."""
    record = outcome.to_record() | {"margin": outcome.margin, "verdict": verdict_of(outcome)}
    if outcome.measures.end is End.MERGED:
        record["end"] = None
    if isinstance(run, CasesFile) and not outcome.passes:
        record["accepted"] = run.accepted.get(outcome.index)
    names = ["index", "level", "verdict", "end", "severity", "margin"]
    if not run.criterion.require:
        names += sorted(condition_of(run.criterion.condition).names)
    line = {name: short(record.get(name)) for name in (*names, "error")}
    places = [dimension.field for dimension in run.scenario.dimensions(outcome.case.level)]
    for name in (*places, "draw", "accepted"):
        line[name] = record.get(name)
    return toml_value({name: value for name, value in line.items() if value is not None})
