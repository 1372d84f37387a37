"""Two campaigns side by side: what got fixed and what broke from VUT A to VUT B.

Two campaigns have different cases, so the failures of each are run again with the VUT of the other:
then both VUTs have been tried on the same cases, those with which at least one of them was seen to
fail. That a VUT is still the one of its campaign is checked first: it must give again the scores
that were recorded. Volumes are failure mode coverages of what is known by then.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from merge_sumo.case import Case, to_unit
from merge_sumo.conductor import MAX_CORRIDORS, ProvingGround, settings_of
from merge_sumo.errors import UserError
from merge_sumo.fmc import fmc
from merge_sumo.journal import SETTINGS, Run, failures
from merge_sumo.score import FAILURE_SCORE, Measures, Outcome, measure
from merge_sumo.sumo.net import Net

FIRST_LOOKS: Final = 10
CHECKED: Final = 32
"""Cases of a campaign, the worst, that its VUT must reproduce."""
SAME_SCORE: Final = 1e-6
VOLUME_NOISE: Final = 2e-4
"""Share of a volume in three dimensions that is rounding of the integral (see `fmc`)."""


class Change(StrEnum):
    """What became of a case from A to B."""

    FIXED = "fixed"
    BROKE = "broke"
    BOTH_FAIL = "both fail"
    NO_VERDICT = "no verdict"
    NOT_RUN_AGAIN = "not run again"


@dataclass(frozen=True, slots=True)
class ComparedCase:
    """A case in which at least one of the two VUTs failed.

    Attributes:
        run: "A" or "B", the campaign that has the case.
        index: its index there.
        case: the case.
        score_a: P of A; None where A gave no verdict or was not run.
        score_b: P of B.
        change: what became of it.
    """

    run: str
    index: int
    case: Case
    score_a: float | None
    score_b: float | None
    change: Change


@dataclass(frozen=True, slots=True)
class LevelChange:
    """What changed at a POV level; volumes in the level's unit cube.

    Attributes:
        fmc_a: coverage of the cases in which A is known to fail.
        fmc_b: the same of B.
        fmc_fixed: volume that A's failures cover and B's do not.
        fmc_broke: volume that B's failures cover and A's do not.
        changes: number of cases by what became of them.
    """

    fmc_a: float
    fmc_b: float
    fmc_fixed: float
    fmc_broke: float
    changes: dict[str, int]


@dataclass(frozen=True, slots=True)
class RunComparison:
    """What changed from campaign A to campaign B.

    Attributes:
        levels: by POV level.
        cases: every case in which one failed; what broke comes first, the worst of B first.
        evidence: how the verdicts of the other VUT came about, as a sentence.
    """

    levels: dict[int, LevelChange]
    cases: list[ComparedCase]
    evidence: str

    def is_worse(self, tolerance: float) -> bool:
        """Return whether B's coverage of failures exceeds A's by more than this at some level."""
        return any(
            level.fmc_b - level.fmc_a > tolerance + VOLUME_NOISE * level.fmc_b
            for level in self.levels.values()
        )

    def look_first(self) -> list[ComparedCase]:
        """Return the cases to look at first: those that broke, then those without a verdict."""
        telling = (Change.BROKE, Change.NO_VERDICT, Change.NOT_RUN_AGAIN)
        return [case for case in self.cases if case.change in telling][:FIRST_LOOKS]


def compare_runs(
    a: Run, b: Run, *, rerun: bool = True, net: Net | None = None, trust: bool = False
) -> RunComparison:
    """Compare two campaigns level by level.

    Args:
        a: campaign of the VUT before.
        b: campaign of the VUT after.
        rerun: run the failures of each with the VUT of the other.
        net: net for that; must be the one of the campaigns.
        trust: run the controllers that the folders name although they may be a stranger's.

    Raises `UserError` where the campaigns have no level in common, differ in the initial speed of
    the VUT, or were run on another net than the one to run again on.
    """
    levels = _common_levels(a, b)
    failing_a, failing_b = (
        [o for o in failures(run.outcomes) if o.case.level in levels] for run in (a, b)
    )
    again_a = again_b = _Again({}, "was not run again")
    if rerun:
        net = _common_net(a, b, net or Net())
        again_b = _run_again(b, failing_a, net, trust=trust)
        again_a = _run_again(a, failing_b, net, trust=trust)
    cases = [
        ComparedCase(
            "A",
            o.index,
            o.case,
            o.measures.score,
            *_became(again_b.measures.get(o.index), fails=Change.BOTH_FAIL, passes=Change.FIXED),
        )
        for o in failing_a
    ]
    for o in failing_b:
        score_a, change = _became(
            again_a.measures.get(o.index), fails=Change.BOTH_FAIL, passes=Change.BROKE
        )
        cases.append(ComparedCase("B", o.index, o.case, score_a, o.measures.score, change))
    cases.sort(key=_telling)
    return RunComparison(
        {level: _level(level, cases) for level in levels},
        cases,
        f"with the {len(failing_a)} failures of A, B {again_b.how}; "
        f"with the {len(failing_b)} failures of B, A {again_a.how}",
    )


def _common_levels(a: Run, b: Run) -> list[int]:
    named: list[set[int]] = []
    for run in (a, b):
        levels = run.settings.get("levels")
        if not isinstance(levels, list):
            raise UserError(f"{run.folder / SETTINGS} is no campaign's: it has no list of levels")
        named.append(set(levels))
    common = sorted(named[0] & named[1])
    if not common:
        raise UserError(f"{a.folder} and {b.folder} have no POV level in common")
    speeds = [run.settings.get("v_vut0_mps") for run in (a, b)]
    if speeds[0] != speeds[1]:
        raise UserError(
            f"the VUT starts at {speeds[0]} m/s in {a.folder} and at {speeds[1]} m/s in "
            f"{b.folder}: compare campaigns with the same --v-vut0"
        )
    return common


def _common_net(a: Run, b: Run, net: Net) -> Net:
    for run in (a, b):
        if run.settings.get("net_sha256") != net.sha256:
            raise UserError(
                f"{run.folder} was run on another net than {net.path}: give that with --net, or "
                "compare the records with --no-rerun"
            )
    return net


@dataclass(frozen=True, slots=True)
class _Again:
    """What a VUT made of the other one's failures, by index, and how that came about."""

    measures: dict[int, Measures]
    how: str


