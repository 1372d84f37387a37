"""Two campaigns side by side: what got fixed and what broke from VUT A to VUT B.

Two campaigns have different cases, so the failures, errors and timeouts of each are run again with
the VUT of the other: then both VUTs have been tried on the same cases, those with which at least
one of them was seen to fail or to give no verdict. That a VUT is still the one of its campaign is
checked first: it must give again the scores that were recorded.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

from merge_sumo.analysis.verdict import Verdict, counted, judge
from merge_sumo.campaigns.plan import plan_of
from merge_sumo.campaigns.run import SETTINGS, Run, failures
from merge_sumo.campaigns.settings import same_pov, settings_of
from merge_sumo.engine.simulator import road_for
from merge_sumo.errors import UserError
from merge_sumo.road.centre_lines import centre_lines
from merge_sumo.road.corridor import Corridor
from merge_sumo.studies.changes import Change, ComparedCase, LevelChange, RunComparison, Untested
from merge_sumo.values.case import Case, to_unit
from merge_sumo.values.fmc import fmc
from merge_sumo.values.scenario import level_name
from merge_sumo.values.score import FAILURE_SCORE, Outcome
from merge_sumo.values.trajectory import End, Trajectory

CHECKED: Final = 32
"""Cases of a campaign, the worst, that its VUT must reproduce."""
SAME_SCORE: Final = 1e-6

OnAgain = Callable[[str, int, Trajectory], None]
"""Told of a motion with the campaign of its case, "A" or "B", and the index of that case there."""


def compare_runs(
    a: Run,
    b: Run,
    *,
    rerun: bool = True,
    net: Corridor | None = None,
    given: Mapping[str, object] | None = None,
    trust: bool = False,
    on_again: OnAgain = lambda _run, _index, _trajectory: None,
) -> RunComparison:
    """Compare two campaigns level by level.

    Args:
        a: campaign of the VUT before.
        b: campaign of the VUT after.
        rerun: run the failures, errors and timeouts of each with the VUT of the other.
        net: net for that; must be the one of the campaigns.
        given: settings in the place of what the folders name: policies that are elsewhere.
        trust: run the controllers that the folders name although they may be a stranger's.
        on_again: told of what a VUT did in a case of the other's campaign, "A" or "B".

    Raises `UserError` where the campaigns have no level in common or no case there, differ in
    the initial speed of the VUT or in the POV of a level, or were run on another net than the one
    to run again on.
    """
    levels = _common_levels(a, b)
    own_a, own_b = ([o for o in run.outcomes if o.case.level in levels] for run in (a, b))
    for run, own in ((a, own_a), (b, own_b)):
        if not own:
            raise UserError(f"{run.folder} has no case at a POV level of both: it shows nothing")
    telling_a, telling_b = (
        [*failures(own), *(o for o in own if not o.is_tested)] for own in (own_a, own_b)
    )
    again_a = again_b = _Again({}, "was not run again")
    if rerun:
        net = _common_net(a, b, net or road_for(a.scenario))
        again_b = _run_again(b, telling_a, net, given, partial(on_again, "A"), trust=trust)
        again_a = _run_again(a, telling_b, net, given, partial(on_again, "B"), trust=trust)
    cases = [
        *(compared_case("A", o, o, again_b.outcomes.get(o.index)) for o in telling_a),
        *(compared_case("B", o, again_a.outcomes.get(o.index), o) for o in telling_b),
    ]
    cases.sort(key=telling)
    return RunComparison(
        {
            level: level_change(level, cases, own_a, own_b, records_only=not rerun)
            for level in levels
        },
        cases,
        f"with {_what(own_a)} of A, B {again_b.how}; with {_what(own_b)} of B, A {again_a.how}",
    )


def _what(own: Sequence[Outcome]) -> str:
    """Return in words what of a campaign is run again."""
    found = judge(own)
    text = f"the {counted(found.failures, 'failure')}"
    if found.errors or found.timeouts:
        text += f", {counted(found.errors, 'error')} and {counted(found.timeouts, 'timeout')}"
    return text


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
    check_comparable(a, b, common)
    return common


def check_comparable(a: Run, b: Run, levels: Iterable[int]) -> None:
    """Raise `UserError` where campaigns asked different things, or met other POVs at a level."""
    if a.scenario != b.scenario:
        raise UserError(
            f"{a.folder} is of the scenario {a.scenario.name} and {b.folder} of another or a "
            f"changed one, {b.scenario.name}: compare campaigns of one scenario"
        )
    speeds = [run.settings.get("v_vut0_mps") for run in (a, b)]
    if speeds[0] != speeds[1]:
        raise UserError(
            f"the VUT starts at {speeds[0]} m/s in {a.folder} and at {speeds[1]} m/s in "
            f"{b.folder}: compare campaigns with the same --v-vut0"
        )
    if a.criterion != b.criterion:
        raise UserError(
            f"a case of {a.folder} fails when {a.criterion.text}, and one of {b.folder} when "
            f"{b.criterion.text}: compare campaigns with the same --fail-when"
        )
    for level in levels:
        if not same_pov(a.settings, b.settings, level):
            raise UserError(
                f"the POV of level {level_name(level)} is another in {a.folder} than in "
                f"{b.folder}: compare campaigns with the same --policies and --pov"
            )


def _common_net(a: Run, b: Run, net: Corridor) -> Corridor:
    for run in (a, b):
        if run.settings.get("net_sha256") != net.sha256:
            raise UserError(
                f"{run.folder} was run on another net than {net.path}: give that with --net, or "
                "compare the records with --no-rerun"
            )
    return net


@dataclass(frozen=True, slots=True)
class _Again:
    """What a VUT made of the other one's telling cases, by index, and how that came about."""

    outcomes: dict[int, Outcome]
    how: str


