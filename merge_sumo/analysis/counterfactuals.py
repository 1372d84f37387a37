"""Counterfactuals: the drivers that would have avoided a failure, in the very same case.

The failing cases of a campaign run again without the VUT: with each reference driver in its place,
with a reference driver that takes over at some step, and with a careful POV.
"""

# Each step is tried for a takeover, from the last one back to the first success: success is not
# monotone in time. Until the takeover the VUT moves by its recorded accelerations.
#
# The drivers of the package need nothing of SUMO, so the episodes are those of eq. (4). With a POV
# of the user they run in SUMO.

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from itertools import compress
from typing import Any, Literal

import numpy as np

from merge_sumo.analysis.run_study import RunStudy, StudyFile
from merge_sumo.campaigns.recorded import failures
from merge_sumo.controllers.kinds import load
from merge_sumo.controllers.process import LOG
from merge_sumo.drivers.base import MERGE, STAY, Driver, DriverWrapper, Scene
from merge_sumo.drivers.car_following import follow_mps2
from merge_sumo.drivers.reference_drivers import REFERENCE_DRIVERS, CarefulPov
from merge_sumo.metrics.merge import brake_after_mps2
from merge_sumo.records import Record
from merge_sumo.road.loader import centre_lines
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S, EpisodeTime
from merge_sumo.scenario.trajectory import Trajectory
from merge_sumo.simulation.evaluate import opened_simulator
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.simulation.rollout import RING_ROWS, Rollout
from merge_sumo.simulation.simulator import Simulator

TAKES_OVER = "fsm"
"""The reference driver that takes over: it reacts at once. The driver `careful` brakes only 2 s
before a collision, so its latest takeover would describe this rule and not the VUT."""
MOST = 500
"""Maximum number of failures that run again, the worst: each takes some thirty episodes."""
BLOCK_STEPS = 10
"""Takeovers that are tried at a time, from the last one back. Chosen, not tuned."""


class Avoidance(Record, frozen=True):
    """The drivers that would have avoided a failure.

    Attributes:
        index: of the case in its campaign.
        avoided_by: names of the reference drivers that pass the case in the VUT's place.
        latest_takeover_s: the last time at which the driver `TAKES_OVER` may take over and passes
            the case; None without such a time, and in records of versions up to 0.1.0.
        pov_careful: whether a careful POV avoids the failure against the recorded VUT.
    """

    index: int
    avoided_by: tuple[Literal[*REFERENCE_DRIVERS], ...]  # type: ignore[valid-type]
    latest_takeover_s: EpisodeTime | None
    pov_careful: bool


AVOIDANCE = StudyFile("avoidance.jsonl", Avoidance)
"""A line for each failure, up to `MOST`."""


def write_avoidance(
    study: RunStudy, on_part: Callable[[int, int], None] = lambda _done, _total: None
) -> list[Avoidance]:
    """Write which drivers would have avoided the worst failures of a campaign, if it has any.

    Failures whose trajectory is lost, and those that end a worker each time, are left out.

    Args:
        study: the campaign, and how its cases run.
        on_part: called with the number of failures that are done, and of all; may raise.

    Returns:
        The lines of the file, in the order of the cases.
    """
    run = study.run
    worst = [outcome.index for outcome in failures(run.cases)[:MOST]]
    failing = list(run.trajectories(sorted(worst)).items())
    # A simulator opens the VUT of its plan. This one never drives: `_Substitutes` does.
    plan = replace(study.plan, vut=load(TAKES_OVER)).for_verdicts().with_engine(None)
    plan = plan.with_log(run.folder.resolve() / LOG)
    results = study.workers.run(partial(avoidances, plan), failing, lambda _: None)
    found = []
    for done, one in enumerate(results, start=1):
        if one is not None:
            found.append(one)
        on_part(done, len(failing))
    if found:
        AVOIDANCE.write_lines(run.folder, found)
    return found


@dataclass(frozen=True, kw_only=True, slots=True)
class Counterfactual(Case):
    """A failing case with another driver.

    It is a `Case` because a rollout begins an episode of both drivers with its case: the drivers
    below read the attributes from it.

    Attributes:
        failure: the recorded motion.
        by: name of the reference driver in the place of the VUT.
        until: step up to which the VUT moves by its recorded accelerations.
        careful_pov: whether a careful driver is in the place of the POV.
    """

    failure: Trajectory = field(compare=False, repr=False)
    by: str = TAKES_OVER
    until: int = 0
    careful_pov: bool = False

    @classmethod
    def of(cls, failure: Trajectory, **other: Any) -> Counterfactual:
        """Return the case of a failure with another driver.

        Args:
            failure: the recorded motion.
            other: attributes other than those of the case.
        """
        for one in fields(failure.case):
            other[one.name] = getattr(failure.case, one.name)
        return cls(failure=failure, **other)


def avoidances(plan: SimulationPlan, failing: Sequence[tuple[int, Trajectory]]) -> list[Avoidance]:
    """Return which drivers would have avoided failures, by running their cases in this process.

    Args:
        plan: how the cases run; its VUT does not drive.
        failing: index and recorded motion of each failure.
    """
    motions = [motion for _, motion in failing]
    cases = []
    # One driver after the other: a driver that is in no corridor costs nothing.
    for name in REFERENCE_DRIVERS:
        cases += [Counterfactual.of(motion, by=name) for motion in motions]
    for motion in motions:
        cases.append(Counterfactual.of(motion, until=_steps(motion), careful_pov=True))
    with opened_simulator(plan) as simulator:
        avoided = np.reshape(_avoided(plan, simulator, cases), (-1, len(failing)))
        latest_s = _latest_takeovers_s(plan, simulator, motions)
    found = []
    for row, (index, _) in enumerate(failing):
        *by_name, pov_careful = avoided[:, row].tolist()
        names = tuple(compress(REFERENCE_DRIVERS, by_name))
        found.append(Avoidance(index, names, latest_s[row], pov_careful))
    return found


