"""Comparison: what broke and what was fixed from each version of a VUT to the next.

A version is what was recorded of it. Cases that two neighbours both ran are paired, and a case that
passes with the earlier one and does not pass with the later one broke. Where each has cases of its
own, regions are compared: failures that are linked at the radius of FMC, and the cases that the
other version has within that radius of one of them. They decide nothing: two searches of one
version have cases on both sides of the edge of a region. That a version passes less often in its
own search than the earlier one in its decides, where it is more than chance.

`compare` reads recorded campaigns and runs nothing. `compare_against` reads a campaign that ran
both versions (`campaigns/against.py`). `rerun` (`rerun.py`) runs the recorded cases of one campaign
again with a changed VUT. All return a `Comparison`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from merge_sumo.campaigns.again import command
from merge_sumo.campaigns.run import Run
from merge_sumo.campaigns.settings import same_pov
from merge_sumo.errors import UserError
from merge_sumo.files import free
from merge_sumo.metrics.fmc import fmc, radius_for, regions
from merge_sumo.metrics.merge import Severity
from merge_sumo.metrics.outcome import Episode, Outcome
from merge_sumo.metrics.summary import (
    LevelSummary,
    RunsOfCase,
    by_case,
    judge,
    one_per_case,
    summarise,
)
from merge_sumo.records import Record, to_plain
from merge_sumo.result import Result
from merge_sumo.scenario.case import Case, coordinates, to_unit
from merge_sumo.scenario.scenario import level_name
from merge_sumo.scenario.trajectory import Trajectory

Motions = Callable[[Iterable[int]], Mapping[int, Trajectory]]
"""Gives motions by the index of their case, without those that are not there."""


@dataclass(frozen=True)
class Version:
    """A version of a VUT: the outcomes that are recorded of it.

    Attributes:
        vut: name of the VUT.
        folder: of its campaign; None where it ran in the cases of another one's.
        outcomes: all runs.
        tolerated: share of its runs in which a case may fail.
        levels: POV levels.
        motions: gives its motions.
        sampler: who chose its cases.
    """

    vut: str
    folder: str | None
    outcomes: Sequence[Outcome]
    tolerated: float
    levels: Sequence[int]
    motions: Motions
    sampler: str

    @classmethod
    def of(cls, run: Run) -> Version:
        """Return a campaign as a version."""
        levels = sorted({*run.levels, *(outcome.case.level for outcome in run.outcomes)})
        folder = str(run.folder)
        known = run.outcomes, run.tolerated, levels, run.trajectories
        return cls(run.vut, folder, *known, run.settings.sampler)

    def with_vut(self, vut: str, episodes: Sequence[Episode]) -> Version:
        """Return the version of another VUT in the same cases, by its episodes."""
        outcomes = [episode.outcome for episode in episodes]
        own = {episode.outcome.index: episode.trajectory for episode in episodes}

        def motions(indices: Iterable[int]) -> dict[int, Trajectory]:
            return {index: own[index] for index in indices if index in own}

        return replace(self, vut=vut, folder=None, outcomes=outcomes, motions=motions)

    @cached_property
    def cases(self) -> list[Outcome]:
        """The deciding run of each case."""
        return one_per_case(self.outcomes, self.tolerated)

    @cached_property
    def at(self) -> dict[int, LevelSummary]:
        """By level, what is known of it."""
        return summarise(self.outcomes, self.levels, self.tolerated).levels

    def to_record(self) -> dict[str, Any]:
        """Return it as JSON shows it."""
        levels = {level_name(level): to_plain(self.at[level]) for level in self.levels}
        counts = judge(self.outcomes, self.tolerated).to_record()
        return {"vut": self.vut, "folder": self.folder, **counts, "levels": levels}


LISTED = 10
"""Cases of each kind, and regions, that lines name."""
SIGNIFICANT = 0.05
"""Chance of the runs of a case in equal versions, up to which a change is none of chance."""
PAGE = Path("changes.html")
"""The page with both motions that a command writes."""


class Change(StrEnum):
    """What became of a case, or of a region of failures; in the order of tables.

    A case passes where the VUT arrives and the criterion is met. One whose runs are not alike may
    pass with one version alone by chance: it is `WITHIN_CHANCE` where Fisher's exact test does not
    tell the shares of failing runs apart. `LATER_ALONE`, `EARLIER_ALONE` and `NOT_SEEN` are only of
    regions, `WORSE` and `ACCEPTED` only of a cases file, `NOT_REPEATABLE` only of cases that ran
    again: it is a change that the same case does not show, or not alike, when it runs once more.
    """

    BROKE = "broke"
    WORSE = "worse but passing"
    ACCEPTED = "accepted"
    LATER_ALONE = "found in the later alone"
    WITHIN_CHANCE = "within chance"
    NOT_REPEATABLE = "not repeatable"
    NEITHER = "pass with neither"
    STILL_CONTACT = "contact without failure"
    FIXED = "fixed"
    EARLIER_ALONE = "found in the earlier alone"
    NOT_SEEN = "not looked at"
    BOTH = "pass with both"


GOT_WORSE = (Change.BROKE, Change.WORSE)


def passes(outcome: Outcome) -> bool:
    """Return whether the VUT reached its goal and the case is no failure."""
    return outcome.is_tested and not outcome.failed


@dataclass(frozen=True, slots=True)
class ComparedCase:
    """A case that two versions ran.

    Attributes:
        a: its outcome with the earlier version.
        b: its outcome with the later one.
        runs_a: its runs with the earlier one, of which `a` decides; None for a single one.
        runs_b: its runs with the later one.
        judged: what a cases file, or a second run, calls its change; None where none says.
    """

    a: Outcome
    b: Outcome
    runs_a: RunsOfCase | None = None
    runs_b: RunsOfCase | None = None
    judged: Change | None = None

    @property
    def change(self) -> Change:
        """What became of it."""
        if self.judged is not None:
            return self.judged
        before, after = passes(self.a), passes(self.b)
        if before == after:
            return Change.BOTH if before else Change.NEITHER
        if self.chance is not None and self.chance > SIGNIFICANT:
            return Change.WITHIN_CHANCE
        if before:
            return Change.BROKE
        # The criterion is met, but the case is not mended.
        is_contact = self.b.measures.severity == Severity.CONTACT
        return Change.STILL_CONTACT if is_contact else Change.FIXED

    @property
    def chance(self) -> float | None:
        """The chance of shares of failing runs as different as these, or more, in equal versions.

        By Fisher's exact test; None where the runs with each version are alike.
        """
        runs = [one for one in (self.runs_a, self.runs_b) if one is not None]
        if len(runs) < 2 or not any(one.varies for one in runs):
            return None
        return _fisher([(one.failures, one.runs) for one in runs])

    def to_record(self) -> dict[str, Any]:
        """Return it as JSON shows it."""
        record: dict[str, Any] = {"change": self.change, "level": self.a.case.level}
        sides = (("before", self.a, self.runs_a), ("after", self.b, self.runs_b))
        for name, outcome, runs in sides:
            found = outcome.measures
            record[f"index_{name}"], record[f"margin_{name}"] = outcome.index, outcome.margin
            record[f"end_{name}"], record[f"severity_{name}"] = found.end, found.severity
            if runs is not None:
                record |= {f"runs_{name}": runs.runs, f"failed_runs_{name}": runs.failures}
        return record


def _fisher(shares: Sequence[tuple[int, int]]) -> float:
    """Return the chance of two shares, (part, whole), as different or more where they are one."""
    from scipy.stats import fisher_exact

    return float(fisher_exact([[part, whole - part] for part, whole in shares])[1])


def short(value: Any) -> Any:
    """Return a number to the digits that a cases file has, another value as it is."""
    return float(f"{value:.6g}") if isinstance(value, float) else value


def outcome_word(outcome: Outcome) -> str:
    """Return how a case ended, in words."""
    return outcome.measures.became.lower().replace("_", " ")


def paired(
    before: Sequence[Outcome], after: Sequence[Outcome], tolerated: float
) -> list[ComparedCase]:
    """Return the cases of both, what broke first, the worst first; see `Change` for the order.

    `tolerated` is the share of its runs in which a case may fail.

    Args:
        before: outcomes of the earlier version.
        after: outcomes of the later version.
        tolerated: share of its runs in which a case may fail.
    """
    first, second = _by_case(before, tolerated), _by_case(after, tolerated)
    cases = [
        ComparedCase(first[key][0], second[key][0], first[key][1], second[key][1])
        for key in first.keys() & second.keys()
    ]
    return in_order(cases)


def in_order(cases: Iterable[ComparedCase]) -> list[ComparedCase]:
    """Return cases in the order of tables, of a change the worst first."""
    order = list(Change)
    return sorted(cases, key=lambda c: (order.index(c.change), c.b.margin or 0.0, c.b.index))


def _by_case(
    outcomes: Sequence[Outcome], tolerated: float
) -> dict[tuple[Case, int], tuple[Outcome, RunsOfCase | None]]:
    """Return the deciding run of each case, and all of them where there are several."""
    repeated = {outcome.case.start for outcome in outcomes if outcome.case.draw}
    runs: dict[tuple[Case, int], list[Outcome]] = {}
    times: Counter[Case] = Counter()
    for outcome in outcomes:
        start = outcome.case.start
        # A case without repeats may be there twice.
        runs.setdefault((start, 0 if start in repeated else times[start]), []).append(outcome)
        times[start] += 1
    return {
        key: (
            one_per_case(of_case, tolerated)[0],
            next((one for one in by_case(of_case) if one.runs > 1), None),
        )
        for key, of_case in runs.items()
    }


class Region(Record, frozen=True):
    """A region of failures of one of two neighbours, and what the other one did in it.

    Attributes:
        change: what became of it; `NOT_SEEN` where the other version has no case there.
        version: number of the version that fails there, from 1.
        failures: of that version, in the region.
        worst: index of the worst of them in its campaign.
        where: the box of these failures, in words.
        fmc: their volume.
        cases: cases in the region that the other version tested.
        failed: those of them that failed.
    """

    change: Change
    version: int
    failures: int
    worst: int
    where: str
    fmc: float
    cases: int
    failed: int


@dataclass(frozen=True, slots=True)
class Step:
    """What changed from a version to the next that has a level in common with it.

    Attributes:
        before: number of the earlier version, from 1.
        after: number of the later one.
        cases: the cases that both ran, in the order of `paired`.
        regions: by level, what became of regions, where each has cases of its own.
        chance: where there are such levels, and one sampler searched for both, or where cases that
            ran twice do not repeat, the chance of shares of passing cases there as different as
            these, or more, in equal versions, by Fisher's exact test; else None.
        passes_less: whether the later one passes in a smaller share, by more than chance.
    """

    before: int
    after: int
    cases: list[ComparedCase]
    regions: dict[int, list[Region]]
    chance: float | None = None
    passes_less: bool = False

    @property
    def transitions(self) -> dict[tuple[Change, str, str], int]:
        """Cases by what became of them, and the outcome before and after, in words."""
        found = Counter(
            (one.change, outcome_word(one.a), outcome_word(one.b)) for one in self.cases
        )
        order = list(Change)
        return dict(sorted(found.items(), key=lambda row: (order.index(row[0][0]), -row[1])))

    def count(self, change: Change) -> int:
        """Return the number of cases of which that became."""
        return sum(case.change is change for case in self.cases)

    def to_record(self) -> dict[str, Any]:
        """Return it as JSON shows it: counts first, then each case but those that always pass."""
        return {
            "before": self.before,
            "after": self.after,
            "chance": self.chance,
            "passes_less": self.passes_less,
            "transitions": [
                {"change": change, "before": before, "after": after, "cases": number}
                for (change, before, after), number in self.transitions.items()
            ],
            "cases": [one.to_record() for one in self.cases if one.change is not Change.BOTH],
            "regions": {
                level_name(level): to_plain(found) for level, found in self.regions.items()
            },
        }


@dataclass(frozen=True, slots=True, repr=False)
class Comparison(Result):
    """Versions of a VUT, the oldest first, and what changed from each to the next.

    Attributes:
        versions: the versions.
        steps: what changed.
        source: a sentence on where the cases come from.
        notes: sentences on what limits the comparison.
        page_command: the command that writes its page, with both motions of the cases.
        text: of a cases file, what it would be now; then the notes have the difference.
    """

    versions: tuple[Version, ...]
    steps: tuple[Step, ...]
    source: str
    notes: tuple[str, ...] = ()
    page_command: str = ""
    text: str | None = None

    @property
    def broke(self) -> int:
        """Number of cases that broke in some step."""
        return sum(step.count(Change.BROKE) for step in self.steps)

    @property
    def is_good(self) -> bool:
        """See `Result`."""
        return not self.worse

    @property
    def worse(self) -> bool:
        """Whether a case broke or lost too much margin, or a version passes less often.

        Also where the last version tested no case.
        """
        got_worse = any(one.change in GOT_WORSE for step in self.steps for one in step.cases)
        less = any(step.passes_less for step in self.steps)
        return got_worse or less or not any(o.is_tested for o in self.versions[-1].outcomes)

    def to_record(self) -> dict[str, Any]:
        """Return what `--json` prints."""
        return {
            "worse": self.worse,
            "broke": self.broke,
            "source": self.source,
            "versions": [version.to_record() for version in self.versions],
            "steps": [step.to_record() for step in self.steps],
            "notes": list(self.notes),
        }


def cut(number: int, most: int) -> str:
    """Return how many of a list are shown, as behind its name."""
    return f", the first {most} of {number}" if number > most else f", {number}"


def compare(runs: Sequence[Run]) -> Comparison:
    """Compare recorded campaigns, the oldest first; nothing runs.

    Raises `UserError` for fewer than two, and where they differ in the scenario, the criterion or,
    at a level, the POV: then their failures are not of the same question.
    """
    if len(runs) < 2:
        raise UserError("a comparison needs two campaigns or more: name the older one first")
    for run in runs[1:]:
        _check_comparable(runs[0], run)
    found = [Version.of(run) for run in runs]
    if not set.intersection(*(set(version.levels) for version in found[:2])):
        raise UserError(f"{runs[0].folder} and {runs[1].folder} have no POV level in common")
    return Comparison(
        versions=tuple(found),
        steps=tuple(_step(found, number) for number in range(1, len(found))),
        source=(
            "each campaign has the cases of its own search: where they share none, regions are a "
            "hint, and `merge-sumo rerun` pairs the cases of one with another VUT"
        ),
        notes=tuple(_notes(runs)),
        page_command=command("compare", *(run.folder for run in runs), out=free(PAGE)),
    )


def compare_against(run: Run) -> Comparison | None:
    """Compare a campaign's VUT with the version that the campaign is against, in the same cases.

    None where it is against none.
    """
    earlier = run.earlier()
    if earlier is None:
        return None
    outcomes = earlier.outcomes[: len(run.outcomes)]
    before = replace(Version.of(earlier), outcomes=outcomes, tolerated=run.tolerated)
    source = f"both ran the same cases, which the search chose where {run.vut} alone may fail"
    return of_two(before, Version.of(run), source)


def of_two(before: Version, after: Version, source: str) -> Comparison:
    """Return the comparison of two versions that ran the same cases.

    Args:
        before: the earlier version.
        after: the later version.
        source: where the cases are from, as a text.
    """
    return Comparison((before, after), (_step((before, after), 1),), source)


def _check_comparable(a: Run, b: Run) -> None:
    differing = {
        "the scenario": a.scenario != b.scenario,
        "what counts as a failure": a.criterion != b.criterion,
        "the share of its runs in which a case may fail": a.tolerated != b.tolerated,
        **{
            f"the POV of level {level_name(level)}": not same_pov(a.record, b.record, level)
            for level in sorted(set(a.levels) & set(b.levels))
        },
    }
    for name, differs in differing.items():
        if differs:
            raise UserError(
                f"{a.folder} and {b.folder} differ in {name}: compare campaigns that have the same"
            )


def _notes(runs: Sequence[Run]) -> list[str]:
    """Return what limits the comparison of campaigns, in sentences."""
    notes = []
    if len({(run.settings.sampler, run.settings.cases) for run in runs}) > 1:
        notes.append(
            "The campaigns differ in sampler or number of cases: FMC, failures and regions are "
            "what each of them found, and a longer search finds more."
        )
    notes += [f"{run.folder}: {run.interruption}" for run in runs if run.interruption]
    return notes


def _step(found: Sequence[Version], after: int) -> Step:
    """Return what changed to the version at a place from the one before it."""
    earlier, later = found[after - 1], found[after]
    cases = paired(earlier.outcomes, later.outcomes, later.tolerated)
    regions_at = {}
    own: tuple[list[Outcome], list[Outcome]] = [], []
    for level in sorted(set(earlier.levels) & set(later.levels)):
        sides = [[o for o in one.cases if o.case.level == level] for one in (earlier, later)]
        if sum(case.a.case.level == level for case in cases) < max(map(len, sides)):
            regions_at[level] = _regions(after, *sides)
            own[0].extend(sides[0])
            own[1].extend(sides[1])
    if not regions_at or earlier.sampler != later.sampler:
        return Step(after, after + 1, cases, regions_at)
    chance, less = passes_less(*own)
    return Step(after, after + 1, cases, regions_at, chance, less)


def passes_less(earlier: Sequence[Outcome], later: Sequence[Outcome]) -> tuple[float, bool]:
    """Compare the shares of cases that pass, by Fisher's exact test.

    Returns:
        The chance of shares as different as these in equal versions, and whether a smaller share
        passes in `later`, by more than chance.
    """
    (passed_a, ran_a), (passed_b, ran_b) = shares = [
        (sum(map(passes, outcomes)), len(outcomes)) for outcomes in (earlier, later)
    ]
    chance = _fisher(shares)
    return chance, chance <= SIGNIFICANT and passed_b * ran_a < passed_a * ran_b


def _regions(number: int, earlier: Sequence[Outcome], later: Sequence[Outcome]) -> list[Region]:
    """Return the regions of two versions at a level, of which the earlier one has a number."""
    own = _regions_of(number, earlier, later, Change.EARLIER_ALONE)
    new = _regions_of(number + 1, later, earlier, Change.LATER_ALONE)
    # Where both fail the region is given once, as one of the earlier version.
    both = [*own, *(region for region in new if not region.failed)]
    order = list(Change)
    return sorted(both, key=lambda one: (order.index(one.change), -one.fmc, one.worst))


def _regions_of(
    number: int, outcomes: Sequence[Outcome], others: Sequence[Outcome], none_failed: Change
) -> list[Region]:
    """Return the regions of failures of a version, and what the other one's cases say of them.

    A region where the other one's cases do not fail became `none_failed`.
    """
    failing, tested = [o for o in outcomes if o.failed], [o for o in others if o.is_tested]
    if not failing:
        return []
    level = failing[0].case.level
    points, of_others = (to_unit((o.case for o in some), level) for some in (failing, tested))
    labels, limit = regions(points), radius_for(points.shape[1]) + 1e-9
    found = []
    for label in np.unique(labels):
        at = points[labels == label]
        own = [failing[place] for place in np.flatnonzero(labels == label)]
        near = cKDTree(at).query(of_others)[0] <= limit if tested else ()
        inside = [tested[place] for place in np.flatnonzero(near)]
        failed = sum(outcome.failed for outcome in inside)
        change = none_failed if inside else Change.NOT_SEEN
        found.append(
            Region(
                change=Change.NEITHER if failed else change,
                version=number,
                failures=len(own),
                worst=min(own, key=lambda o: (o.margin, o.index)).index,
                where=_box_in_words([o.case for o in own]),
                fmc=fmc(at),
                cases=len(inside),
                failed=failed,
            )
        )
    return found


def _box_in_words(cases: Sequence[Case]) -> str:
    """Return the smallest box around some cases in words."""
    parts = []
    for coordinate in coordinates(cases[0].scenario, (cases[0].level,)):
        ordered = sorted(cases, key=lambda case: coordinate.of(case) or 0.0)
        low, high = coordinate.text(ordered[0]), coordinate.text(ordered[-1])
        span = low if low == high else f"{low} to {high}"
        parts.append(f"{coordinate.name} {span} {coordinate.unit}")
    return ", ".join(parts)