def _run_again(
    run: Run,
    failing: Sequence[Outcome],
    net: Corridor,
    given: Mapping[str, object] | None,
    on_again: Callable[[int, Trajectory], None],
    *,
    trust: bool,
) -> _Again:
    """Run a campaign's VUT on the other's telling cases, if it is still the same VUT."""
    told = [o for o in run.outcomes if o.score is not None]
    told = sorted(told, key=lambda o: (o.score, o.index))[:CHECKED]
    cases = [o.case for o in (*told, *failing)]
    if not failing:
        return _Again({}, "had nothing to run")
    again: dict[int, Outcome] = {}
    motions: dict[int, Trajectory] = {}
    settings = settings_of(run.folder, run.settings, given, trust=trust)
    lines = centre_lines(net)
    with plan_of(settings, net, cases=len(cases)).open() as ground:
        for place, trajectory in ground.run(cases):
            again[place] = settings.criterion.outcome(place, 0, trajectory, lines)
            motions[place] = trajectory
    for place, outcome in enumerate(told):
        was, now = outcome.score, again[place].score
        if was is None or now is None or abs(was - now) > SAME_SCORE:
            return _Again(
                {},
                "could not be run: its VUT or its POV does not do again what case "
                f"{outcome.index} records",
            )
    first = len(told)
    for n, o in enumerate(failing):
        on_again(o.index, motions[first + n])
    return _Again({o.index: again[first + n] for n, o in enumerate(failing)}, "was run again")


def compared_case(run: str, of: Outcome, a: Outcome | None, b: Outcome | None) -> ComparedCase:
    """Return what became of a case of a run, "A" or "B"; None where a VUT was not run."""
    return ComparedCase(
        run=run,
        index=of.index,
        case=of.case,
        score_a=None if a is None else a.score,
        score_b=None if b is None else b.score,
        end_a=None if a is None else a.measures.end,
        end_b=None if b is None else b.measures.end,
        severity_a=None if a is None else a.measures.severity,
        severity_b=None if b is None else b.measures.severity,
        change=_change(a, b),
    )


def _change(a: Outcome | None, b: Outcome | None) -> Change:
    if a is None or b is None:
        return Change.NOT_RUN_AGAIN
    if not (a.is_tested or b.is_tested):
        return Change.NO_VERDICT
    if not a.is_tested:
        return Change.NO_VERDICT_OF_A
    if not b.is_tested:
        return Change.NO_VERDICT_OF_B
    if _fails(a.score) and _fails(b.score):
        return Change.BOTH_FAIL
    return Change.BROKE if _fails(b.score) else Change.FIXED