def _steps(motion: Trajectory) -> int:
    """Return the number of steps of a recorded motion, which has a row more."""
    return len(motion.motion) - 1


def _latest_takeovers_s(
    plan: SimulationPlan, simulator: Simulator, motions: Sequence[Trajectory]
) -> list[float | None]:
    """Return the last times at which a driver may take over, in s; None without one."""
    latest_s: list[float | None] = [None] * len(motions)
    for tried in range(0, max(map(_steps, motions)), BLOCK_STEPS):
        rows, cases = [], []
        for row, motion in enumerate(motions):
            end = _steps(motion) - tried if latest_s[row] is None else 0
            for until in range(max(end - BLOCK_STEPS, 0), end):
                rows.append(row)
                cases.append(Counterfactual.of(motion, until=until))
        for row, case, avoided in zip(rows, cases, _avoided(plan, simulator, cases), strict=True):
            if avoided:
                latest_s[row] = round(case.until * DT_S, 1)  # in rising order
    return latest_s


def _avoided(
    plan: SimulationPlan, simulator: Simulator, cases: Sequence[Counterfactual]
) -> list[bool]:
    """Run counterfactuals in the simulation of a simulator; return which of them avoid the failure.

    This is stricter than `Outcome.passes`: the vehicle behind must also be able to brake after the
    merge.
    """
    simulation = simulator.simulation
    substitutes = _Substitutes(simulation.corridors)
    trajectories = Rollout(simulation, _Mainline(simulator.pov), substitutes, cases).run()
    lines = centre_lines(plan.road)
    avoided = []
    for case, trajectory in zip(cases, trajectories, strict=True):
        can_brake = brake_after_mps2(trajectory) <= -case.scenario.a_min_mps2
        avoided.append(can_brake and plan.criterion.outcome(trajectory, lines).passes)
    return avoided


class _Substitutes(Driver):
    """Drives in the place of the VUT: first as recorded, then by a reference driver.

    After a merge from an acceleration lane the VUT follows the car ahead of it.
    """

    def __init__(self, corridors: int) -> None:
        super().__init__(corridors)
        self._drivers = {name: make(corridors) for name, make in REFERENCE_DRIVERS.items()}
        self._by = np.zeros(corridors, dtype=np.int64)
        self._until = np.zeros(corridors, dtype=np.int64)
        self._recorded = np.zeros((RING_ROWS, corridors))
        """Recorded accelerations of the VUT by step of the episode, m/s2."""
        self._merges_at = np.zeros(corridors, dtype=np.int64)
        """Step of the episode after which the VUT of the failure was on the mainline."""

    def begin(self, corridor: int, case: Case) -> None:
        super().begin(corridor, case)
        assert isinstance(case, Counterfactual), "this code runs counterfactuals only"  # noqa: S101
        self._by[corridor] = list(self._drivers).index(case.by)
        self._until[corridor] = case.until
        recorded = case.failure.a_vut_mps2[: case.scenario.max_steps + 1]
        self._recorded[: len(recorded), corridor] = recorded
        self._merges_at[corridor] = _steps(case.failure) - 1
        self._drivers[case.by].begin(corridor, case)

    def act(self, scene: Scene) -> FloatArray:
        is_recorded = scene.step < self._until
        row = np.minimum(scene.step, len(self._recorded) - 1)
        answer: FloatArray = self._recorded[row, np.arange(self.corridors)]
        for number, driver in enumerate(self._drivers.values()):
            drives = scene.active & ~is_recorded & (self._by == number)
            if drives.any():
                answer[drives] = driver.act(scene)[drives]
                # `act` moved on in every corridor: those on the record have not begun.
                driver.forget(is_recorded)
        if scene.merged is not None and scene.merged.any():
            followed = follow_mps2(scene.x_m, scene.v_mps, self.scenario)
            answer = np.where(scene.merged, followed, answer)
        # On an acceleration lane: where the VUT of the failure merged, then at M.
        at_m = scene.x_vut_m + scene.v_vut_mps * DT_S >= 0.0
        merges = np.where(is_recorded, scene.step >= self._merges_at, at_m)
        self._merge_requests = np.where(merges, MERGE, STAY).astype(np.int8)
        return answer


class _Mainline(DriverWrapper):
    """Drives the cars of the mainline: the POVs of the campaign, or a careful driver."""

    def __init__(self, povs: Driver) -> None:
        super().__init__(povs)
        self._careful = CarefulPov(povs.corridors)
        self._is_careful = np.zeros(povs.corridors, dtype=np.bool_)

    def begin(self, corridor: int, case: Case) -> None:
        self._is_careful[corridor] = isinstance(case, Counterfactual) and case.careful_pov
        (self._careful if self._is_careful[corridor] else self._driver).begin(corridor, case)

    def act(self, scene: Scene) -> FloatArray:
        careful = scene.active & self._is_careful
        if not careful.any():
            return self._driver.act(scene)
        others = scene._replace(active=scene.active & ~careful)
        return np.where(careful, self._careful.act(scene), self._driver.act(others))
