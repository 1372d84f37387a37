"""Comparison: which cases broke and which were fixed from each version of a VUT to the next.

Cases that both versions ran are paired; where each has cases of its own, shares are compared.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from itertools import pairwise
from typing import Any

from merge_sumo.campaigns.recorded import RecordedCampaign
from merge_sumo.campaigns.settings import same_pov
from merge_sumo.errors import UserError
from merge_sumo.metrics.merge import Severity
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.summary import (
    RunsOfCase,
    Summary,
    by_case,
    one_per_case,
    summarise,
)
from merge_sumo.result import Result
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import level_name
from merge_sumo.scenario.trajectory import Trajectory

SIGNIFICANT = 0.05
"""Largest p-value of Fisher's exact test at which a difference is more than chance."""


@dataclass(frozen=True)
class Version:
    """A version of a VUT: its recorded outcomes.

    Attributes:
        vut: name of the VUT.
        folder: folder of its campaign; None where it ran the cases of another version's campaign.
        outcomes: its outcomes, one for each run of a case.
        tolerated: share of its runs in which a case may fail, 0 to 1.
        motion: returns the motion of a case by its index; None where it is lost.
        sampler: name of the sampler that chose its cases.
    """

    vut: str
    folder: str | None
    outcomes: Sequence[Outcome]
    tolerated: float
    motion: Callable[[int], Trajectory | None]
    sampler: str

    @classmethod
    def of(cls, run: RecordedCampaign) -> Version:
        """Return the version of a recorded campaign.

        Args:
            run: the campaign.
        """
        return cls(
            vut=run.vut,
            folder=str(run.folder),
            outcomes=run.outcomes,
            tolerated=run.tolerated,
            motion=lambda index: run.trajectories([index]).get(index),
            sampler=run.settings.sampler,
        )

    @cached_property
    def summary(self) -> Summary:
        """The summary of its cases, and of each level with cases."""
        levels = sorted({outcome.case.level for outcome in self.outcomes})
        return summarise(self.outcomes, levels, self.tolerated)

    def to_record(self) -> dict[str, Any]:
        """Return the version as JSON has it."""
        record = self.summary.to_record()
        levels = {level_name(level): summary for level, summary in record["levels"].items()}
        return {"vut": self.vut, "folder": self.folder, **record, "levels": levels}


class Change(StrEnum):
    """The change of a case, in the order of tables.

    A case passes where the VUT reaches its goal and the criterion is met. `WORSE`, `WEAKER` and
    `ACCEPTED` are changes of cases files, `NOT_REPEATABLE` of cases that go differently when they
    run again.
    """

    BROKE = "broke"
    WORSE = "worse but passing"
    FIXED = "fixed"
    WEAKER = "weaker"
    ACCEPTED = "accepted"
    WITHIN_CHANCE = "within chance"
    NOT_REPEATABLE = "not repeatable"
    STILL_CONTACT = "contact without failure"
    NEITHER = "pass with neither"
    BOTH = "pass with both"

    @property
    def group(self) -> str:
        """Its meaning for the later version; a case that is worse gives exit code 1."""
        return GROUP.get(self, "not counted")


GROUP = {
    Change.BROKE: "worse",
    Change.WORSE: "worse",
    Change.FIXED: "better",
    Change.WEAKER: "weaker",
    Change.NEITHER: "same verdict",
    Change.BOTH: "same verdict",
}


def outcome_word(outcome: Outcome) -> str:
    """Return the end or the severity of a case, in words.

    Args:
        outcome: the outcome of the case.
    """
    return outcome.measures.result.lower().replace("_", " ")


@dataclass(frozen=True, slots=True)
class ComparedCase:
    """A case that two versions ran.

    Attributes:
        earlier: outcome with the earlier version; of several runs, the deciding run.
        later: outcome with the later version; of several runs, the deciding run.
        change: the change from `earlier` to `later`.
        earlier_runs: all runs with the earlier version; None for a single run.
        later_runs: all runs with the later version; None for a single run.
        p_value: p-value of Fisher's exact test of the shares of failing runs; None if the runs of
            each version do not differ.
    """

    earlier: Outcome
    later: Outcome
    change: Change
    earlier_runs: RunsOfCase | None = None
    later_runs: RunsOfCase | None = None
    p_value: float | None = None

    @classmethod
    def of(
        cls, earlier: Sequence[Outcome], later: Sequence[Outcome], tolerated: float = 0.0
    ) -> ComparedCase:
        """Compare the runs of a case with two versions.

        Args:
            earlier: outcomes of the case with the earlier version, one for each run.
            later: outcomes with the later version.
            tolerated: share of its runs in which a case may fail, 0 to 1.

        Returns:
            The case, with the deciding run of each version.
        """
        runs, other = _repeated(earlier), _repeated(later)
        p_value = None
        if runs and other and (runs.varies or other.varies):
            p_value = fisher((runs.failures, runs.runs), (other.failures, other.runs))
        a, b = one_per_case(earlier, tolerated)[0], one_per_case(later, tolerated)[0]
        return cls(a, b, _change(a, b, p_value), runs, other, p_value)

    def to_record(self) -> dict[str, Any]:
        """Return the object that `--json` prints."""
        record: dict[str, Any] = {"change": self.change, "level": self.earlier.case.level}
        sides = (
            ("before", self.earlier, self.earlier_runs),
            ("after", self.later, self.later_runs),
        )
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


