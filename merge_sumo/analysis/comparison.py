"""Comparison: which cases broke and which were fixed from each version of a VUT to the next.

Cases that both versions ran are paired; where each has cases of its own, shares are compared.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from merge_sumo.campaigns.again import command
from merge_sumo.campaigns.recorded import RecordedCampaign
from merge_sumo.campaigns.settings import same_pov
from merge_sumo.errors import UserError
from merge_sumo.files import free
from merge_sumo.metrics.merge import Severity
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.summary import (
    LevelSummary,
    RunsOfCase,
    by_case,
    judge,
    one_per_case,
    summarise,
)
from merge_sumo.records import to_plain
from merge_sumo.result import Result
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import level_name
from merge_sumo.scenario.trajectory import Trajectory

LISTED = 10
"""Maximum number of cases of each kind that lines name."""
SIGNIFICANT = 0.05
"""Largest p-value of Fisher's exact test at which a difference is more than chance."""
PAGE = Path("changes.html")
"""The page with both motions that a command writes."""

Motions = Callable[[Iterable[int]], Mapping[int, Trajectory]]
"""Returns the recorded motions of cases by their index."""


@dataclass(frozen=True)
class Version:
    """A version of a VUT: its recorded outcomes.

    Attributes:
        vut: name of the VUT.
        folder: folder of its campaign; None where it ran the cases of another version's campaign.
        outcomes: all runs.
        tolerated: share of its runs in which a case may fail.
        motions: returns its motions.
        sampler: the sampler that chose its cases.
    """

    vut: str
    folder: str | None
    outcomes: Sequence[Outcome]
    tolerated: float
    motions: Motions
    sampler: str

    @classmethod
    def of(cls, run: RecordedCampaign) -> Version:
        """Return a campaign as a version."""
        return cls(
            vut=run.vut,
            folder=str(run.folder),
            outcomes=run.outcomes,
            tolerated=run.tolerated,
            motions=run.trajectories,
            sampler=run.settings.sampler,
        )

    @cached_property
    def at(self) -> dict[int, LevelSummary]:
        """The summary of each level with cases."""
        return summarise(self.outcomes, (), self.tolerated).levels

    def to_record(self) -> dict[str, Any]:
        """Return the version as JSON has it."""
        levels = {level_name(level): to_plain(summary) for level, summary in self.at.items()}
        counts = judge(self.outcomes, self.tolerated).to_record()
        return {"vut": self.vut, "folder": self.folder, **counts, "levels": levels}


class Change(StrEnum):
    """The change of a case, in the order of tables.

    A case passes where the VUT reaches its goal and the criterion is met. `WORSE` and `ACCEPTED`
    are changes of cases files, `NOT_REPEATABLE` of cases that go differently when they run again.
    """

    BROKE = "broke"
    WORSE = "worse but passing"
    ACCEPTED = "accepted"
    WITHIN_CHANCE = "within chance"
    NOT_REPEATABLE = "not repeatable"
    NEITHER = "pass with neither"
    STILL_CONTACT = "contact without failure"
    FIXED = "fixed"
    BOTH = "pass with both"


ORDER = list(Change)
GOT_WORSE = (Change.BROKE, Change.WORSE)


def passes(outcome: Outcome) -> bool:
    """Return whether the VUT reached its goal and the case is not a failure."""
    return outcome.is_tested and not outcome.failed


def short(value: Any) -> Any:
    """Return a number to the digits of a cases file, another value as it is."""
    return float(f"{value:.6g}") if isinstance(value, float) else value


def outcome_word(outcome: Outcome) -> str:
    """Return how a case ended, in words."""
    return outcome.measures.result.lower().replace("_", " ")


def cut(number: int, most: int) -> str:
    """Return how many items of a list are shown, to stand after its title."""
    return f", the first {most} of {number}" if number > most else f", {number}"


@dataclass(frozen=True, slots=True)
class ComparedCase:
    """A case that two versions ran.

    Attributes:
        a: its outcome with the earlier version.
        b: its outcome with the later one.
        change: the change from `a` to `b`.
        runs_a: its runs with the earlier version, of which `a` decides; None for a single run.
        runs_b: its runs with the later version.
        chance: p-value of Fisher's exact test of the shares of failing runs; None where the runs
            with each version are alike.
    """

    a: Outcome
    b: Outcome
    change: Change
    runs_a: RunsOfCase | None = None
    runs_b: RunsOfCase | None = None
    chance: float | None = None

    @classmethod
    def of(
        cls, before: Sequence[Outcome], after: Sequence[Outcome], tolerated: float = 0.0
    ) -> ComparedCase:
        """Compare the runs of a case with two versions.

        Args:
            before: outcomes of the case with the earlier version, one a run.
            after: outcomes with the later version.
            tolerated: share of its runs in which a case may fail.
        """
        a, b = one_per_case(before, tolerated)[0], one_per_case(after, tolerated)[0]
        runs_a, runs_b = _repeated(before), _repeated(after)
        chance = None
        if runs_a and runs_b and (runs_a.varies or runs_b.varies):
            chance = fisher((runs_a.failures, runs_a.runs), (runs_b.failures, runs_b.runs))
        return cls(a, b, _change(a, b, chance), runs_a, runs_b, chance)

    def to_record(self) -> dict[str, Any]:
        """Return the case as JSON has it."""
        record: dict[str, Any] = {"change": self.change, "level": self.a.case.level}
        sides = (("before", self.a, self.runs_a), ("after", self.b, self.runs_b))
        for name, outcome, runs in sides:
            record[f"index_{name}"], record[f"margin_{name}"] = outcome.index, outcome.margin
            record[f"end_{name}"] = outcome.measures.end
            record[f"severity_{name}"] = outcome.measures.severity
            if runs is not None:
                record |= {f"runs_{name}": runs.runs, f"failed_runs_{name}": runs.failures}
        return record


