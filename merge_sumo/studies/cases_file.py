"""Cases in one small file to commit: it is all that runs them elsewhere, and names no code."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import fields, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from msgspec import Meta
from scipy.spatial import cKDTree

from merge_sumo.campaigns.run import Run, spread_failures
from merge_sumo.coverage.fmc import radius_for
from merge_sumo.engine.povs import POLICIES
from merge_sumo.errors import UserError
from merge_sumo.road.scenario_file import SUFFIX
from merge_sumo.scenario.case import to_unit
from merge_sumo.scenario.coordinates import outside_of_the_pool
from merge_sumo.scenario.kinds import scenario_of_record
from merge_sumo.scenario.trajectory import End
from merge_sumo.studies.comparison import GOT_WORSE, Change, ComparedCase, Comparison, passes, short
from merge_sumo.system.folders import check_ending, make_place, write_new
from merge_sumo.system.printable import printable
from merge_sumo.system.records import (
    Record,
    check_toml_size,
    convert,
    read_toml,
    to_json,
    toml_value,
)
from merge_sumo.verdict.campaign_verdict import judge
from merge_sumo.verdict.cause import cause
from merge_sumo.verdict.chance import one_per_case
from merge_sumo.verdict.criterion import PAPER_CRITERION, Criterion, condition_of
from merge_sumo.verdict.score import Measures, Outcome, record_fields
from merge_sumo.verdict.severity import Severity

MOST: Final = 40
"""Cases of a file for which nobody names any."""
TOLERANCE: Final = 0.01
ABOUT: Final = """\
# `merge-sumo rerun THIS-FILE --vut SPEC` exits with 1 where a case passes no more, ends in a new
# error, or passes with a new contact or a margin, in units of the criterion's thresholds, that is
# less by more than the tolerance. A known failure may have in its line: accepted = "the reason"
"""


class Head(Record, frozen=True):
    """What a cases file holds, by the names of `campaign.json`, with a record a case."""

    vut: str
    scenario: dict[str, Any]
    cases: list[dict[str, Any]]
    pov: str | None = None
    policies: str | None = None
    fail_when: str = PAPER_CRITERION.fail_when
    require: str | None = None
    net_sha256: str | None = None
    policies_sha256: dict[str, str] | None = None
    pov_files: dict[str, str] | None = None
    tolerance: Annotated[float, Meta(ge=0.0, le=1000.0)] = TOLERANCE


class CasesFile(Run):
    """A cases file, as a campaign of which only what decided its cases is known."""

    def __init__(self, path: Path) -> None:
        _, record = read_toml(path, "cases file")
        line: dict[str, Any] = {}
        try:
            head = convert(record, Head)
            scenario = scenario_of_record(head.scenario)
            if "/" in (scenario.net or ""):
                scenario = replace(scenario, net=str((path.parent / str(scenario.net)).resolve()))
            self.criterion = Criterion(head.fail_when, head.require)
            self.criterion.check(scenario)
            del record["cases"]
            self._take(path, {**record, "scenario": scenario.to_record()}, path)
            self.tolerance, self.torn = head.tolerance, False
            self._by_index = dict[int, Outcome]()
            self.accepted = dict[int, str]()
            for line in head.cases:
                self._add(line)
            self.outcomes = list(self._by_index.values())
        except UserError as error:
            at = f"case {line.get('index')!r:.40}: " if line else ""
            raise UserError(f"the cases file {path}: {at}{error}") from error
        self.record["levels"] = self.levels

    def _add(self, line: dict[str, Any]) -> None:
        """Add the case of a line; raise `UserError` where it is none."""
        if not all(math.isfinite(one) for one in line.values() if isinstance(one, float)):
            raise UserError("it has a number that is not finite")
        usual = Measures(end=End(self.scenario.ends_as), t_end_s=0.0)
        names = (name for of in record_fields(self.scenario)[:2] for name in of)
        unsaid = {name: getattr(usual, name, None) for name in names} | {"batch": 0}
        unsaid["v_vut0_mps"] = self.scenario.bounds("v_vut0_mps")[0]
        verdict, accepted = line.pop("verdict", None), line.pop("accepted", None)
        outcome = Outcome.from_json(to_json(unsaid | line), self.scenario)
        judged = verdict_of(outcome)
        if verdict != judged or (outcome.margin is None) != (judged == "error"):
            raise UserError(f"verdict is {verdict!r:.60}, but by margin and end it is {judged}")
        if accepted is not None and not (isinstance(accepted, str) and accepted.strip()):
            raise UserError(f"accepted is {accepted!r:.60}: it must be a reason")
        if outcome.index in self._by_index:
            raise UserError("its index is there twice")
        if sentences := outside_of_the_pool(outcome.case):
            raise UserError(sentences[0].removeprefix("note: "))
        self._by_index[outcome.index] = outcome
        self.accepted |= {outcome.index: accepted} if accepted else {}

    def outcome(self, index: int) -> Outcome:
        """Return the outcome of a case; `UserError` when the file has no such case."""
        if index not in self._by_index:
            raise UserError(f"{self.folder} has no case {index}")
        return self._by_index[index]

    def compared(self, compared: Comparison, path: Path) -> Comparison:
        """Return a comparison of its cases with its text, which is that for a path, and notes."""
        (step,), (_, now) = compared.steps, compared.versions
        outcomes = {one.index: one for one in (*self.outcomes, *now.outcomes)}
        before = cases_toml(self, self.outcomes, path, self.settings.vut)
        text = cases_toml(self, outcomes.values(), path, now.vut)
        notes = list[str]()
        for old, new in zip(before.splitlines(), text.splitlines(), strict=True):
            notes += [] if old == new else [f"- {old.strip()}", f"+ {new.strip()}"]
        for index, one in ((one.b.index, one) for one in step.cases):
            if one.change in GOT_WORSE:
                why = cause(one.b, now.motions([index]).get(index))
                notes.append(f"case {index}, {one.change}: {why}")
            elif reason := self.accepted.get(index):
                so = "passes now: take the mark away" if passes(one.b) else "fails, not counted"
                notes.append(f"case {index} is accepted ({reason}) and {so}")
        if not any(one.is_tested for one in now.outcomes):
            notes.append(judge(now.outcomes).nothing_tested)
        notes += compared.notes
        return replace(compared, text=text, notes=tuple(map(printable, notes)))

    def change_of(self, one: ComparedCase) -> Change:
        """Return what the file calls a change; it excuses neither a new error nor a new contact."""
        a, b = one.a.measures, one.b.measures
        if b.error is not None and a.error is None:
            return Change.BROKE
        if passes(one.a) and passes(one.b):
            less = short(one.a.margin) - short(one.b.margin) > self.tolerance
            touches = b.severity == Severity.CONTACT != a.severity
            return Change.WORSE if less or touches else Change.BOTH
        is_known = one.a.index in self.accepted and not b.end.is_error
        return Change.ACCEPTED if is_known and not passes(one.b) else one.change


def verdict_of(outcome: Outcome) -> str:
    """Return the verdict on a case in a word."""
    if outcome.is_tested:
        return "fail" if outcome.failed else "pass"
    return "error" if outcome.measures.end.is_error else "timeout"


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


def write_cases(run: Run, indices: Sequence[int], target: Path) -> Path:
    """Write cases, or those that watch, as a new file at a path or in a folder; return its path."""
    if target.suffix and not target.is_dir():
        check_ending(target, (SUFFIX,))
    outcomes = [run.outcome(index) for index in dict.fromkeys(indices)] or watching(run)
    path = target if target.suffix == SUFFIX else target / f"cases{SUFFIX}"
    content = cases_toml(run, outcomes, path, run.settings.vut).encode()
    check_toml_size(content, path)
    if path != target:
        make_place(target)
    write_new(path, content)
    return path


def cases_toml(run: Run, outcomes: Iterable[Outcome], path: Path, vut: str) -> str:
    """Return a cases file for a path; `vut` is who drove."""
    scenario = run.scenario
    ordered = sorted(outcomes, key=lambda one: (one.case.level, one.index))
    usual, place = {one.name: one.default for one in fields(scenario)}, scenario.to_record()
    if len(Path(scenario.net or "").parts) > 1:
        place["net"] = f"./{Path(os.path.relpath(str(scenario.net), path.parent)).as_posix()}"
    place = {name: one for name, one in place.items() if name == "name" or one != usual.get(name)}
    head = {name: run.record.get(name) for name in Head.__struct_fields__}
    learned = {POLICIES.get(one.case.level) for one in ordered}
    hashes = {of: one for of, one in (head["policies_sha256"] or {}).items() if of in learned}
    head |= {"vut": vut, "policies_sha256": hashes or None, "scenario": place, "cases": None}
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