def _change(earlier: Outcome, later: Outcome, p_value: float | None) -> Change:
    if earlier.passes == later.passes:
        return Change.BOTH if later.passes else Change.NEITHER
    if p_value is not None and p_value > SIGNIFICANT:
        return Change.WITHIN_CHANCE
    if earlier.passes:
        return Change.BROKE
    # The criterion is met, but bodies still touch.
    is_contact = later.measures.severity == Severity.CONTACT
    return Change.STILL_CONTACT if is_contact else Change.FIXED


def fisher(one: tuple[int, int], other: tuple[int, int]) -> float:
    """Return the p-value of Fisher's exact test of two shares.

    Args:
        one: a share as (part, whole).
        other: the other share.
    """
    from scipy.stats import fisher_exact

    table = [(part, whole - part) for part, whole in (one, other)]
    return float(fisher_exact(table)[1])


def _by_start(outcomes: Iterable[Outcome]) -> dict[Case, list[Outcome]]:
    runs: dict[Case, list[Outcome]] = {}
    for outcome in outcomes:
        runs.setdefault(outcome.case.start, []).append(outcome)
    return runs


def in_order(cases: Iterable[ComparedCase]) -> list[ComparedCase]:
    """Return cases in the order of tables: by change, and the lowest later margin first.

    Args:
        cases: the cases, in any order.
    """
    return sorted(
        cases, key=lambda c: (list(Change).index(c.change), c.later.margin or 0.0, c.later.index)
    )


@dataclass(frozen=True, slots=True)
class VersionChange:
    """The changes from one version to the next.

    Attributes:
        number: number of the later version, from 2.
        cases: the cases that both versions ran, by change and by margin.
        p_value: p-value of Fisher's exact test of the shares of cases that pass; None if the
            versions ran the same cases, or if different samplers chose them.
        passes_less: whether the later version passes a significantly smaller share of its cases.
    """

    number: int
    cases: list[ComparedCase]
    p_value: float | None = None
    passes_less: bool = False

    @property
    def transitions(self) -> dict[tuple[Change, str, str], int]:
        """Number of cases by change, earlier outcome and later outcome, in words."""
        found: Counter[tuple[Change, str, str]] = Counter()
        for one in self.cases:
            found[one.change, outcome_word(one.earlier), outcome_word(one.later)] += 1
        return found

    @property
    def groups(self) -> Counter[str]:
        """Number of cases of each group, such as worse and better."""
        found = Counter({"worse": 0, "better": 0})
        found.update(one.change.group for one in self.cases)
        return found

    def count(self, change: Change) -> int:
        """Return the number of cases with a change.

        Args:
            change: the change.
        """
        return sum(case.change is change for case in self.cases)

    def to_record(self) -> dict[str, Any]:
        """Return the object that `--json` prints, without the cases that pass with both."""
        transitions = []
        for (change, before, after), number in self.transitions.items():
            row = {"change": change, "before": before, "after": after, "cases": number}
            transitions.append(row)
        return {
            "before": self.number - 1,
            "after": self.number,
            "chance": self.p_value,
            "passes_less": self.passes_less,
            "transitions": transitions,
            "cases": [one.to_record() for one in self.cases if one.change is not Change.BOTH],
        }


@dataclass(frozen=True, slots=True, repr=False)
class Comparison(Result):
    """The comparison of two or more versions of a controller.

    `ms.compare` and `ms.rerun` return it.

    Example:
        ```python
        compared = ms.compare(["runs/before", "runs/after"])
        assert not compared.worse, compared
        ```

    Attributes:
        versions: the versions, the oldest first.
        version_changes: the changes from each version to the next.
        source: where the cases come from, in a sentence.
        notes: limits of the comparison, in sentences.
        text: new text of a cases file, after the rerun of one; its changed lines are in the notes.
    """

    versions: tuple[Version, ...]
    version_changes: tuple[VersionChange, ...]
    source: str
    notes: tuple[str, ...] = ()
    text: str | None = None

    @property
    def broke(self) -> int:
        """Number of cases that broke, over all versions."""
        return sum(one.count(Change.BROKE) for one in self.version_changes)

    @property
    def is_good(self) -> bool:
        """Whether nothing got worse: the exit code of the command is then 0."""
        return not self.worse

    @property
    def worse(self) -> bool:
        """Whether a case got worse, a version passes less often, or the last has no judged case."""
        for one in self.version_changes:
            if one.passes_less or one.groups["worse"]:
                return True
        return not any(outcome.is_tested for outcome in self.versions[-1].outcomes)

    def to_record(self) -> dict[str, Any]:
        """Return the object that `--json` prints."""
        return {
            "worse": self.worse,
            "broke": self.broke,
            "source": self.source,
            "versions": [version.to_record() for version in self.versions],
            "steps": [one.to_record() for one in self.version_changes],
            "notes": list(self.notes),
        }