def _repeated(outcomes: Sequence[Outcome]) -> RunsOfCase | None:
    """Return the runs of one case; None where there is a single one with a verdict."""
    for runs in by_case(outcomes):
        if runs.runs > 1:
            return runs
    return None


def _change(a: Outcome, b: Outcome, chance: float | None) -> Change:
    before, after = passes(a), passes(b)
    if before == after:
        return Change.BOTH if before else Change.NEITHER
    if chance is not None and chance > SIGNIFICANT:
        return Change.WITHIN_CHANCE
    if before:
        return Change.BROKE
    # The criterion is met, but the case is not mended.
    is_contact = b.measures.severity == Severity.CONTACT
    return Change.STILL_CONTACT if is_contact else Change.FIXED


def fisher(one: tuple[int, int], other: tuple[int, int]) -> float:
    """Return the p-value of Fisher's exact test of two shares, (part, whole)."""
    from scipy.stats import fisher_exact

    table = np.array((one, other))
    table[:, 1] -= table[:, 0]
    return float(fisher_exact(table)[1])


def paired(
    before: Iterable[Outcome], after: Iterable[Outcome], tolerated: float
) -> list[ComparedCase]:
    """Return the cases that both versions ran, in the order of tables.

    Args:
        before: outcomes of the earlier version.
        after: outcomes of the later version.
        tolerated: share of its runs in which a case may fail.
    """
    first, second = _by_start(before), _by_start(after)
    cases = []
    for start in first.keys() & second.keys():
        cases.append(ComparedCase.of(first[start], second[start], tolerated))
    return in_order(cases)


def _by_start(outcomes: Iterable[Outcome]) -> dict[Case, list[Outcome]]:
    runs: dict[Case, list[Outcome]] = {}
    for outcome in outcomes:
        runs.setdefault(outcome.case.start, []).append(outcome)
    return runs


def in_order(cases: Iterable[ComparedCase]) -> list[ComparedCase]:
    """Return cases in the order of tables, of each change the worst first."""
    return sorted(cases, key=lambda c: (ORDER.index(c.change), c.b.margin or 0.0, c.b.index))


@dataclass(frozen=True, slots=True)
class Step:
    """The changes from a version to the next.

    Attributes:
        before: number of the earlier version, from 1.
        after: number of the later one.
        cases: the cases that both ran, in the order of `in_order`.
        chance: p-value of Fisher's exact test of the shares of cases that pass; None where the
            versions ran the same cases, and where different samplers chose them.
        passes_less: whether the later version passes in a smaller share, by more than chance.
    """

    before: int
    after: int
    cases: list[ComparedCase]
    chance: float | None = None
    passes_less: bool = False

    @property
    def transitions(self) -> dict[tuple[Change, str, str], int]:
        """Number of cases by change, and by the outcome before and after in words."""
        found: Counter[tuple[Change, str, str]] = Counter()
        for one in self.cases:
            found[one.change, outcome_word(one.a), outcome_word(one.b)] += 1
        return found

    def count(self, change: Change) -> int:
        """Return the number of cases with a change."""
        return sum(case.change is change for case in self.cases)

    def to_record(self) -> dict[str, Any]:
        """Return the step as JSON has it, without the cases that pass with both versions."""
        transitions = []
        for (change, before, after), number in self.transitions.items():
            row = {"change": change, "before": before, "after": after, "cases": number}
            transitions.append(row)
        return {
            "before": self.before,
            "after": self.after,
            "chance": self.chance,
            "passes_less": self.passes_less,
            "transitions": transitions,
            "cases": [one.to_record() for one in self.cases if one.change is not Change.BOTH],
        }


