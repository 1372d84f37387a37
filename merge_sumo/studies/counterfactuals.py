"""Failures that are driven again: a reference driver in the VUT's place, or on the mainline.

The drivers of the package need nothing of SUMO, so the episodes are those of eq. (4)
(`equation_world.py`), many at a time. Where the POV is the tester's own they run in SUMO.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field, fields, replace
from typing import Any, Final

import numpy as np

from merge_sumo.drivers.base import Driver, Scene
from merge_sumo.drivers.levelk import DECISION_STEPS
from merge_sumo.drivers.reference import REFERENCES, CarefulPov
from merge_sumo.engine.evaluate import opened_simulator
from merge_sumo.engine.kinematic_world import EquationWorld
from merge_sumo.engine.plan import SimulationPlan
from merge_sumo.engine.pov_library import PovLibrary
from merge_sumo.engine.rollout import rollout
from merge_sumo.errors import UserError
from merge_sumo.road.centre_lines import centre_lines
from merge_sumo.sumo.world import World
from merge_sumo.values.bodies import CentreLines
from merge_sumo.values.case import Case, FloatArray
from merge_sumo.values.criterion import Criterion
from merge_sumo.values.merge import brake_after_mps2
from merge_sumo.values.scenario import DT_S, EpisodeTime
from merge_sumo.values.score import is_close
from merge_sumo.values.trajectory import End, Trajectory

CAREFUL: Final = "careful"
"""The reference driver that the headline counts."""
TAKES_OVER: Final = "fsm"
"""The reference driver that takes over. From the start it avoids what can be avoided; the careful
driver brakes only 2 s before a collision, and would tell of itself more than of the VUT."""
BLOCK_STEPS: Final = 10
"""Take-overs that are tried at a time, from the last one back."""
CORRIDORS: Final = 256
"""Episodes that run at a time without SUMO."""


@dataclass(frozen=True, slots=True)
class Avoidance:
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
    avoided_by: tuple[str, ...]
    latest_takeover_s: EpisodeTime | None
    pov_careful: bool

    def __post_init__(self) -> None:
        """Raise `UserError` for other drivers than the reference drivers, or another order."""
        if [name for name in REFERENCES if name in self.avoided_by] != list(self.avoided_by):
            raise UserError(f"avoided_by is {self.avoided_by}: choose from {', '.join(REFERENCES)}")

    @property
    def by_careful(self) -> bool:
        """Whether a careful and competent driver avoids it in the VUT's place."""
        return CAREFUL in self.avoided_by

    @property
    def by_who_takes_over(self) -> bool:
        """Whether the driver of `latest_takeover_s` avoids it from the start."""
        return TAKES_OVER in self.avoided_by