def _fails(score: float | None) -> bool:
    return score is not None and score < FAILURE_SCORE


def telling(case: ComparedCase) -> tuple[int, float, str, int]:
    """Return the key by which cases are sorted: what broke comes first, the worst of B first."""
    order = (
        Change.BROKE,
        Change.NO_VERDICT_OF_B,
        Change.NOT_RUN_AGAIN,
        Change.NO_VERDICT,
        Change.BOTH_FAIL,
        Change.NO_VERDICT_OF_A,
        Change.FIXED,
    )
    # Of what was not run again, B's cases may have broken, A's may be fixed.
    score = case.score_b if case.score_b is not None else 0.0
    return order.index(case.change), score, case.run, case.index


def level_change(
    level: int,
    cases: Sequence[ComparedCase],
    own_a: Sequence[Outcome],
    own_b: Sequence[Outcome],
    *,
    same_cases: bool = False,
    records_only: bool = False,
) -> LevelChange:
    """Return what changed at a level; `same_cases` where those of B are those of A, run again.

    `records_only` where neither was asked to run cases again.
    """
    at_level = [case for case in cases if case.case.level == level]
    fails_a = [c.case for c in at_level if _fails(c.score_a)]
    fails_b = [c.case for c in at_level if _fails(c.score_b)]
    alone_a, alone_b = (judge(o for o in own if o.case.level == level) for own in (own_a, own_b))
    if all(case.change is not Change.NOT_RUN_AGAIN for case in at_level):
        # Both VUTs were tried on the same cases: the others of both campaigns raise no question.
        together = alone_a.cases + (0 if same_cases else alone_b.cases)
        untested_a = _untested(alone_a, together, (_silent(c.end_a, c.score_a) for c in at_level))
        untested_b = _untested(alone_b, together, (_silent(c.end_b, c.score_b) for c in at_level))
    else:
        own_ends_a = (_silent(c.end_a, c.score_a) for c in at_level if c.run == "A")
        own_ends_b = (_silent(c.end_b, c.score_b) for c in at_level if c.run == "B")
        untested_a = _untested(alone_a, alone_a.cases, own_ends_a)
        untested_b = _untested(alone_b, alone_b.cases, own_ends_b)

    # Where one fails and the other gives no verdict, or could not be run, nothing is known to be
    # fixed and nothing to be broken. Records alone are compared as they are.
    silent = {Change.NO_VERDICT_OF_A, Change.NO_VERDICT_OF_B}
    silent |= set() if records_only else {Change.NOT_RUN_AGAIN}
    unknown = [
        c.case for c in at_level if c.change in silent and (_fails(c.score_a) or _fails(c.score_b))
    ]

    def volume(failing: Iterable[Case]) -> float:
        return fmc(to_unit(failing, level))

    fmc_a, fmc_b, either = volume(fails_a), volume(fails_b), volume(fails_a + fails_b)
    return LevelChange(
        untested_a=untested_a,
        untested_b=untested_b,
        fmc_a=fmc_a,
        fmc_b=fmc_b,
        fmc_fixed=max(either - volume(fails_b + unknown), 0.0),
        fmc_broke=max(either - volume(fails_a + unknown), 0.0),
        changes={
            change.value: sum(case.change is change for case in at_level) for change in Change
        },
    )


def _silent(end: End | None, score: float | None) -> End | None:
    """Return how a case ended that says nothing; None of a failure, however it ended."""
    return None if _fails(score) else end


def _untested(alone: Verdict, cases: int, ends: Iterable[End | None]) -> Untested:
    counts = Counter(ends)
    return Untested(
        cases=cases,
        errors=counts[End.VUT_ERROR] + counts[End.SIM_ERROR],
        timeouts=counts[End.TIMEOUT],
        nothing_tested=alone.cases > 0 and alone.tested == 0,
    )