def compare(runs: Sequence[RecordedCampaign]) -> Comparison:
    """Compare recorded campaigns; nothing runs.

    Args:
        runs: two campaigns or more, the oldest first.

    Returns:
        The comparison, with the changes from each campaign to the next.

    Raises:
        UserError: for fewer than two campaigns, where one has no level in common with the next,
            and where they differ in the scenario, the criterion or, at a level, the POV.
    """
    if len(runs) < 2:
        raise UserError("a comparison needs at least two campaigns: name them, the oldest first")
    for run in runs[1:]:
        _check_comparable(runs[0], run)
    versions = list(map(Version.of, runs))
    changes = []
    for number, (earlier, later) in enumerate(pairwise(versions), start=2):
        if not earlier.summary.levels.keys() & later.summary.levels.keys():
            raise UserError(f"{earlier.folder} and {later.folder} have no POV level in common")
        changes.append(_version_change(number, earlier, later))
    notes = []
    if len({(run.settings.sampler, run.settings.cases) for run in runs}) > 1:
        notes.append(
            "The campaigns differ in sampler or number of cases: a longer search finds more "
            "failures and regions, and a larger FMC."
        )
    notes += [f"{run.folder}: {run.interruption}" for run in runs if run.interruption]
    return Comparison(
        versions=tuple(versions),
        version_changes=tuple(changes),
        source=(
            "each campaign searched for its own cases; to run the same cases with both versions, "
            "use `merge-sumo rerun`"
        ),
        notes=tuple(notes),
    )


def compare_against(run: RecordedCampaign) -> Comparison | None:
    """Compare the VUT of a campaign with the earlier version of `--against`, in the same cases.

    Args:
        run: the campaign.

    Returns:
        The comparison; None for a campaign without an earlier version.
    """
    recorded = run.read_earlier()
    if recorded is None:
        return None
    # An interrupted campaign may have more cases of the earlier version.
    outcomes = recorded.outcomes[: len(run.outcomes)]
    earlier = replace(Version.of(recorded), outcomes=outcomes, tolerated=run.tolerated)
    source = f"both versions ran the same cases, chosen where only {run.vut} may fail"
    return of_two(earlier, Version.of(run), source)


def of_two(earlier: Version, later: Version, source: str) -> Comparison:
    """Return the comparison of two versions that ran the same cases.

    Args:
        earlier: the earlier version.
        later: the later version.
        source: a sentence on the origin of the cases.
    """
    return Comparison((earlier, later), (_version_change(2, earlier, later),), source)


def _check_comparable(a: RecordedCampaign, b: RecordedCampaign) -> None:
    differs = {
        "the scenario": a.scenario != b.scenario,
        "what counts as a failure": a.criterion != b.criterion,
        "the tolerated share of failing runs": a.tolerated != b.tolerated,
    }
    for level in sorted({*a.levels} & {*b.levels}):
        name = f"the POV of level {level_name(level)}"
        differs[name] = not same_pov(a.record, b.record, level)
    for name, is_different in differs.items():
        if is_different:
            raise UserError(
                f"{a.folder} and {b.folder} differ in {name}: choose campaigns that agree in it"
            )


def _version_change(number: int, earlier: Version, later: Version) -> VersionChange:
    """Return the changes to the version with a number from the one before it."""
    first, second = _by_start(earlier.outcomes), _by_start(later.outcomes)
    cases = []
    for start in first.keys() & second.keys():
        cases.append(ComparedCase.of(first[start], second[start], later.tolerated))
    found = VersionChange(number, in_order(cases))
    levels = earlier.summary.levels.keys() & later.summary.levels.keys()
    earlier_cases, later_cases = _at_levels(earlier, levels), _at_levels(later, levels)
    has_own = len(cases) < max(len(earlier_cases), len(later_cases))
    if has_own and earlier.sampler == later.sampler:
        return with_shares(found, earlier_cases, later_cases)
    return found


def _at_levels(version: Version, levels: Container[int]) -> list[Outcome]:
    """Return the deciding run of each case of some levels."""
    cases = one_per_case(version.outcomes, version.tolerated)
    return [outcome for outcome in cases if outcome.case.level in levels]


def with_shares(
    version_change: VersionChange, earlier: Sequence[Outcome], later: Sequence[Outcome]
) -> VersionChange:
    """Return a change of version with the test of the shares of cases that pass.

    Args:
        version_change: the change of version.
        earlier: outcomes of the earlier version, one for each case.
        later: outcomes of the later version.
    """
    shares = []
    for outcomes in (earlier, later):
        shares.append((sum(outcome.passes for outcome in outcomes), len(outcomes)))
    p_value = fisher(*shares)
    (passed, number), (later_passed, later_number) = shares
    is_less = later_passed * number < passed * later_number
    return replace(version_change, p_value=p_value, passes_less=is_less and p_value <= SIGNIFICANT)