@dataclass(frozen=True, kw_only=True, slots=True)
class _Again(Case):
    """A case that is driven again.

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


Failure = tuple[int, Trajectory]
"""The index of a failing case, and what happened in it."""


def drive_again(plan: SimulationPlan, failing: Sequence[Failure]) -> list[Avoidance | None]:
    """Return which drivers would have avoided failures, by driving them again in this process.

    Raises `UserError` where other software would give other outcomes.
    """
    if plan.povs.own is not None:
        with opened_simulator(plan) as ground:
            return list(avoidances(Stage(plan, ground.world, ground.pov), failing))
    plan.check_software()
    world = EquationWorld(CORRIDORS, plan.road, plan.scenario)
    with closing(PovLibrary(CORRIDORS * (world.vehicles - 1), plan.povs)) as povs:
        return list(avoidances(Stage(plan, world, povs), failing))


def avoidances(stage: Stage, failing: Sequence[Failure]) -> list[Avoidance]:
    """Return which drivers would have avoided failures."""
    failures = [failure for _, failure in failing]
    # One driver after the other: a driver that is in no corridor costs nothing.
    asked = [_again(f, by=name) for name in REFERENCES for f in failures]
    asked += [_again(f, until=len(f.motion) - 1, careful_pov=True) for f in failures]
    *by_name, pov_careful = np.reshape(stage.passed(asked), (-1, len(failures))).tolist()
    latest = _latest_takeovers(stage, failures)
    found: list[Avoidance] = []
    for place, (index, _) in enumerate(failing):
        names = [name for name, by in zip(REFERENCES, by_name, strict=True) if by[place]]
        step = latest[place]
        time_s = None if step is None else round(step * DT_S, 1)
        found.append(Avoidance(index, tuple(names), time_s, pov_careful[place]))
    return found


def _latest_takeovers(stage: Stage, failures: Sequence[Trajectory]) -> list[int | None]:
    """Return the last steps at which a driver may take over, by trying all steps from the last.

    Success is not monotone in time, so nothing before the last success matters, and no step after
    it may be left out.
    """
    latest: list[int | None] = [None] * len(failures)
    untried = {place: len(failure.motion) - 1 for place, failure in enumerate(failures)}
    while untried:
        asked = [
            (place, until)
            for place, end in untried.items()
            for until in range(max(end - BLOCK_STEPS, 0), end)
        ]
        cases = [stage.takeover(failures[place], until) for place, until in asked]
        for (place, until), passed in zip(asked, stage.passed(cases), strict=True):
            if passed:
                latest[place] = until  # in rising order
        untried = {
            place: end - BLOCK_STEPS
            for place, end in untried.items()
            if latest[place] is None and end > BLOCK_STEPS
        }
    return latest


def _again(failure: Trajectory, **other: Any) -> _Again:
    same = {f.name: getattr(failure.case, f.name) for f in fields(Case)}
    return _Again(**same, failure=failure, **other)


class Stage:
    """Where failures are driven again, with the drivers of the mainline."""

    def __init__(self, plan: SimulationPlan, world: World | EquationWorld, povs: Driver) -> None:
        """Take the plan, the world, and the POVs."""
        self._world, self._povs = world, _Mainline(povs)
        self._substitutes = _Substitutes(world.corridors, plan.scenario.max_steps)
        self._criterion, self._lines = plan.criterion, centre_lines(plan.road)

    def takeover(self, failure: Trajectory, until: int) -> _Again:
        """Return the case in which a driver takes over at a step.

        Without SUMO it begins where the learned POVs, which remember nothing else, last decided.
        """
        in_sumo = isinstance(self._world, World)
        first = 0 if in_sumo else until - until % DECISION_STEPS
        return _again(failure, by=TAKES_OVER, first=first, until=until)

    def passed(self, cases: Sequence[_Again]) -> list[bool]:
        """Return whether each case is passed."""
        passed = [False] * len(cases)
        for place, trajectory in rollout(self._world, self._povs, self._substitutes, cases):
            whole = cases[place].from_the_start(trajectory)
            passed[place] = _passes(self._criterion, whole, self._lines)
        return passed


def _passes(criterion: Criterion, trajectory: Trajectory, lines: CentreLines) -> bool:
    """Return whether an episode ends at M without a failure.

    Nor is one avoided by a merge after which whoever is behind cannot brake hard enough.
    """
    if brake_after_mps2(trajectory) > -trajectory.case.scenario.a_min_mps2:
        return False
    if criterion.is_papers:  # which needs no measures
        return trajectory.end is End.MERGED and not is_close(trajectory)
    outcome = criterion.judged(trajectory, lines)
    return outcome.measures.end.is_tested and not outcome.failed


class _Substitutes(Driver):
    """Drives in the VUT's place: first what the VUT did, then a reference driver."""

    def __init__(self, corridors: int, steps: int) -> None:
        """Prepare for a number of corridors, and for failures of at most so many steps."""
        super().__init__(corridors)
        self._drivers = {name: make(corridors) for name, make in REFERENCES.items()}
        self._by = np.zeros(corridors, dtype=np.int64)
        self._until = np.zeros(corridors, dtype=np.int64)
        self._recorded = np.zeros((steps + 1, corridors))

    def begin(self, corridor: int, case: Case) -> None:
        assert isinstance(case, _Again), "only failures are driven again"  # noqa: S101
        self._by[corridor] = list(self._drivers).index(case.by)
        self._until[corridor] = case.until - case.first
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
        self._is_careful[corridor] = isinstance(case, _Again) and case.careful_pov
        (self._careful if self._is_careful[corridor] else self._povs).begin(corridor, case)

    def act(self, scene: Scene) -> FloatArray:
        careful = scene.active & self._is_careful
        if not careful.any():
            return self._povs.act(scene)
        others = scene._replace(active=scene.active & ~careful)
        return np.where(careful, self._careful.act(scene), self._povs.act(others))

    def reason(self, corridor: int) -> str | None:
        return self._povs.reason(corridor)
