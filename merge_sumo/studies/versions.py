"""Two versions of a VUT compared case by case: what got fixed, what broke, and whether B is worse.

Two campaigns have different cases, so `compare_runs` runs the failures, errors and timeouts of each
with the VUT of the other: then both VUTs have been tried on the same cases, those in which at least
one of them failed or gave no verdict. `rerun` runs the recorded cases of one campaign with a
changed VUT. `compare_against` reads a campaign that ran both versions in the same cases
(`campaigns/against.py`). All return a `RunComparison`; A is the version before, B the version
after. Volumes are failure mode coverages (FMC) of what is known of both.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from functools import partial
from itertools import chain
from operator import itemgetter
from typing import Any, Final

from merge_sumo.analysis.merging import MergeStatistics, merging_of
from merge_sumo.analysis.result import Result
from merge_sumo.analysis.verdict import judge
from merge_sumo.campaigns.against import earlier_run
from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.repeats import cause
from merge_sumo.campaigns.settings import CampaignSettings, controllers, same_pov, settings_of
from merge_sumo.campaigns.store import Run, failures
from merge_sumo.engine.evaluate import evaluate, open_simulators, workers_or_here
from merge_sumo.engine.plan import versions
from merge_sumo.engine.simulator import road_for
from merge_sumo.errors import UserError
from merge_sumo.studies.run_study import RunStudy
from merge_sumo.system.hashing import changed
from merge_sumo.system.printable import counted
from merge_sumo.values.case import Case, to_unit
from merge_sumo.values.chance import RunsOfCase, by_case, one_per_case
from merge_sumo.values.fmc import fmc
from merge_sumo.values.scenario import US23, level_name
from merge_sumo.values.score import Outcome
from merge_sumo.values.trajectory import End, Trajectory
from merge_sumo.vuts.registry import is_built_in

FIRST_LOOKS: Final = 10
"""Cases that are printed as those to look at first."""
MOST_CHANGED: Final = 40
"""Changed verdicts that are printed; `Rerun.changed` has all."""
CHECKED: Final = 32
"""Cases of a campaign, the worst, that its VUT must reproduce before it runs others."""
SAME_SCORE: Final = 1e-6
"""Difference of two scores P that is rounding."""
VOLUME_NOISE: Final = 2e-4
"""Share of a volume in three dimensions that is rounding of the integral (see `fmc`)."""
SHARE_ROUNDING: Final = 1e-9
SIGNIFICANT: Final = 0.05
"""Chance of the runs of a case in equal versions, up to which a change is none of chance."""


class Change(StrEnum):
    """What became of a case from A to B; an error or a timeout is no verdict.

    A case whose runs are not alike may fail with one and pass with the other by chance: it is
    `WITHIN_CHANCE` where Fisher's exact test does not tell the shares of failing runs apart.
    """

    FIXED = "fixed"
    BROKE = "broke"
    BOTH_FAIL = "both fail"
    NO_VERDICT_OF_A = "no verdict of A"
    NO_VERDICT_OF_B = "no verdict of B"
    NO_VERDICT = "no verdict"
    NOT_RUN_AGAIN = "not run again"
    WITHIN_CHANCE = "within chance"


MOST_TELLING: Final = (
    *(Change.BROKE, Change.NO_VERDICT_OF_B, Change.NOT_RUN_AGAIN),
    *(Change.NO_VERDICT, Change.WITHIN_CHANCE, Change.BOTH_FAIL),
    *(Change.NO_VERDICT_OF_A, Change.FIXED),
)
"""The order in which cases are listed; those of the first three are to be looked at."""


@dataclass(frozen=True, slots=True)
class ComparedCase:
    """A case and its outcomes with both VUTs.

    Attributes:
        run: "A" or "B", the campaign that has the case.
        index: its index there.
        a: its outcome with A; None where A was not run. One of the two is known.
        b: its outcome with B.
        runs_a: its runs with A, of which `a` is the deciding one; None for a single one.
        runs_b: its runs with B.
    """

    run: str
    index: int
    a: Outcome | None
    b: Outcome | None
    runs_a: RunsOfCase | None = None
    runs_b: RunsOfCase | None = None

    @property
    def case(self) -> Case:
        """The case."""
        known = self.a or self.b
        assert known is not None, "a run has the case"  # noqa: S101
        return known.case

    @property
    def change(self) -> Change:
        """What became of a case in which A or B failed or gave no verdict."""
        a, b = self.a, self.b
        if a is None or b is None:
            return Change.NOT_RUN_AGAIN
        if not (a.is_tested and b.is_tested):
            silent = {
                (False, True): Change.NO_VERDICT_OF_A,
                (True, False): Change.NO_VERDICT_OF_B,
                (False, False): Change.NO_VERDICT,
            }
            return silent[a.is_tested, b.is_tested]
        if a.failed and b.failed:
            return Change.BOTH_FAIL
        if self.chance is not None and self.chance > SIGNIFICANT:
            return Change.WITHIN_CHANCE
        return Change.BROKE if b.failed else Change.FIXED

    @property
    def chance(self) -> float | None:
        """The chance of shares of failing runs as different as these, or more, in equal versions.

        By Fisher's exact test; None where the runs with each version are alike.
        """
        runs = [one for one in (self.runs_a, self.runs_b) if one is not None]
        if len(runs) < 2 or not any(one.varies for one in runs):
            return None
        from scipy.stats import fisher_exact

        table = [[one.failures, one.runs - one.failures] for one in runs]
        return float(fisher_exact(table)[1])

    @property
    def became(self) -> str:
        """What it was and is in words; where these are the same, which of them is a failure."""
        if self.chance is not None and self.runs_a is not None and self.runs_b is not None:
            shares = f"{self.runs_a.in_words} -> {self.runs_b.in_words}"
            return f"{shares}, by Fisher's exact test p = {self.chance:.2g}"
        both = [outcome for outcome in (self.a, self.b) if outcome is not None]
        words = [outcome.measures.became for outcome in both]
        if len(set(words)) == 1:
            words = [f"{words[0]}, {'a failure' if o.failed else 'no failure'}" for o in both]
        return " -> ".join(words)

    def rank(self) -> tuple[int, float, str, int]:
        """Return the sort key: what broke comes first, the worst of B first."""
        # Of what was not run again, B's cases may have broken, A's may be fixed.
        score = None if self.b is None else self.b.score
        return MOST_TELLING.index(self.change), score or 0.0, self.run, self.index

    def to_record(self, a: str = "a", b: str = "b") -> dict[str, Any]:
        """Return change, scores, ends and severities as JSON shows them, with names for A and B."""
        record: dict[str, Any] = {"index": self.index, "change": self.change}
        for name, outcome in ((a, self.a), (b, self.b)):
            measures = None if outcome is None else outcome.measures
            record[f"score_{name}"] = None if outcome is None else outcome.score
            record[f"end_{name}"] = None if measures is None else measures.end
            record[f"severity_{name}"] = None if measures is None else measures.severity
        for name, runs in ((a, self.runs_a), (b, self.runs_b)):
            if runs is not None:
                record |= {f"runs_{name}": runs.runs, f"failed_runs_{name}": runs.failures}
        return record


@dataclass(frozen=True, slots=True)
class Untested:
    """Cases at a level in which a VUT did not reach the merge point.

    Attributes:
        cases: cases that were looked at: those of both campaigns where both VUTs were run again,
            else those of its own.
        errors: that ended in an error.
        timeouts: in which it never reached the merge point.
        nothing_tested: whether its own campaign has cases at this level, and none was tested.
    """

    cases: int
    errors: int
    timeouts: int
    nothing_tested: bool = False

    def share(self, number: int) -> float:
        """Return a number of the cases as a share of them."""
        return number / self.cases if self.cases else 0.0


@dataclass(frozen=True, slots=True)
class LevelChange:
    """What changed at a POV level; volumes in the level's unit cube.

    Attributes:
        untested_a: cases without a verdict of A.
        untested_b: the same of B.
        fmc_a: coverage of the cases in which A is known to fail.
        fmc_b: the same of B.
        fmc_fixed: volume that A's failures cover and B's do not; failures on which B gives no
            verdict are not fixed.
        fmc_broke: volume that B's failures cover and A's do not, in the same way.
        changes: number of cases by what became of them.
    """

    untested_a: Untested
    untested_b: Untested
    fmc_a: float
    fmc_b: float
    fmc_fixed: float
    fmc_broke: float
    changes: dict[str, int]

    def worse(self, level: int, tolerance: float, goal: str) -> list[str]:
        """Return in sentences why B is worse than A at this level; a VUT is to reach `goal`."""
        at, a, b = f"at POV level {level_name(level)}", self.untested_a, self.untested_b
        reasons = []
        if b.nothing_tested:
            reasons.append(f"{at} B reached {goal} in no case of its campaign")
        for what, number_a, number_b in (
            ("error", a.errors, b.errors),
            ("error or timeout", a.errors + a.timeouts, b.errors + b.timeouts),
        ):
            if b.share(number_b) - a.share(number_a) > tolerance + SHARE_ROUNDING:
                reasons.append(
                    f"{at} B has an {what} in {number_b} of {counted(b.cases, 'case')}, "
                    f"A in {number_a} of {a.cases}"
                )
        if self.fmc_b - self.fmc_a > tolerance + VOLUME_NOISE * self.fmc_b:
            reasons.append(f"{at} FMC is {self.fmc_b:.4f} with B, {self.fmc_a:.4f} with A")
        return reasons


@dataclass(frozen=True, slots=True, repr=False)
class RunComparison(Result):
    """What changed from A to B.

    Attributes:
        levels: by POV level.
        cases: every case in which one failed or gave no verdict, as `ComparedCase.rank` orders.
        evidence: how the verdicts of the other VUT came about, as a sentence.
        goal: what a VUT is to reach.
        merging: merges of A and of B from an acceleration lane in their own cases, by "A" and "B";
            empty without a lane.
    """

    levels: dict[int, LevelChange]
    cases: list[ComparedCase]
    evidence: str
    goal: str = US23.goal
    merging: Mapping[str, MergeStatistics] = field(default_factory=dict)

    def worse(self, tolerance: float) -> list[str]:
        """Return in sentences why B is worse than A by more than the tolerance, if it is."""
        return [
            reason
            for level, change in self.levels.items()
            for reason in change.worse(level, tolerance, self.goal)
        ]

    def judgement(self, tolerance: float) -> str:
        """Return whether B is worse than A, by what, and how many cases broke all the same."""
        if self.worse(tolerance):
            return f"worse than A, with a tolerance of {tolerance:g}"
        broke = sum(case.change is Change.BROKE for case in self.cases)
        broken = f"; {counted(broke, 'case')} broke all the same" if broke else ""
        return (
            "not worse than A: FMC and the share of cases without a verdict grow at no level by "
            f"more than {tolerance:g}{broken}"
        )

    def to_record(self) -> dict[str, Any]:
        """Return what `--json` prints."""
        cases = [
            {"run": one.run, "case": asdict(one.case), **one.to_record()} for one in self.cases
        ]
        levels = {level: asdict(change) for level, change in self.levels.items()}
        merging = {name: asdict(found) for name, found in self.merging.items()}
        more = {"merging": merging} if merging else {}
        return {"levels": levels, "cases": cases, "evidence": self.evidence, **more}

    @property
    def named_changes(self) -> list[Change]:
        """The changes that tables name: chance only where it is in some case."""
        known = {name for of_level in self.levels.values() for name in of_level.changes}
        return [change for change in Change if change in known or change != Change.WITHIN_CHANCE]

    def lines(self) -> list[str]:
        """Return a table of what changed, level by level, and how that is known."""
        shown = self.named_changes
        table = [
            f"{'level':<6} {'FMC A':>8} {'FMC B':>8} {'fixed':>8} {'broke':>8}   "
            f"cases: {', '.join(shown)}"
        ]
        for level, of_level in self.levels.items():
            changes = ", ".join(str(of_level.changes.get(change, 0)) for change in shown)
            table.append(
                f"{level_name(level):<6} {of_level.fmc_a:8.4f} {of_level.fmc_b:8.4f} "
                f"{of_level.fmc_fixed:8.4f} {of_level.fmc_broke:8.4f}   {changes}"
            )
        merging = (f"{name} {found.sentence}" for name, found in self.merging.items())
        return [*table, *merging, f"evidence: {self.evidence}"]

    def __repr__(self) -> str:
        levels = (
            f"level {level_name(level)}: FMC {change.fmc_a:.4f} -> {change.fmc_b:.4f}"
            for level, change in self.levels.items()
        )
        return f"<RunComparison: {', '.join(levels)}>"

    def look_first(self) -> list[ComparedCase]:
        """Return the cases to look at first: those that broke, then those without a verdict."""
        return [case for case in self.cases if case.change in MOST_TELLING[:3]][:FIRST_LOOKS]


def _level_change(
    cases: Sequence[ComparedCase],
    own_a: Sequence[Outcome],
    own_b: Sequence[Outcome],
    level: int,
    *,
    same_cases: bool = False,
    records_only: bool = False,
) -> LevelChange:
    """Return what changed at a level.

    `cases` are the compared ones of the level, `own_a` and `own_b` all outcomes of the campaigns
    there: `same_cases` where those of B are those of A, run again, `records_only` where none was to
    run again.
    """
    fails_a = [c.case for c in cases if c.a is not None and c.a.failed]
    fails_b = [c.case for c in cases if c.b is not None and c.b.failed]
    # Where one fails and the other gives no verdict, or could not be run, nothing is known to be
    # fixed and nothing to be broken. Records alone are compared as they are.
    silent = {Change.NO_VERDICT_OF_A, Change.NO_VERDICT_OF_B, Change.WITHIN_CHANCE}
    silent |= set() if records_only else {Change.NOT_RUN_AGAIN}
    unknown = [
        c.case for c in cases if c.change in silent and any(o and o.failed for o in (c.a, c.b))
    ]
    # Both VUTs were tried on the same cases: the others of both campaigns raise no question.
    shared = all(case.change is not Change.NOT_RUN_AGAIN for case in cases)
    together = len(own_a) + (0 if same_cases else len(own_b))

    def untested(run: str, own: Sequence[Outcome]) -> Untested:
        tried = cases if shared else [c for c in cases if c.run == run]
        outcomes = [c.a if run == "A" else c.b for c in tried]
        ends = Counter(o.measures.end for o in outcomes if o is not None and not o.failed)
        return Untested(
            cases=together if shared else len(own),
            errors=ends[End.VUT_ERROR] + ends[End.SIM_ERROR],
            timeouts=ends[End.TIMEOUT],
            nothing_tested=bool(own) and not any(outcome.is_tested for outcome in own),
        )

    def volume(failing: Iterable[Case]) -> float:
        return fmc(to_unit(failing, level))

    fmc_a, fmc_b, either = volume(fails_a), volume(fails_b), volume(fails_a + fails_b)
    return LevelChange(
        untested_a=untested("A", own_a),
        untested_b=untested("B", own_b),
        fmc_a=fmc_a,
        fmc_b=fmc_b,
        fmc_fixed=max(either - volume(fails_b + unknown), 0.0),
        fmc_broke=max(either - volume(fails_a + unknown), 0.0),
        changes=_counts(cases),
    )


def _counts(cases: Sequence[ComparedCase]) -> dict[str, int]:
    """Return how many cases changed how; chance is named where it is in them."""
    counts = Counter(case.change for case in cases)
    named = [change for change in Change if counts[change] or change != Change.WITHIN_CHANCE]
    return {change.value: counts[change] for change in named}


def _comparison(
    cases: Iterable[ComparedCase],
    own_a: Sequence[Outcome],
    own_b: Sequence[Outcome],
    levels: Iterable[int],
    evidence: str,
    **known: bool,
) -> RunComparison:
    """Return the comparison of cases at some levels; the keywords are those of `_level_change`."""
    ranked = sorted(cases, key=ComparedCase.rank)
    by_level = {
        level: _level_change(
            [case for case in ranked if case.case.level == level],
            [outcome for outcome in own_a if outcome.case.level == level],
            [outcome for outcome in own_b if outcome.case.level == level],
            level,
            **known,
        )
        for level in levels
    }
    own = {"A": own_a, "B": own_b}
    merging = {name: found for name, ran in own.items() if (found := merging_of(ran))}
    goal = next((outcome.case.scenario.goal for outcome in own_a), US23.goal)
    return RunComparison(by_level, ranked, evidence, goal, merging)


# Two campaigns: the telling cases of each, run again with the VUT of the other.


OnMotion = Callable[[str, int, Trajectory], None]
"""Told of a motion with the campaign of its case, "A" or "B", and the index of that case there."""


def compare_runs(
    a: Run,
    b: Run,
    *,
    rerun: bool = True,
    given: tuple[Mapping[str, object], Mapping[str, object]] = ({}, {}),
    on_motion: OnMotion = lambda _run, _index, _trajectory: None,
) -> RunComparison:
    """Compare the campaigns of two VUTs, A before and B after, level by level.

    That a VUT is still the one of its campaign is checked first: it must give again the scores that
    were recorded. Raises `UserError` where the campaigns do not compare.

    Args:
        a: campaign of A.
        b: campaign of B.
        rerun: run the failures, errors and timeouts of each with the VUT of the other.
        given: settings of A and of B in the place of what their folders name: policies that are
            elsewhere, controllers that are code.
        on_motion: told what a VUT did in a case of the other's campaign.
    """
    levels = sorted(set(a.levels) & set(b.levels))
    if not levels:
        raise UserError(f"{a.folder} and {b.folder} have no POV level in common")
    check_comparable(a, b, levels)
    own_a, own_b = ([o for o in run.cases if o.case.level in levels] for run in (a, b))
    for run, own in ((a, own_a), (b, own_b)):
        if not own:
            raise UserError(f"{run.folder} has no case at a POV level of both: it shows nothing")
    telling_a, telling_b = (
        [*failures(own), *(o for o in own if not o.is_tested)] for own in (own_a, own_b)
    )
    again_a = again_b = _RunAgain("was not run again")
    if rerun:
        road = road_for(a.scenario)
        for run in (a, b):
            if run.settings.get("net_sha256") != road.sha256:
                raise UserError(
                    f"{run.folder} was run on another net than {road.path} is now: put that "
                    "back, or compare the records with --no-rerun"
                )
        again_b = _run_again(b, a, telling_a, given[1], partial(on_motion, "A"))
        again_a = _run_again(a, b, telling_b, given[0], partial(on_motion, "B"))
    runs_a, runs_b = (_repeated(run.outcomes) for run in (a, b))
    cases = [
        *(
            ComparedCase("A", o.index, o, again_b.outcomes.get(o.index), *pair)
            for o in telling_a
            for pair in [(runs_a.get(o.case.start), again_b.runs.get(o.case.start))]
        ),
        *(
            ComparedCase("B", o.index, again_a.outcomes.get(o.index), o, *pair)
            for o in telling_b
            for pair in [(again_a.runs.get(o.case.start), runs_b.get(o.case.start))]
        ),
    ]
    evidence = (
        f"with {_in_words(own_a)} of A, B {again_b.how}; "
        f"with {_in_words(own_b)} of B, A {again_a.how}"
    )
    return _comparison(cases, own_a, own_b, levels, evidence, records_only=not rerun)


def check_comparable(a: Run, b: Run, levels: Iterable[int]) -> None:
    """Raise `UserError` where campaigns asked different things, or met other POVs at a level."""
    if a.scenario != b.scenario:
        raise UserError(
            f"{a.folder} is of the scenario {a.scenario.name} and {b.folder} of another or a "
            f"changed one, {b.scenario.name}: compare campaigns of one scenario"
        )
    if a.criterion != b.criterion:
        raise UserError(
            f"a case of {a.folder} fails when {a.criterion.text}, and one of {b.folder} when "
            f"{b.criterion.text}: compare campaigns with the same --fail-when"
        )
    if a.tolerated != b.tolerated:
        raise UserError(
            f"{a.folder} tolerates {a.tolerated:g} of the runs of a case and {b.folder} "
            f"{b.tolerated:g}: compare campaigns with the same --tolerate"
        )
    for level in levels:
        if not same_pov(a.settings, b.settings, level):
            raise UserError(
                f"the POV of level {level_name(level)} is another in {a.folder} than in "
                f"{b.folder}: compare campaigns with the same --policies and --pov"
            )


def _in_words(own: Iterable[Outcome]) -> str:
    """Return in words which cases of a campaign are run again."""
    verdict = judge(own)
    text = f"the {counted(verdict.failures, 'failure')}"
    if verdict.errors or verdict.timeouts:
        text += f", {counted(verdict.errors, 'error')} and {counted(verdict.timeouts, 'timeout')}"
    return text


@dataclass(frozen=True, slots=True)
class _RunAgain:
    """How a VUT was run in the other one's telling cases, and the outcomes by index.

    `runs` has the cases that ran several times, by their start.
    """

    how: str
    outcomes: dict[int, Outcome] = field(default_factory=dict)
    runs: dict[Case, RunsOfCase] = field(default_factory=dict)


def _repeated(outcomes: Iterable[Outcome]) -> dict[Case, RunsOfCase]:
    """Return the cases that ran several times by their start."""
    return {one.case: one for one in by_case(outcomes) if one.runs > 1}


def _run_again(
    run: Run,
    other: Run,
    telling: Sequence[Outcome],
    given: Mapping[str, object],
    on_motion: Callable[[int, Trajectory], None],
) -> _RunAgain:
    """Run a campaign's VUT in the other's telling cases, if it is still the same VUT.

    A case runs with as many draws as it has there. Where chance decides, the same files are the
    same VUT, as the same score need not be.
    """
    if not telling:
        return _RunAgain("had nothing to run")
    unnamed = controllers({**run.settings, "against": None}).keys() - given.keys()
    if unnamed:
        return _RunAgain("was not run again, as a run folder names no code to run")
    scored = [o for o in run.outcomes if o.score is not None]
    checked = sorted(scored, key=lambda o: (o.score, o.index))[:CHECKED]
    repeated = _repeated(other.outcomes)
    draws = [[o.case for o in _runs_of(o, repeated)] for o in telling]
    cases = [*(o.case for o in checked), *chain.from_iterable(draws)]
    settings = settings_of(run.folder, run.settings, given)
    plan = resolve(settings).for_cases(len(cases))
    shows_chance = any(one.varies for one in _repeated(run.outcomes).values())
    results = [result for _, result in sorted(evaluate(plan, cases), key=itemgetter(0))]
    for before, result in zip(checked, results, strict=False):
        now = result.outcome(before.index)
        if shows_chance and _same_vut(run, settings):
            break
        if before.score is None or now.score is None or abs(before.score - now.score) > SAME_SCORE:
            return _RunAgain(
                "could not be run: its VUT or its POV does not do again what case "
                f"{before.index} records"
            )
    again, ran = _RunAgain("was run again"), iter(results[len(checked) :])
    for one, of_case in zip(telling, draws, strict=True):
        of_runs = [next(ran) for _ in of_case]
        outcomes = [result.outcome(one.index) for result in of_runs]
        deciding = one_per_case(outcomes, run.tolerated)[0]
        place = next(n for n, outcome in enumerate(outcomes) if outcome.case == deciding.case)
        on_motion(one.index, of_runs[place].trajectory)
        again.outcomes[one.index] = deciding
        again.runs.update(_repeated(outcomes))
    return again


def _runs_of(one: Outcome, repeated: Mapping[Case, RunsOfCase]) -> Sequence[Outcome]:
    """Return the runs of the case of an outcome."""
    known = repeated.get(one.case.start)
    return (one,) if known is None else known.outcomes


# One campaign of both versions, which ran the same cases.


def compare_against(run: Run) -> RunComparison | None:
    """Return what changed to a campaign's VUT from the version that the campaign is against.

    A is that version, B the VUT; both ran all cases. None where the campaign is against none.
    """
    earlier = earlier_run(run)
    if earlier is None:
        return None
    before = earlier.outcomes[: len(run.outcomes)]
    cases = _telling(before, run.outcomes, "B")
    evidence = f"both ran the same {counted(len(before), 'case')}"
    return _comparison(cases, before, run.outcomes, run.levels, evidence, same_cases=True)


def _telling(
    before: Sequence[Outcome], after: Sequence[Outcome], run: str, tolerated: float = 0.0
) -> list[ComparedCase]:
    """Return the same cases of A and B in which one failed or gave no verdict."""
    runs: dict[tuple[Case, int], list[tuple[Outcome, Outcome]]] = {}
    repeated = {outcome.case.start for outcome in before if outcome.case.draw}
    for a, b in zip(before, after, strict=True):
        # A case without repeats may be there twice.
        number = 0 if a.case.start in repeated else a.index
        runs.setdefault((a.case.start, number), []).append((a, b))
    cases = []
    for (start, _), pairs in runs.items():
        both = [list(of) for of in zip(*pairs, strict=True)]
        a, b = (one_per_case(of, tolerated)[0] for of in both)
        known = [_repeated(of).get(start) for of in both]
        if any(outcome.failed or not outcome.is_tested for outcome in (a, b)):
            cases.append(ComparedCase(run, pairs[0][0].index, a, b, *known))
    return cases


# One campaign: its recorded cases with a changed VUT.


@dataclass(frozen=True, slots=True, repr=False)
class Rerun(Result):
    """Recorded cases and what the VUT of today makes of them.

    Attributes:
        vut: name of that VUT.
        before: the recorded outcomes.
        after: those of today, in the same order, with the same indices.
        compared: what changed, as in `compare_runs`: A is what was recorded, B is today's.
        unrepeated: indices of the cases that did not go as before although the VUT is the same, by
            its name, its command and its files; empty where it is another one.
    """

    vut: str
    before: list[Outcome]
    after: list[Outcome]
    compared: RunComparison
    unrepeated: tuple[int, ...] = ()

    @property
    def changed(self) -> list[ComparedCase]:
        """The cases whose verdict changed, in the order of the campaign."""
        if any(outcome.case.draw for outcome in self.before):
            others = (Change.BOTH_FAIL, Change.WITHIN_CHANCE, Change.NO_VERDICT)
            known = (case for case in self.compared.cases if case.change not in others)
            return sorted(known, key=lambda case: case.index)
        return [
            ComparedCase("A", a.index, a, b)
            for a, b in zip(self.before, self.after, strict=True)
            if (a.measures.end, a.failed) != (b.measures.end, b.failed)
        ]

    def to_record(self) -> dict[str, Any]:
        """Return what `--json` prints."""
        return {
            "vut": self.vut,
            "cases": len(self.before),
            "changed": [
                {"level": one.case.level, **one.to_record("before", "after")}
                for one in self.changed
            ],
            "levels": self.compared.to_record()["levels"],
            "unrepeated": self.unrepeated,
        }

    def lines(self) -> list[str]:
        """Return both verdicts, and which cases changed theirs."""
        now, changed = judge(self.after), self.changed
        text = [f"recorded:  {judge(self.before).counts}", f"now:       {now.counts} ({self.vut})"]
        text += now.trouble_lines()
        if self.unrepeated:
            text.append(
                f"{len(self.unrepeated)} of {counted(len(self.after), 'case')} went differently, "
                f"and no file of the VUT has changed (the first is case {self.unrepeated[0]}). "
                f"{cause()}."
            )
        if not changed:
            return [*text, "no verdict changed"]
        text.append(
            f"{len(changed)} verdicts changed:" if len(changed) > 1 else "one verdict changed:"
        )
        for one in changed[:MOST_CHANGED]:
            change = one.change.replace("of A", "before").replace("of B", "now")
            text.append(f"  case {one.index}: {one.became} ({change})")
        if len(changed) > MOST_CHANGED:
            text.append(f"  and {len(changed) - MOST_CHANGED} others")
        return text


def settings_today(run: Run, given: Mapping[str, object] | None = None) -> CampaignSettings:
    """Return the settings of a campaign with what is given in the place of what it recorded.

    A VUT that is not given is that of the campaign, as its files are today (`settings_of`).
    """
    return settings_of(run.folder, run.settings, given)


def rerun(study: RunStudy, indices: Sequence[int] = ()) -> Rerun:
    """Run cases of a campaign again, by default all, with `settings_today` and their plan.

    Raises `UserError` for an index without a case, and where net or POV are not the campaign's:
    then not only the VUT would have changed.
    """
    run, settings, plan = study.run, study.settings, study.plan
    before = [run.outcome(index) for index in dict.fromkeys(indices)] or run.outcomes
    if not before:
        raise UserError(f"{run.folder} has no case yet")
    road = plan.road
    if run.settings.get("net_sha256", road.sha256) != road.sha256:
        raise UserError(
            f"{run.folder} was run on another net than {road.path} is now: put that back"
        )
    levels = sorted({outcome.case.level for outcome in before})
    today = study.record()
    for level in levels:
        if not same_pov(run.settings, today, level):
            raise UserError(
                f"{run.folder} was run against another POV of level {level_name(level)} than "
                "today's: give its --policies"
            )
    # In another order than the campaign's, which a VUT that remembers would repeat.
    order, by_index = before[::-1], dict[int, Outcome]()
    with workers_or_here(study.workers) as processes:
        plan = plan.for_cases(len(before))
        open_simulators(plan, processes)
        for place, now in evaluate(plan, [outcome.case for outcome in order], processes):
            old = order[place]
            by_index[old.index] = now.outcome(old.index, old.batch)
            study.on_cases(1)
    after = [by_index[outcome.index] for outcome in before]
    evidence = f"{counted(len(before), 'case')} ran again"
    share = run.tolerated
    own = one_per_case(before, share), one_per_case(after, share)
    telling = _telling(before, after, "A", share)
    compared = _comparison(telling, *own, levels, evidence, same_cases=True)
    unrepeated = _unrepeated(before, after) if _same_vut(run, settings) else ()
    return Rerun(settings.vut, before, after, compared, unrepeated)


def _same_vut(run: Run, settings: CampaignSettings) -> bool:
    """Return whether a VUT that is not of the package is the one that was recorded."""
    recorded, files = run.settings, run.settings.get("vut_files")
    return (
        not is_built_in(settings.vut)
        and settings.vut == recorded.get("vut")
        and recorded.get("versions") == versions()
        and isinstance(files, dict)
        and not changed(files)
    )


def _unrepeated(before: Sequence[Outcome], after: Sequence[Outcome]) -> tuple[int, ...]:
    """Return the indices of the cases that did not go as before, except those with an error."""

    def motion(outcome: Outcome) -> tuple[object, ...]:
        found = outcome.measures
        return found.end, found.t_end_s, found.dx_m, found.dv_mps, found.clipped_steps

    return tuple(
        a.index
        for a, b in zip(before, after, strict=True)
        if not (a.measures.end.is_error or b.measures.end.is_error) and motion(a) != motion(b)
    )
