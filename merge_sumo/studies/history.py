"""The history of a VUT: several campaigns, oldest first, compared by regions of failures.

All of it is read from the records of the campaigns: no code of a folder is run, and no case again;
`versions.compare_runs` runs failures again and knows more.

Failures that are linked at the radius of FMC are one region, and what the other version did in it
is what its own cases there say, those within that radius of a failure of the region. A region of
the earlier version in which the later one tested cases and none failed counts as fixed; one of the
later version in which the earlier one tested cases and none failed counts as broken. The share of a
region's volume that these cases cover says how much that is worth.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from itertools import pairwise
from typing import Any, Final

import numpy as np
from scipy.spatial import cKDTree

from merge_sumo.analysis.coordinates import coordinates
from merge_sumo.analysis.diagnosis import Kind, diagnose
from merge_sumo.analysis.merging import MergeStatistics, merging_of
from merge_sumo.analysis.result import Result
from merge_sumo.analysis.summary import severities_of
from merge_sumo.analysis.verdict import Verdict, in_words, judge
from merge_sumo.campaigns.store import Run
from merge_sumo.errors import UserError
from merge_sumo.studies.counterfactuals import Avoidance, read_avoidance
from merge_sumo.studies.versions import check_comparable
from merge_sumo.values.case import Case, FloatArray, to_unit
from merge_sumo.values.fmc import fmc, radius_for, regions
from merge_sumo.values.scenario import level_name
from merge_sumo.values.score import Outcome

ROUNDING: Final = 1e-9
"""Share of the radius by which two points may be further apart and still count as near."""


@dataclass(frozen=True, slots=True)
class LevelOfVersion:
    """What was found of a version at one POV level.

    Attributes:
        verdict: on its cases.
        severities: cases by severity, those that occur.
        fmc: failure mode coverage in the level's unit cube; None where nothing was tested.
        regions: groups of failures that are linked at the radius of FMC; None as well.
        avoidance_known: failures of which it is recorded who would have avoided them.
        avoided: those of them that a careful driver in the VUT's place would have avoided.
        kinds: failures by kind, of those under the paper's rule whose motion is there.
    """

    verdict: Verdict
    severities: dict[str, int]
    fmc: float | None
    regions: int | None
    avoidance_known: int
    avoided: int
    kinds: dict[Kind, int]

    def to_record(self) -> dict[str, Any]:
        """Return it as JSON shows it."""
        own = {name: value for name, value in asdict(self).items() if name != "verdict"}
        names = "cases", "tested", "failures", "contacts", "errors", "timeouts"
        return {**{name: getattr(self.verdict, name) for name in names}, **own}


@dataclass(frozen=True, slots=True)
class Version:
    """A campaign as one version of a VUT.

    Attributes:
        folder: of the campaign.
        vut: name of the VUT.
        sampler: that chose the cases.
        verdict: on all of its cases.
        levels: by POV level.
        merging: merges from an acceleration lane by POV level, and in all at None; empty without a
            lane.
    """

    folder: str
    vut: str
    sampler: str
    verdict: Verdict
    levels: dict[int, LevelOfVersion]
    merging: dict[int | None, MergeStatistics]

    def to_record(self) -> dict[str, Any]:
        """Return it as JSON shows it."""
        verdict = self.verdict
        record = {"folder": self.folder, "vut": self.vut, "sampler": self.sampler}
        counts = {"cases": verdict.cases, "failures": verdict.failures, **verdict.to_record()}
        levels = {
            level_name(level): of_level.to_record() for level, of_level in self.levels.items()
        }
        merging = {
            "all" if level is None else level_name(level): asdict(found)
            for level, found in self.merging.items()
        }
        more = {"merging": merging} if merging else {}
        return {**record, **counts, "levels": levels, **more}


class RegionChange(StrEnum):
    """What became of a region of failures from one version to the next."""

    FIXED = "fixed"
    BROKE = "broke"
    STILL = "still failing"
    NOT_SEEN_AFTER = "not looked at after"
    NOT_SEEN_BEFORE = "not looked at before"


@dataclass(frozen=True, slots=True)
class Region:
    """A region of failures of one of two neighbours, and what the other one did in it.

    Attributes:
        of: number of the version that fails there, from 1.
        became: what became of it.
        failures: of that version, in the region.
        worst: index of the worst of them in its campaign.
        where: the box of these failures, in words.
        fmc: their volume.
        cases: cases in the region that the other version tested.
        failed: those of them that failed.
        looked_at: share of the volume that these cases cover.
    """

    of: int
    became: RegionChange
    failures: int
    worst: int
    where: str
    fmc: float
    cases: int
    failed: int
    looked_at: float


@dataclass(frozen=True, slots=True)
class Step:
    """What changed from a version to the next at one POV level.

    Attributes:
        before: number of the earlier version, from 1.
        after: number of the later one.
        level: POV level.
        regions: those of both versions: what broke comes first, then the largest.
        same: cases that both versions tested, to the last bit.
        same_fixed: those of them in which only the earlier version fails.
        same_broke: those in which only the later one fails.
    """

    before: int
    after: int
    level: int
    regions: tuple[Region, ...]
    same: int
    same_fixed: int
    same_broke: int

    def count(self, became: RegionChange) -> int:
        """Return the number of regions of which that became."""
        return sum(region.became is became for region in self.regions)

    def to_record(self) -> dict[str, Any]:
        """Return it as JSON shows it."""
        counts = {became.value: self.count(became) for became in RegionChange}
        return asdict(self) | {"level": level_name(self.level), "counts": counts}


@dataclass(frozen=True, slots=True, repr=False)
class History(Result):
    """Versions in the order in which they were named, and the steps between neighbours.

    At a level the neighbour of a version is the next one that has that level.

    Attributes:
        criterion: when a case fails, as a person writes it.
        scenario: name of the scenario.
        levels: POV levels of any version.
        versions: the versions.
        steps: by level, and in order.
        notes: sentences on what limits the comparison.
    """

    criterion: str
    scenario: str
    levels: tuple[int, ...]
    versions: tuple[Version, ...]
    steps: tuple[Step, ...]
    notes: tuple[str, ...]

    @property
    def headline(self) -> str:
        """What became of FMC from the first to the last version, in a sentence."""
        parts = []
        for level in self.levels:
            known = [
                (number, of_level.fmc)
                for number, version in enumerate(self.versions, start=1)
                if (of_level := version.levels.get(level)) and of_level.fmc is not None
            ]
            if len(known) > 1:
                (first, before), (last, after) = known[0], known[-1]
                parts.append(
                    f"at POV level {level_name(level)} from {before:.4f} (version {first}) to "
                    f"{after:.4f} (version {last})"
                )
        if not parts:
            return "No POV level was tested in two versions."
        return f"FMC went {in_words(parts)}."

    def lines(self) -> list[str]:
        """Return what the command `history` prints."""
        text = [self.headline]
        for number, version in enumerate(self.versions, start=1):
            text.append(f"{number}: {version.folder} ({version.vut}): {version.verdict.counts}")
            text += version.verdict.trouble_lines()
            text += [f"  {version.merging[None].sentence}"] if version.merging else []
        for step in self.steps:
            counts = [f"{n} {became}" for became in RegionChange if (n := step.count(became))]
            text.append(
                f"from {step.before} to {step.after} at POV level {level_name(step.level)}: "
                f"{'regions: ' + ', '.join(counts) if counts else 'no failures in either'}"
            )
        return [*text, *self.notes]

    def to_record(self) -> dict[str, Any]:
        """Return it as JSON shows it."""
        return {
            "criterion": self.criterion,
            "scenario": self.scenario,
            "versions": [version.to_record() for version in self.versions],
            "steps": [step.to_record() for step in self.steps],
            "notes": list(self.notes),
        }


def history_of(runs: Sequence[Run]) -> History:
    """Return the history of campaigns, the oldest first; `UserError` for fewer than two.

    So also where they differ in the scenario, the initial speed of the VUT, the criterion or, at a
    level, the POV: FMC of these is of different pools.
    """
    if len(runs) < 2:
        raise UserError("a history needs two campaigns or more: name the older one first")
    levels_by_run = [
        sorted({*run.levels, *(outcome.case.level for outcome in run.outcomes)}) for run in runs
    ]
    for run in runs[1:]:
        check_comparable(runs[0], run, ())
    levels = sorted(set().union(*levels_by_run))
    steps = []
    for level in levels:
        numbers = [number for number, present in enumerate(levels_by_run) if level in present]
        for before, after in pairwise(numbers):
            check_comparable(runs[before], runs[after], [level])
            steps.append(_step(runs, before, after, level))
    return History(
        criterion=runs[0].criterion.text,
        scenario=runs[0].scenario.name,
        levels=tuple(levels),
        versions=tuple(_version(*pair) for pair in zip(runs, levels_by_run, strict=True)),
        steps=tuple(steps),
        notes=tuple(_notes(runs, levels_by_run)),
    )


def _notes(runs: Sequence[Run], levels_by_run: Sequence[list[int]]) -> list[str]:
    """Return what limits the comparison, in sentences."""
    notes = []
    if len({str([r.settings.get(k) for k in ("sampler", "cases")]) for r in runs}) > 1:
        notes.append(
            "The campaigns differ in sampler or number of cases: FMC, failures and regions are "
            "what each of them found, and a longer search finds more."
        )
    if len({str(run.settings.get("net_sha256")) for run in runs}) > 1:
        notes.append("The campaigns were not all run on the same net.")
    if any(levels != levels_by_run[0] for levels in levels_by_run):
        notes.append(
            "Not every campaign has every POV level: at a level, a version is compared with the "
            "last one before it that has the level."
        )
    for number, run in enumerate(runs, start=1):
        wanted = run.settings.get("cases")
        if run.torn or (isinstance(wanted, int) and len(run.outcomes) < wanted):
            notes.append(f"Campaign {number} ended after {len(run.outcomes)} of {wanted} cases.")
    return notes


def _version(run: Run, levels: Sequence[int]) -> Version:
    known = read_avoidance(run)
    by_level: dict[int | None, list[Outcome]] = {
        level: [outcome for outcome in run.cases if outcome.case.level == level] for level in levels
    }
    cases = by_level | {None: run.cases}
    return Version(
        folder=str(run.folder),
        vut=run.vut,
        sampler=str(run.settings.get("sampler")),
        verdict=judge(run.cases),
        levels={level: _level(run, level, known) for level in levels},
        merging={level: found for level, ran in cases.items() if (found := merging_of(ran))},
    )


def _level(run: Run, level: int, known: dict[int, Avoidance]) -> LevelOfVersion:
    outcomes = [outcome for outcome in run.cases if outcome.case.level == level]
    failed = [outcome for outcome in outcomes if outcome.failed]
    points = to_unit((outcome.case for outcome in failed), level, run.scenario)
    motions = run.trajectories(outcome.index for outcome in failed)
    kinds = Counter(diagnose(m, run.outcome(index).measures).kind for index, m in motions.items())
    avoidances = [known[outcome.index] for outcome in failed if outcome.index in known]
    verdict = judge(outcomes)
    return LevelOfVersion(
        verdict=verdict,
        severities=severities_of(outcomes),
        fmc=fmc(points) if verdict.tested else None,
        regions=int(regions(points).max(initial=-1)) + 1 if verdict.tested else None,
        avoidance_known=len(avoidances),
        avoided=sum(one.by_careful for one in avoidances),
        kinds={kind: kinds[kind] for kind in Kind if kinds[kind]},
    )


ORDER: Final = (
    *(RegionChange.BROKE, RegionChange.FIXED, RegionChange.STILL),
    *(RegionChange.NOT_SEEN_BEFORE, RegionChange.NOT_SEEN_AFTER),
)
"""In which the regions of a step are listed."""


def _step(runs: Sequence[Run], before: int, after: int, level: int) -> Step:
    """Return what changed at a level between two of some campaigns, given by their places."""
    earlier, later = (_Tested(runs[place], level) for place in (before, after))
    fixed = _regions(before + 1, earlier, later, RegionChange.FIXED, RegionChange.NOT_SEEN_AFTER)
    broke = _regions(after + 1, later, earlier, RegionChange.BROKE, RegionChange.NOT_SEEN_BEFORE)
    # Where both fail the region is given once, as one of the earlier version.
    both = [*fixed, *(region for region in broke if not region.failed)]
    both.sort(key=lambda region: (ORDER.index(region.became), -region.fmc, region.worst))
    first, second = (
        {tuple(point): o.failed for point, o in zip(one.points.tolist(), one.outcomes, strict=True)}
        for one in (earlier, later)
    )
    same = [(first[point], second[point]) for point in first.keys() & second.keys()]
    return Step(
        before=before + 1,
        after=after + 1,
        level=level,
        regions=tuple(both),
        same=len(same),
        same_fixed=sum(a and not b for a, b in same),
        same_broke=sum(b and not a for a, b in same),
    )


class _Tested:
    """The cases of a version at a level that have a verdict, and their points, (n, d)."""

    def __init__(self, run: Run, level: int) -> None:
        self.outcomes = [o for o in run.cases if o.case.level == level and o.is_tested]
        self.failures = [outcome for outcome in self.outcomes if outcome.failed]
        self.points, self.failing = (
            to_unit((o.case for o in some), level, run.scenario)
            for some in (self.outcomes, self.failures)
        )
        self._tree = cKDTree(self.points) if self.outcomes else None

    def near(self, points: FloatArray, radius: float) -> list[int]:
        """Return the places of cases no further than a radius from one of some points, (m, d)."""
        if self._tree is None:
            return []
        return sorted(set().union(*self._tree.query_ball_point(points, radius * (1.0 + ROUNDING))))


def _regions(
    of: int, own: _Tested, other: _Tested, none_failed: RegionChange, not_seen: RegionChange
) -> list[Region]:
    """Return the regions of failures of version `of`, and what the other one's cases say of them.

    A region where the other one's cases do not fail became `none_failed`, without any `not_seen`.
    """
    radius, labels = radius_for(own.points.shape[1]), regions(own.failing)
    result = []
    for label in range(int(labels.max(initial=-1)) + 1):
        points = own.failing[labels == label]
        failures = [own.failures[place] for place in np.flatnonzero(labels == label)]
        inside, around = (other.near(points, radius * r) for r in (1.0, 2.0))
        failed = sum(other.outcomes[place].failed for place in inside)
        volume, seen = fmc(points), other.points[around]
        shared = volume + fmc(seen) - fmc(np.concatenate([points, seen]))
        result.append(
            Region(
                of=of,
                became=RegionChange.STILL if failed else none_failed if inside else not_seen,
                failures=len(failures),
                worst=min(failures, key=lambda o: (o.score, o.index)).index,
                where=_box_in_words([o.case for o in failures]),
                fmc=volume,
                cases=len(inside),
                failed=failed,
                looked_at=min(max(shared / volume, 0.0), 1.0),
            )
        )
    return result


def _box_in_words(cases: Sequence[Case]) -> str:
    """Return the smallest box around some cases in words."""
    parts = []
    for coordinate in coordinates(cases[0].scenario, (cases[0].level,)):
        ordered = sorted(cases, key=lambda case: coordinate.of(case) or 0.0)
        low, high = coordinate.text(ordered[0]), coordinate.text(ordered[-1])
        span = low if low == high else f"{low} to {high}"
        parts.append(f"{coordinate.name} {span} {coordinate.unit}")
    return ", ".join(parts)