@dataclass(frozen=True, slots=True, repr=False)
class Comparison(Result):
    """Versions of a VUT, the oldest first, and the changes from each to the next.

    Example:
        compared = ms.compare(["runs/before", "runs/after"])
        assert not compared.worse, compared

    Attributes:
        versions: the versions.
        steps: the changes.
        source: a sentence on the origin of the cases.
        notes: sentences on the limits of the comparison.
        page_command: the command that writes its page, with both motions of the cases.
        text: the new text of a cases file, whose changed lines are in the notes; None otherwise.
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
        """Whether a case got worse, a version passes less often, or the last one tested no case."""
        for step in self.steps:
            if step.passes_less or any(map(step.count, GOT_WORSE)):
                return True
        return not any(outcome.is_tested for outcome in self.versions[-1].outcomes)

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


def compare(runs: Sequence[RecordedCampaign]) -> Comparison:
    """Compare recorded campaigns, the oldest first; nothing runs.

    Raises:
        UserError: for fewer than two campaigns, and where they differ in the scenario, the
            criterion or, at a level, the POV.
    """
    if len(runs) < 2:
        raise UserError("a comparison needs two campaigns or more: name the older one first")
    for run in runs[1:]:
        _check_comparable(runs[0], run)
    versions = list(map(Version.of, runs))
    if not versions[0].at.keys() & versions[1].at.keys():
        raise UserError(f"{runs[0].folder} and {runs[1].folder} have no POV level in common")
    notes = []
    if len({(run.settings.sampler, run.settings.cases) for run in runs}) > 1:
        notes.append(
            "The campaigns differ in sampler or number of cases: a longer search finds more "
            "failures and regions, and a larger FMC."
        )
    notes += [f"{run.folder}: {run.interruption}" for run in runs if run.interruption]
    return Comparison(
        versions=tuple(versions),
        steps=tuple(_step(versions, number) for number in range(1, len(versions))),
        source=(
            "each campaign has the cases of its own search; `merge-sumo rerun` pairs the cases of "
            "one with another VUT"
        ),
        notes=tuple(notes),
        page_command=command("compare", *(run.folder for run in runs), out=free(PAGE)),
    )


def compare_against(run: RecordedCampaign) -> Comparison | None:
    """Compare the VUT of a campaign with the earlier version of `--against`, in the same cases.

    Returns:
        The comparison; None for a campaign without an earlier version.
    """
    earlier = run.earlier()
    if earlier is None:
        return None
    before = Version.of(earlier)
    # An interrupted campaign may have more cases of the earlier version.
    outcomes = earlier.outcomes[: len(run.outcomes)]
    before = replace(before, outcomes=outcomes, tolerated=run.tolerated)
    source = f"both ran the same cases, which the search chose where {run.vut} alone may fail"
    return of_two(before, Version.of(run), source)


def of_two(before: Version, after: Version, source: str) -> Comparison:
    """Return the comparison of two versions that ran the same cases.

    Args:
        before: the earlier version.
        after: the later version.
        source: a sentence on the origin of the cases.
    """
    return Comparison((before, after), (_step((before, after), 1),), source)


def _check_comparable(a: RecordedCampaign, b: RecordedCampaign) -> None:
    differs = {
        "the scenario": a.scenario != b.scenario,
        "what counts as a failure": a.criterion != b.criterion,
        "the share of its runs in which a case may fail": a.tolerated != b.tolerated,
    }
    for level in sorted(set(a.levels) & set(b.levels)):
        name = f"the POV of level {level_name(level)}"
        differs[name] = not same_pov(a.record, b.record, level)
    for name, is_different in differs.items():
        if is_different:
            raise UserError(
                f"{a.folder} and {b.folder} differ in {name}: compare campaigns that have the same"
            )


def _step(versions: Sequence[Version], after: int) -> Step:
    """Return the changes to the version with an index from the one before it."""
    earlier, later = versions[after - 1], versions[after]
    step = Step(after, after + 1, paired(earlier.outcomes, later.outcomes, later.tolerated))
    levels = earlier.at.keys() & later.at.keys()
    before = _at_levels(earlier, levels)
    now = _at_levels(later, levels)
    has_own = len(step.cases) < max(len(before), len(now))
    if has_own and earlier.sampler == later.sampler:
        return with_shares(step, before, now)
    return step


def _at_levels(version: Version, levels: Container[int]) -> list[Outcome]:
    """Return the deciding run of each case of some levels."""
    cases = one_per_case(version.outcomes, version.tolerated)
    return [outcome for outcome in cases if outcome.case.level in levels]


def with_shares(step: Step, earlier: Sequence[Outcome], later: Sequence[Outcome]) -> Step:
    """Return a step with the comparison of the shares of cases that pass.

    Args:
        step: the step.
        earlier: outcomes of the earlier version, one a case.
        later: outcomes of the later version.
    """
    passed_a, passed_b = sum(map(passes, earlier)), sum(map(passes, later))
    chance = fisher((passed_a, len(earlier)), (passed_b, len(later)))
    is_less = passed_b * len(earlier) < passed_a * len(later)
    return replace(step, chance=chance, passes_less=is_less and chance <= SIGNIFICANT)
