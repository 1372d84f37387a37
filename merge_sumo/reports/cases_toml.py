"""Cases files: which cases of a campaign go into one, and how it is written."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import fields, replace
from itertools import product
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from merge_sumo.analysis.cases_file import TOLERANCE, CasesFile, Head, policies_of, verdict_of
from merge_sumo.analysis.comparison import GOT_WORSE, Comparison, passes, short
from merge_sumo.campaigns.run import Run, spread_failures
from merge_sumo.errors import notice
from merge_sumo.files import check_new, make_folder, write_new
from merge_sumo.metrics.cause import cause
from merge_sumo.metrics.criterion import condition_of
from merge_sumo.metrics.fmc import radius_for
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.summary import judge, one_per_case
from merge_sumo.printable import printable
from merge_sumo.records import check_toml_size, toml_value
from merge_sumo.road.scenario_file import SUFFIX
from merge_sumo.scenario.case import to_unit

MOST = 40
"""Cases of a file where the user names none."""
ABOUT = """\
# `merge-sumo rerun THIS-FILE --vut SPEC` exits with 1 where a case passes no more, ends in a new
# error, or passes with a new contact or a margin, in units of the criterion's thresholds, that is
# less by more than the tolerance. A known failure may have in its line: accepted = "the reason"
"""


def with_file(compared: Comparison, file: CasesFile, path: Path) -> Comparison:
    """Return a comparison of a cases file with its text of now, and notes on what changed.

    Args:
        compared: the comparison.
        file: the cases file.
        path: where the file of now would be.
    """
    (step,), (_, now) = compared.steps, compared.versions
    outcomes = {one.index: one for one in (*file.outcomes, *now.outcomes)}
    before = cases_toml(file, file.outcomes, path, file.settings.vut)
    text = cases_toml(file, outcomes.values(), path, now.vut)
    notes = list[str]()
    for old, new in zip(before.splitlines(), text.splitlines(), strict=True):
        notes += [] if old == new else [f"- {old.strip()}", f"+ {new.strip()}"]
    for index, one in ((one.b.index, one) for one in step.cases):
        if one.change in GOT_WORSE:
            why = cause(one.b, now.motions([index]).get(index))
            notes.append(f"case {index}, {one.change}: {why}")
        elif reason := file.accepted.get(index):
            so = "passes now: take the mark away" if passes(one.b) else "fails, not counted"
            notes.append(f"case {index} is accepted ({reason}) and {so}")
    if not any(one.is_tested for one in now.outcomes):
        notes.append(judge(now.outcomes).nothing_tested)
    notes += compared.notes
    return replace(compared, text=text, notes=tuple(map(printable, notes)))


def watching(run: Run) -> list[Outcome]:
    """Return at most 40 outcomes of a campaign: of more, those that watch a controller.

    A quarter are the worst failures of regions. The others pass, if as many do, the levels in turn:
    by turns that of least margin and of least clearance that lies apart, and the farthest.
    """
    if len(run.outcomes) <= MOST:
        return run.outcomes
    cases, scenario = one_per_case(run.outcomes, run.tolerated), run.scenario
    failing = spread_failures(cases)
    chosen = failing[: MOST // 4]
    for turn, level in product(range(MOST), run.levels):
        left = [o for o in cases if o.case.level == level and passes(o) and o not in chosen]
        if left and len(chosen) < MOST:
            known = to_unit((o.case for o in chosen if o.case.level == level), level, scenario)
            points = to_unit((one.case for one in left), level, scenario)
            away = cKDTree(known).query(points)[0]
            near = [(one.margin, one.measures.clearance_m, 0.0)[turn % 3] for one in left]
            apart = away > radius_for(points.shape[1]) if turn % 3 < 2 else away
            # The last key decides first; no clearance is the largest.
            chosen.append(left[np.lexsort((np.array(near, dtype=float), -1.0 * apart))[0]])
    return [*chosen, *failing[MOST // 4 :]][:MOST]


def new_file_in(target: Path, name: str) -> Path:
    """Return the path of a new file: `target` if it has an ending, else `name` in that folder.

    Raises `UserError` where no such file can be made, or the ending is not that of `name`.
    """
    ending = Path(name).suffix
    if target.suffix == ending or (target.suffix and not target.is_dir()):
        check_new(target, endings=(ending,))
        return target
    make_folder(target, exist_ok=True)
    return target / name


def write_cases(run: Run, indices: Sequence[int], target: Path) -> Path:
    """Write a cases file.

    Args:
        run: the campaign.
        indices: the cases; without any, at most 40 that watch a controller.
        target: the new file, or a folder for it.

    Returns:
        The path of the file.

    Raises:
        UserError: if there is no such case, or the file cannot be written.
    """
    outcomes = [run.outcome(index) for index in dict.fromkeys(indices)] or watching(run)
    path = new_file_in(target, f"cases{SUFFIX}")
    content = cases_toml(run, outcomes, path, run.settings.vut).encode()
    check_toml_size(content, path)
    write_new(path, content)
    if not indices and len(outcomes) < len(run.outcomes):
        notice(
            f"note: the file has {len(outcomes)} of {len(run.outcomes):,} cases, chosen to "
            "watch a controller; name others by their index"
        )
    return path


def cases_toml(run: Run, outcomes: Iterable[Outcome], path: Path, vut: str) -> str:
    """Return a cases file for a path; `vut` is who drove.

    Args:
        run: the campaign.
        outcomes: its cases to write.
        path: path of the file.
        vut: the VUT that drove.
    """
    scenario = run.scenario
    ordered = sorted(outcomes, key=lambda one: (one.case.level, one.index))
    usual, place = {one.name: one.default for one in fields(scenario)}, scenario.to_record()
    if len(Path(scenario.net or "").parts) > 1:
        place["net"] = f"./{Path(os.path.relpath(str(scenario.net), path.parent)).as_posix()}"
    place = {name: one for name, one in place.items() if name == "name" or one != usual.get(name)}
    head = {name: run.record.get(name) for name in Head.__struct_fields__}
    head |= {
        "vut": vut,
        "policies_sha256": policies_of(run, ordered),
        "scenario": place,
        "cases": None,
    }
    head["tolerance"] = run.tolerance if isinstance(run, CasesFile) else TOLERANCE
    lines = [f"{name} = {toml_value(one)}" for name, one in head.items() if one is not None]
    lines += ["cases = [", *(f"  {_line(run, outcome)}," for outcome in ordered), "]"]
    return ABOUT + "\n".join(lines) + "\n"


def _line(run: Run, outcome: Outcome) -> str:
    """Return the line of a case: verdict and what decided it, its place, and what is accepted."""
    accepted = run.accepted if isinstance(run, CasesFile) and not passes(outcome) else {}
    record = outcome.to_record() | {"margin": outcome.margin, "verdict": verdict_of(outcome)}
    record |= {"accepted": accepted.get(outcome.index)}
    record |= {"end": None} if outcome.measures.end.is_tested else {}
    deciding = () if run.criterion.require else sorted(condition_of(run.criterion.words).names)
    told = ("index", "level", "verdict", "end", "severity", "margin", *deciding, "error")
    place = (of.field for of in run.scenario.dimensions(outcome.case.level))
    line = {name: short(record.get(name)) for name in told}
    line |= {name: record.get(name) for name in (*place, "draw", "accepted")}
    return toml_value({name: value for name, value in line.items() if value is not None})
