"""Counterfactuals: which drivers would have avoided a failure, in the very same case.

The cases of the failures of a campaign run again, without the VUT and without running its code:

- with each reference driver in the VUT's place, from the start;
- with the FSM driver as one that takes over: up to some time the VUT does what it did, by its
  recorded accelerations, and from then on the driver drives, with its delay still to come. Every
  step is tried from the last one back, up to the first success: success is not monotone in time;
- with a careful driver on the mainline in the POV's place, against what the VUT did.

The drivers of the package need nothing of SUMO, so the episodes are those of eq. (4)
(`simulation/kinematic_world.py`), many at a time. With a POV of the tester they run in SUMO.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from merge_sumo.analysis.run_study import StudyFile
from merge_sumo.campaigns.run import Run, failures
from merge_sumo.controllers.kinds import load
from merge_sumo.controllers.process import LOG
from merge_sumo.drivers.base import MERGE, STAY, Driver, Scene
from merge_sumo.drivers.lane import follow_mps2
from merge_sumo.drivers.levelk import DECISION_STEPS
from merge_sumo.drivers.reference import REFERENCES, CarefulPov
from merge_sumo.metrics.bodies import CentreLines
from merge_sumo.metrics.cause import cause
from merge_sumo.metrics.criterion import Criterion
from merge_sumo.metrics.merge import brake_after_mps2
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.printable import either
from merge_sumo.records import Record
from merge_sumo.road.merge import centre_lines
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S, EpisodeTime, Scenario
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.simulation.evaluate import opened_simulator
from merge_sumo.simulation.kinematic_world import EquationWorld
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.simulation.rollout import Rollout
from merge_sumo.simulation.simulator import povs_for
from merge_sumo.sumo.world import World
from merge_sumo.workers import Workers, workers_or_here

CAREFUL = "careful"
"""The reference driver that takes the place of a careful one."""
TAKES_OVER = "fsm"
"""The reference driver that takes over. From the start it avoids what can be avoided; the careful
driver brakes only 2 s before a collision, and would tell of itself more than of the VUT."""
MOST = 500
"""Failures that run again, the worst: each takes some thirty episodes."""
CHUNK = 250
IN_SUMO = 64
"""Failures that a worker takes at a time, and where they run in SUMO: enough to keep all corridors
busy."""
FEW = 100
"""Failures that take as long as what a worker has to load for them."""
BLOCK_STEPS = 10
"""Take-overs that are tried at a time, from the last one back. Chosen, not tuned."""
CORRIDORS = 1024
"""Episodes that run at a time without SUMO. 243 failures of design2 take .8 s of CPU time with
1024, 1.0 s with 512, 1.5 s with 256."""


class Avoidance(Record, frozen=True):
    """Which drivers would have avoided a failure.

    Attributes:
        index: of the case in its campaign.
        avoided_by: names of the reference drivers that pass the case in the VUT's place.
        latest_takeover_s: the last time at which the FSM driver, taking over, passes it; None where
            there is no such time, and where a version up to 0.1.0 made the record.
        pov_careful: whether a careful driver on the mainline would have avoided it against what
            the VUT did.
    """

    index: int
    avoided_by: tuple[Literal[*REFERENCES], ...]  # type: ignore[valid-type]
    latest_takeover_s: EpisodeTime | None
    pov_careful: bool

    @property
    def clause(self) -> str:
        """The drivers that would have avoided it, in words."""
        by = either(self.avoided_by) if self.avoided_by else "no reference driver"
        text = f"in the place of the VUT {by} would have avoided it"
        if self.latest_takeover_s is not None:
            text += f", {TAKES_OVER} by taking over until {self.latest_takeover_s:.1f} s"
        return f"{text}; so would a careful POV" if self.pov_careful else text


AVOIDANCE = StudyFile("avoidance.jsonl", Avoidance)
"""One line per failure; of very many, the worst."""


def causes(run: Run, outcomes: Sequence[Outcome]) -> dict[int, str]:
    """Return by index the causes of cases of a campaign, with the drivers that would help."""
    motions = run.trajectories(outcome.index for outcome in outcomes)
    clauses = {one.index: one.clause for one in AVOIDANCE.read_lines(run)}
    return {o.index: cause(o, motions.get(o.index), clauses.get(o.index, "")) for o in outcomes}


Failure = tuple[int, Trajectory]
"""The index of a failing case, and its recorded motion."""


def avoidance(
    run: Run,
    plan: SimulationPlan,
    *,
    workers: Workers | None = None,
    check: Callable[[], None] = lambda: None,
    on_part: Callable[[int, int], None] = lambda _done, _total: None,
) -> list[Avoidance]:
    """Return who would have avoided each failure of a campaign, in the order of its cases.

    Of more than `MOST` failures, of the worst ones. Failures whose trajectory is lost, and those
    that end a worker each time, are left out. The POVs are those of the plan; a POV of the
    tester's own runs again.

    Args:
        run: the campaign.
        plan: how it was run.
        workers: where the episodes run, by default in this process.
        check: called whenever a worker is done with some of them; may raise to stop there.
        on_part: told how many failures are done, and how many there are, from 0 on.
    """
    worst = sorted(outcome.index for outcome in failures(run.cases)[:MOST])
    failing = list(run.trajectories(worst).items())
    if not failing:
        return []
    # No code of the VUT: a driver of the package is in its place.
    plan = replace(plan, vut=load(CAREFUL)).for_verdicts()
    plan = plan.with_log(run.folder.resolve() / LOG)
    avoided: list[Avoidance] = []
    with workers_or_here(workers) as processes:
        on_part(0, len(failing))
        few, chunk = (FEW, CHUNK) if plan.povs.own is None else (1, IN_SUMO)
        size = min(chunk, max(few, math.ceil(len(failing) / processes.count)))
        run_some = partial(run_counterfactuals, plan)
        # Nothing is known of a failure that ended every worker that ran it.
        results = processes.run(run_some, failing, lambda _: None, chunk=size)
        for done, one in enumerate(results, start=1):
            if one is not None:
                avoided.append(one)
            if done % size == 0 or done == len(failing):
                on_part(done, len(failing))
                check()
    return sorted(avoided, key=lambda one: one.index)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Counterfactual(Case):
    """A failing case with another driver.

    Attributes:
        by: reference driver in the VUT's place.
        failure: what happened.
        first: step at which the episode begins, with the recorded state.
        until: step up to which the VUT does what it did.
        careful_pov: whether a careful driver is in the POV's place.
    """

    by: str = CAREFUL
    failure: Trajectory = field(compare=False, repr=False)
    first: int = 0
    until: int = 0
    careful_pov: bool = False

    def starts(self) -> list[tuple[float, float]]:
        """Return position and speed of every vehicle where the episode begins."""
        return [(x, v) for x, v, _ in self.failure.motion[self.first].tolist()]

    def recorded_mps2(self) -> FloatArray:
        """Return the accelerations of the VUT in the failure from `first` to M."""
        return self.failure.a_vut_mps2[self.first : self.scenario.max_steps + 1]

    def from_the_start(self, trajectory: Trajectory) -> Trajectory:
        """Return the trajectory of the episode with the steps before it."""
        if not self.first:
            return trajectory
        motion = np.concatenate((self.failure.motion[: self.first], trajectory.motion))
        late = len(motion) - 1 > self.scenario.max_steps
        return replace(trajectory, motion=motion, end=End.TIMEOUT if late else trajectory.end)


def run_counterfactuals(plan: SimulationPlan, failing: Sequence[Failure]) -> list[Avoidance | None]:
    """Return which drivers would have avoided failures, by running their cases in this process.

    Raises `UserError` where other software would give other outcomes.
    """
    if plan.povs.own is not None:
        with opened_simulator(plan) as ground:
            return list(avoidances(Stage(plan, ground.world, ground.pov), failing))
    plan.check_software()
    world = EquationWorld(CORRIDORS, plan.road, plan.scenario)
    with closing(povs_for(plan.scenario, plan.povs, CORRIDORS)) as povs:
        return list(avoidances(Stage(plan, world, povs), failing))


def avoidances(stage: Stage, failing: Sequence[Failure]) -> list[Avoidance]:
    """Return which drivers would have avoided failures."""
    motions = [motion for _, motion in failing]
    # One driver after the other: a driver that is in no corridor costs nothing.
    cases = [_counterfactual(motion, by=name) for name in REFERENCES for motion in motions]
    cases += [_counterfactual(m, until=len(m.motion) - 1, careful_pov=True) for m in motions]
    *by_name, pov_careful = np.reshape(stage.passed(cases), (-1, len(motions))).tolist()
    result: list[Avoidance] = []
    for place, (step, (index, _)) in enumerate(
        zip(_latest_takeovers(stage, motions), failing, strict=True)
    ):
        names = [name for name, by in zip(REFERENCES, by_name, strict=True) if by[place]]
        time_s = None if step is None else round(step * DT_S, 1)
        result.append(Avoidance(index, tuple(names), time_s, pov_careful[place]))
    return result


def _latest_takeovers(stage: Stage, failures: Sequence[Trajectory]) -> list[int | None]:
    """Return the last steps at which a driver may take over, by trying all steps from the last.

    Success is not monotone in time, so nothing before the last success matters, and no step after
    it may be left out.
    """
    latest: list[int | None] = [None] * len(failures)
    untried = {place: len(failure.motion) - 1 for place, failure in enumerate(failures)}
    while untried:
        takeovers = [
            (place, until)
            for place, end in untried.items()
            for until in range(max(end - BLOCK_STEPS, 0), end)
        ]
        cases = [stage.takeover(failures[place], until) for place, until in takeovers]
        for (place, until), passed in zip(takeovers, stage.passed(cases), strict=True):
            if passed:
                latest[place] = until  # in rising order
        untried = {
            place: end - BLOCK_STEPS
            for place, end in untried.items()
            if latest[place] is None and end > BLOCK_STEPS
        }
    return latest


def _counterfactual(failure: Trajectory, **other: Any) -> _Counterfactual:
    same = {field.name: getattr(failure.case, field.name) for field in fields(failure.case)}
    return _Counterfactual(**same, failure=failure, **other)


class Stage:
    """The world and the drivers of the mainline with which the cases of failures run again."""

    def __init__(self, plan: SimulationPlan, world: World | EquationWorld, povs: Driver) -> None:
        """Take the plan, the world, and the POVs."""
        self._world, self._povs = world, _Mainline(povs)
        self._substitutes = _Substitutes(world.corridors, plan.scenario)
        self._criterion, self._lines = plan.criterion, centre_lines(plan.road)

    def takeover(self, failure: Trajectory, until: int) -> _Counterfactual:
        """Return the case in which a driver takes over at a step.

        Without SUMO it begins where the learned POVs, which remember nothing else, last decided.
        """
        in_sumo = isinstance(self._world, World)
        first = 0 if in_sumo else until - until % DECISION_STEPS
        return _counterfactual(failure, by=TAKES_OVER, first=first, until=until)

    def passed(self, cases: Sequence[_Counterfactual]) -> list[bool]:
        """Return whether each case is passed."""
        passed = []
        trajectories = Rollout(self._world, self._povs, self._substitutes, cases).run()
        for case, trajectory in zip(cases, trajectories, strict=True):
            whole = case.from_the_start(trajectory)
            passed.append(_passes(self._criterion, whole, self._lines))
        return passed


def _passes(criterion: Criterion, trajectory: Trajectory, lines: CentreLines) -> bool:
    """Return whether an episode ends at M without a failure.

    Nor is one avoided by a merge after which whoever is behind cannot brake hard enough.
    """
    if brake_after_mps2(trajectory) > -trajectory.case.scenario.a_min_mps2:
        return False
    return trajectory.end.is_tested and not criterion.judged(trajectory, lines).failed


class _Substitutes(Driver):
    """Drives in the VUT's place: first what the VUT did, then a reference driver.

    After a merge from an acceleration lane it follows as a VUT that is driven for.
    """

    def __init__(self, corridors: int, scenario: Scenario) -> None:
        """Prepare for a number of corridors, and for failures in a scenario."""
        super().__init__(corridors)
        self._scenario = scenario
        self._drivers = {name: make(corridors) for name, make in REFERENCES.items()}
        self._by = np.zeros(corridors, dtype=np.int64)
        self._until = np.zeros(corridors, dtype=np.int64)
        self._recorded = np.zeros((scenario.max_steps + 1, corridors))
        self._merges_at = np.zeros(corridors, dtype=np.int64)
        """Step after which the VUT of the failure was on the mainline."""
        self._wishes = np.zeros(corridors, dtype=np.int8)

    def begin(self, corridor: int, case: Case) -> None:
        assert isinstance(case, _Counterfactual), "only counterfactuals run here"  # noqa: S101
        self._by[corridor] = list(self._drivers).index(case.by)
        self._until[corridor] = case.until - case.first
        self._merges_at[corridor] = len(case.failure.motion) - 2 - case.first
        recorded_mps2 = case.recorded_mps2()
        self._recorded[: len(recorded_mps2), corridor] = recorded_mps2
        self._drivers[case.by].begin(corridor, case)

    def act(self, scene: Scene) -> FloatArray:
        recorded = scene.step < self._until
        row = np.minimum(scene.step, len(self._recorded) - 1)
        answer: FloatArray = self._recorded[row, np.arange(self.corridors)]
        for number, driver in enumerate(self._drivers.values()):
            drives = scene.active & ~recorded & (self._by == number)
            if drives.any():
                answer[drives] = driver.act(scene)[drives]
                driver.forget(recorded)
        if scene.merged is not None and scene.merged.any():
            followed = follow_mps2(scene.x_m, scene.v_mps, self._scenario)
            answer = np.where(scene.merged, followed, answer)
        # On an acceleration lane: where the VUT did, then as who only accelerates.
        at_m = scene.x_vut_m + scene.v_vut_mps * DT_S >= 0.0
        merges = np.where(recorded, scene.step >= self._merges_at, at_m)
        self._wishes = np.where(merges, MERGE, STAY).astype(np.int8)
        return answer


class _Mainline(Driver):
    """Drives the cars of the mainline: the POVs of the campaign, or a careful driver."""

    def __init__(self, povs: Driver) -> None:
        """Take the drivers of the POVs."""
        super().__init__(povs.corridors)
        self._povs = povs
        self._careful = CarefulPov(povs.corridors)
        self._is_careful = np.zeros(povs.corridors, dtype=np.bool_)

    def begin(self, corridor: int, case: Case) -> None:
        self._is_careful[corridor] = isinstance(case, _Counterfactual) and case.careful_pov
        (self._careful if self._is_careful[corridor] else self._povs).begin(corridor, case)

    def act(self, scene: Scene) -> FloatArray:
        careful = scene.active & self._is_careful
        if not careful.any():
            return self._povs.act(scene)
        others = scene._replace(active=scene.active & ~careful)
        return np.where(careful, self._careful.act(scene), self._povs.act(others))

    def reason(self, corridor: int) -> str | None:
        return self._povs.reason(corridor)