def _run_again(run: Run, failing: Sequence[Outcome], net: Net, *, trust: bool) -> _Again:
    """Run a campaign's VUT on the other campaign's failures, if it is still the same VUT."""
    told = [o for o in run.outcomes if o.measures.score is not None]
    told = sorted(told, key=lambda o: (o.measures.score, o.index))[:CHECKED]
    cases = [o.case for o in (*told, *failing)]
    if not failing:
        return _Again({}, "had nothing to run")
    measures: dict[int, Measures] = {}
    vut = settings_of(run.folder, run.settings, trust=trust).vut_factory
    with ProvingGround(vut, min(MAX_CORRIDORS, len(cases)), net) as ground:
        for place, trajectory in ground.run(cases):
            measures[place] = measure(trajectory)
    for place, outcome in enumerate(told):
        was, now = outcome.measures.score, measures[place].score
        if was is None or now is None or abs(was - now) > SAME_SCORE:
            return _Again(
                {},
                f"could not be run: its VUT does not do again what case {outcome.index} records",
            )
    first = len(told)
    return _Again({o.index: measures[first + n] for n, o in enumerate(failing)}, "was run again")


def _became(
    tried: Measures | None, *, fails: Change, passes: Change
) -> tuple[float | None, Change]:
    if tried is None:
        return None, Change.NOT_RUN_AGAIN
    if tried.score is None:
        return None, Change.NO_VERDICT
    return tried.score, fails if tried.score < FAILURE_SCORE else passes


def _telling(case: ComparedCase) -> tuple[int, float, str, int]:
    order = (
        Change.BROKE,
        Change.NO_VERDICT,
        Change.NOT_RUN_AGAIN,
        Change.BOTH_FAIL,
        Change.FIXED,
    )
    # Of what was not run again, B's cases may have broken, A's may be fixed.
    score = case.score_b if case.score_b is not None else 0.0
    return order.index(case.change), score, case.run, case.index


def _level(level: int, cases: Sequence[ComparedCase]) -> LevelChange:
    at_level = [case for case in cases if case.case.level == level]
    fails_a = [c.case for c in at_level if c.run == "A" or c.change is Change.BOTH_FAIL]
    fails_b = [c.case for c in at_level if c.run == "B" or c.change is Change.BOTH_FAIL]

    def volume(failing: Iterable[Case]) -> float:
        return fmc(to_unit(failing, level))

    fmc_a, fmc_b, either = volume(fails_a), volume(fails_b), volume(fails_a + fails_b)
    return LevelChange(
        fmc_a=fmc_a,
        fmc_b=fmc_b,
        fmc_fixed=max(either - fmc_b, 0.0),
        fmc_broke=max(either - fmc_a, 0.0),
        changes={
            change.value: sum(case.change is change for case in at_level) for change in Change
        },
    )
