"""Several versions of a VUT in one page: what was found of each, and what changed between them.

All of it is read from the records of the campaigns: no code of a folder is run, and no case again.
What changed between neighbours is therefore told by regions (`history_steps.py`). `compare_runs`
runs failures again and knows more.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from merge_sumo.analysis.diagnosis import Kind, diagnose
from merge_sumo.analysis.result import Result
from merge_sumo.analysis.summary import severities_of
from merge_sumo.analysis.verdict import Verdict, in_words, judge
from merge_sumo.campaigns.run import SETTINGS, Run
from merge_sumo.errors import UserError
from merge_sumo.studies.avoidance import read_avoidance
from merge_sumo.studies.comparison import check_comparable
from merge_sumo.studies.counterfactuals import Avoidance
from merge_sumo.studies.history_steps import Became, Step, step_between
from merge_sumo.values.case import to_unit
from merge_sumo.values.fmc import fmc, regions
from merge_sumo.values.scenario import ALL_LEVELS, level_name
from merge_sumo.values.score import Outcome


@dataclass(frozen=True, slots=True)
class LevelOfVersion:
    """What was found of a version at one POV level.

    Attributes:
        cases: cases that ran.
        tested: those with a verdict.
        failures: those that failed.
        contacts: failures in which bodies touch.
        severities: cases by severity, those that occur.
        errors: cases that ended in an error.
        timeouts: cases in which the VUT never reached the merge point.
        fmc: failure mode coverage in the level's unit cube; None where nothing was tested.
        regions: groups of failures that are linked at the radius of FMC; None as well.
        kinds: failures by kind, of those under the paper's rule whose motion is there.
        avoidance_known: failures of which it is recorded who would have avoided them.
        avoided: those of them that a careful driver in the VUT's place would have avoided.
    """

    cases: int
    tested: int
    failures: int
    contacts: int
    severities: dict[str, int]
    errors: int
    timeouts: int
    fmc: float | None
    regions: int | None
    kinds: dict[Kind, int]
    avoidance_known: int
    avoided: int


@dataclass(frozen=True, slots=True)
class Version:
    """A campaign as one version of a VUT.

    Attributes:
        folder: of the campaign.
        vut: name of the VUT.
        sampler: that chose the cases.
        wanted: cases that the campaign was to run.
        verdict: on all of its cases.
        levels: by POV level.
    """

    folder: str
    vut: str
    sampler: str
    wanted: int | None
    verdict: Verdict
    levels: dict[int, LevelOfVersion]


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
        said = []
        for level in self.levels:
            known = [
                (number, found.fmc)
                for number, version in enumerate(self.versions, start=1)
                if (found := version.levels.get(level)) is not None and found.fmc is not None
            ]
            if len(known) > 1:
                (first, before), (last, after) = known[0], known[-1]
                said.append(
                    f"at POV level {level_name(level)} from {before:.4f} (version {first}) to "
                    f"{after:.4f} (version {last})"
                )
        if not said:
            return "No POV level was tested in two versions."
        return f"FMC went {in_words(said)}."

    def lines(self) -> list[str]:
        """Return what the command `history` prints."""
        said = [self.headline]
        for number, version in enumerate(self.versions, start=1):
            said.append(f"{number}: {version.folder} ({version.vut}): {version.verdict.counts}")
            said += version.verdict.trouble_lines()
        for step in self.steps:
            counts = [f"{n} {became}" for became in Became if (n := step.count(became))]
            said.append(
                f"from {step.before} to {step.after} at POV level {level_name(step.level)}: "
                f"{'regions: ' + ', '.join(counts) if counts else 'no failures in either'}"
            )
        return [*said, *self.notes]

    def to_record(self) -> dict[str, Any]:
        """Return it as JSON shows it."""
        return {
            "criterion": self.criterion,
            "scenario": self.scenario,
            "versions": [_version_record(version) for version in self.versions],
            "steps": [step.to_record() for step in self.steps],
            "notes": list(self.notes),
        }


def history_of(runs: Sequence[Run]) -> History:
    """Return the history of campaigns, the oldest first.

    Raises `UserError` for fewer than two, and where they differ in the scenario, the initial speed
    of the VUT, the criterion or, at a level, the POV: FMC of these is of different pools.
    """
    if len(runs) < 2:
        raise UserError("a history needs two campaigns or more: name the older one first")
    levels_of = [_levels(run) for run in runs]
    for run in runs[1:]:
        check_comparable(runs[0], run, ())
    levels = sorted(set().union(*levels_of))
    steps = []
    for level in levels:
        having = [number for number, has in enumerate(levels_of) if level in has]
        for before, after in pairwise(having):
            check_comparable(runs[before], runs[after], [level])
            steps.append(step_between(runs, before, after, level))
    return History(
        criterion=runs[0].criterion.text,
        scenario=runs[0].scenario.name,
        levels=tuple(levels),
        versions=tuple(_version(run, has) for run, has in zip(runs, levels_of, strict=True)),
        steps=tuple(steps),
        notes=tuple(_notes(runs, levels_of)),
    )


def _levels(run: Run) -> list[int]:
    levels = run.settings.get("levels")
    if not isinstance(levels, list) or any(level not in ALL_LEVELS for level in levels):
        raise UserError(f"{run.folder / SETTINGS} is no campaign's: it has no list of levels")
    return sorted({*levels, *(outcome.case.level for outcome in run.outcomes)})


def _notes(runs: Sequence[Run], levels_of: Sequence[Sequence[int]]) -> list[str]:
    """Return what limits the comparison, in sentences."""
    said = []
    if len({str([r.settings.get(k) for k in ("sampler", "cases")]) for r in runs}) > 1:
        said.append(
            "The campaigns differ in sampler or number of cases: FMC, failures and regions are "
            "what each of them found, and a longer search finds more."
        )
    if len({str(run.settings.get("net_sha256")) for run in runs}) > 1:
        said.append("The campaigns were not all run on the same net.")
    if any(list(has) != list(levels_of[0]) for has in levels_of):
        said.append(
            "Not every campaign has every POV level: at a level, a version is compared with the "
            "last one before it that has the level."
        )
    for number, run in enumerate(runs, start=1):
        wanted = run.settings.get("cases")
        if run.torn or (isinstance(wanted, int) and len(run.outcomes) < wanted):
            said.append(f"Campaign {number} ended after {len(run.outcomes)} of {wanted} cases.")
    return said


def _version(run: Run, levels: Sequence[int]) -> Version:
    known, wanted = read_avoidance(run), run.settings.get("cases")
    return Version(
        folder=str(run.folder),
        vut=run.vut,
        sampler=str(run.settings.get("sampler")),
        wanted=wanted if isinstance(wanted, int) else None,
        verdict=judge(run.outcomes),
        levels={level: _level(run, level, known) for level in levels},
    )


def _level(run: Run, level: int, known: dict[int, Avoidance]) -> LevelOfVersion:
    outcomes = [outcome for outcome in run.outcomes if outcome.case.level == level]
    found = judge(outcomes)
    failed = [outcome for outcome in outcomes if outcome.failed]
    points = to_unit((outcome.case for outcome in failed), level, run.scenario)
    kinds = Counter(kind for outcome in failed if (kind := _kind(run, outcome)) is not None)
    of_level = [known[outcome.index] for outcome in failed if outcome.index in known]
    tested = sum(outcome.is_tested for outcome in outcomes)
    return LevelOfVersion(
        cases=found.cases,
        tested=tested,
        failures=found.failures,
        contacts=found.contacts,
        severities=severities_of(outcomes),
        errors=found.errors,
        timeouts=found.timeouts,
        fmc=fmc(points) if tested else None,
        regions=int(regions(points).max(initial=-1)) + 1 if tested else None,
        kinds={kind: kinds[kind] for kind in Kind if kinds[kind]},
        avoidance_known=len(of_level),
        avoided=sum(one.by_careful for one in of_level),
    )


def _kind(run: Run, outcome: Outcome) -> Kind | None:
    """Return the kind of a failure; None where its motion is lost or it has none."""
    try:
        return diagnose(run.trajectory(outcome.index), outcome.measures).kind
    except UserError:
        return None


def _version_record(version: Version) -> dict[str, Any]:
    levels = {
        level_name(level): {
            name: getattr(found, name) for name in LevelOfVersion.__slots__ if name != "kinds"
        }
        | {"kinds": {kind.value: count for kind, count in found.kinds.items()}}
        for level, found in version.levels.items()
    }
    record = {"folder": version.folder, "vut": version.vut, "sampler": version.sampler}
    verdict = version.verdict
    counts = {"cases": verdict.cases, "failures": verdict.failures, **verdict.to_record()}
    return {**record, **counts, "levels": levels}
