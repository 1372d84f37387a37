"""From a plan and cases to results: in this process, on workers, or on a cluster.

Whatever runs cases does it here. A worker keeps its simulator open from one chunk to the next.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from functools import cached_property, partial
from threading import RLock
from typing import Any, Final, TypeVar, overload

import numpy as np

from merge_sumo.engine.kinematic_simulator import CHUNK, KinematicSimulator, SubstepSimulator
from merge_sumo.engine.plan import Engine, SimulationPlan
from merge_sumo.engine.simulator import Simulator
from merge_sumo.errors import UserError
from merge_sumo.road.centre_lines import centre_lines
from merge_sumo.scenario.case import Case, FloatArray, Pool
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.system.blame import MAX_DEATHS
from merge_sumo.system.hashing import Files, hashed
from merge_sumo.system.workers import (
    AnyWorkers,
    InProcess,
    Workers,
    cut,
    open_workers,
    when_worker_ends,
)
from merge_sumo.verdict.episode import Episode
from merge_sumo.verdict.score import CaseVerdict, Outcome, measure_all

R = TypeVar("R")


class Episodes(Sequence[Episode]):
    """The episodes of a chunk of cases; they are measured when one of them is asked for.

    Attributes:
        in_sumo: places of the cases that SUMO ran; the engine of the plan may be another.
    """

    def __init__(
        self,
        plan: SimulationPlan,
        trajectories: Sequence[Trajectory],
        *,
        files: Files,
        pov_files: Files,
        ran_again: Collection[int] = (),
        in_sumo: Collection[int],
    ) -> None:
        """Take the plan, and what became of its cases; `ran_again` are places."""
        self.trajectories, self.files, self.pov_files = trajectories, files, pov_files
        self.in_sumo = in_sumo
        self._plan, self._ran_again = plan, ran_again

    def verdicts(self) -> list[CaseVerdict]:
        """Return the verdict on each case, which takes less time than its measures."""
        criterion, lines = self._plan.criterion, centre_lines(self._plan.road)
        return [criterion.verdict(trajectory, lines) for trajectory in self.trajectories]

    @cached_property
    def _measured(self) -> list[Episode]:
        margin = self._plan.criterion.margin
        measured = measure_all(self.trajectories, centre_lines(self._plan.road))
        return [
            Episode(
                Outcome(place, 0, run.case, measures, margin=margin(run, measures)),
                *(run, self.files, self.pov_files),
                again=place in self._ran_again,
            )
            for place, (run, measures) in enumerate(zip(self.trajectories, measured, strict=True))
        ]

    def __len__(self) -> int:
        return len(self.trajectories)

    @overload
    def __getitem__(self, place: int) -> Episode: ...
    @overload
    def __getitem__(self, place: slice) -> list[Episode]: ...
    def __getitem__(self, place: int | slice) -> Episode | list[Episode]:
        return self._measured[place]


class CasesAt(Sequence[Case]):
    """Cases by their points in the unit cube, made when they run: they travel as numbers."""

    def __init__(self, pool: Pool, level: int, points: FloatArray) -> None:
        """Take points, (n, d), of a level of a pool."""
        self.pool, self.level, self.points = pool, level, points

    def __len__(self) -> int:
        return len(self.points)

    @overload
    def __getitem__(self, place: int) -> Case: ...
    @overload
    def __getitem__(self, place: slice) -> CasesAt: ...
    def __getitem__(self, place: int | slice) -> Case | CasesAt:
        if isinstance(place, slice):
            return CasesAt(self.pool, self.level, self.points[place])
        return next(iter(CasesAt(self.pool, self.level, self.points[place][None])))

    def __iter__(self) -> Iterator[Case]:
        return iter(self.pool.cases(self.points, self.level))


Keep = Callable[[Episodes], Sequence[R]]
"""What is kept of the results of a chunk; it runs where they are, and only that travels."""


@overload
def evaluate(
    plan: SimulationPlan, cases: Sequence[Case], workers: Workers | None = None
) -> Generator[tuple[int, Episode], None, None]: ...
@overload
def evaluate(
    plan: SimulationPlan, cases: Sequence[Case], workers: Workers | None, keep: Keep[R]
) -> Generator[tuple[int, R], None, None]: ...
def evaluate(
    plan: SimulationPlan,
    cases: Sequence[Case],
    workers: Workers | None = None,
    keep: Keep[Any] | None = None,
) -> Generator[tuple[int, Any], None, None]:
    """Run cases; yield (place in `cases`, result) as chunks of them end.

    Args:
        plan: how they run.
        cases: cases of the plan's scenario.
        workers: where they run; None opens this process for them alone.
        keep: gives what is kept of the results of a chunk, by default all; to be found by name.

    Raises `UserError` where the plan cannot be carried out.
    """
    with workers_or_here(workers) as available:
        kinematic = plan.engine is Engine.KINEMATIC
        chunks = cut(cases, CHUNK if kinematic else available.chunk_size(len(cases)))
        for first, results in evaluate_chunks(plan, chunks, available, keep):
            yield from enumerate(results, start=first)


def evaluate_anew(plan: SimulationPlan, cases: Sequence[Case]) -> list[tuple[int, Episode]]:
    """Run cases in this process, with drivers that drove nothing before; return as `evaluate`."""
    close_simulator()
    try:
        return list(evaluate(plan, cases, THIS_PROCESS))
    finally:
        close_simulator()


def evaluate_chunks(
    plan: SimulationPlan,
    chunks: Iterable[Sequence[Case]],
    workers: Workers,
    keep: Keep[Any] | None = None,
) -> Generator[tuple[int, Sequence[Any]], None, None]:
    """Run chunks of cases as workers want them; yield (place of the first case, what is kept)."""
    kept = keep or list
    return workers.run_chunks(
        partial(_run_and_keep, plan, kept),
        chunks,
        lambda case: kept(_lost(plan, case))[0],
        ran_again=None if keep else _again,
    )


def open_simulators(plan: SimulationPlan, workers: Workers, *, first: bool = False) -> None:
    """Open the simulator of a plan in every worker; `UserError` where that cannot be.

    A worker takes as long to start as to run hundreds of cases, so all of them start at once. It
    goes on when all have opened it, or the `first` one has.
    """

    def died(_: None) -> None:
        own = plan.povs.own
        pov = "" if own is None else f" or the POV {own.spec}"
        raise UserError(f"opening the VUT {plan.vut.spec}{pov} ended its process: look into it")

    most = workers.count if first else min(workers.count, plan.corridors)
    everywhere = [None] * (1 if workers.here else most)
    for _ in workers.run(partial(_open_simulator, plan), everywhere, died, chunk=1):
        if first:
            break


def evaluation_workers(workers: AnyWorkers = None, here_s: float | None = None) -> Workers:
    """Return workers that load what it takes to run cases as they start: see `open_workers`."""
    return open_workers(workers, preload=__name__, here_s=here_s)


def workers_or_here(workers: Workers | None) -> AbstractContextManager[Workers]:
    """Give the workers, which stay open, or this process as the only one."""
    return open_workers(1) if workers is None else nullcontext(workers)


THIS_PROCESS: Final = Workers(InProcess, 1)
"""This process, which keeps its simulator between evaluations: for a loop within a worker."""


def run_cases(plan: SimulationPlan, cases: Iterable[Case]) -> Episodes:
    """Run cases in the simulator that this process keeps; return the results in their order."""
    cases = list(cases)
    with opened_simulator(plan) as simulator:
        ran_again: set[int] = set()
        ran = dict(simulator.run(cases, ran_again))
        return Episodes(
            plan,
            [ran[place] for place in range(len(cases))],
            files=hashed(simulator.vut.files()),
            pov_files=hashed(simulator.pov.files()),
            ran_again=ran_again,
            in_sumo=simulator.in_sumo,
        )


def _run_and_keep(plan: SimulationPlan, keep: Keep[R], cases: Iterable[Case]) -> Sequence[R]:
    return keep(run_cases(plan, cases))


def _open_simulator(plan: SimulationPlan, nothing: Sequence[None]) -> Sequence[None]:
    with opened_simulator(plan):
        return nothing


_kept: tuple[tuple[object, ...], Simulator] | None = None
"""The simulator of this process, with the key of its plan: it stays open between chunks."""
_one_at_a_time = RLock()
"""libsumo holds one simulation per process, and some clusters give a process several threads."""


@contextmanager
def opened_simulator(plan: SimulationPlan) -> Iterator[Simulator]:
    """Give the simulator of this process, which stays open for the next chunk of the same plan."""
    global _kept  # noqa: PLW0603 (one SUMO per process)
    key = plan.key(), plan.vut, plan.povs, plan.engine, plan.corridors, plan.substeps
    with _one_at_a_time:
        try:
            if _kept is None or _kept[0] != key:
                close_simulator()
                plan.check_software()
                kind = KinematicSimulator if plan.engine is Engine.KINEMATIC else Simulator
                _kept = key, (SubstepSimulator if plan.substeps > 1 else kind)(plan)
                when_worker_ends(close_simulator)
            yield _kept[1]
        except BaseException:
            close_simulator()  # it stands in the middle of episodes
            raise


def close_simulator() -> None:
    """Close the simulator that this process keeps, if any."""
    global _kept
    with _one_at_a_time:
        if _kept is not None:
            simulator, _kept = _kept[1], None
            simulator.close()


def _lost(plan: SimulationPlan, case: Case) -> Episodes:
    """Return what is recorded of a case that ended every worker that ran it."""
    start = [[(x, v, 0.0) for x, v in case.starts()]]
    reason = f"its worker process died {MAX_DEATHS} times"
    trajectory = Trajectory(case, np.array(start), End.SIM_ERROR, reason)
    return Episodes(plan, [trajectory], files={}, pov_files={}, in_sumo=(0,))


def _again(episode: Episode) -> Episode:
    return replace(episode, again=True)
