"""From a plan and cases to episodes, for everything that runs cases.

A process keeps its simulator open from one chunk of cases to the next.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from threading import RLock
from typing import TypeVar

import numpy as np

from merge_sumo.errors import UserError
from merge_sumo.files import hashed
from merge_sumo.metrics.outcome import Episode
from merge_sumo.road.loader import centre_lines
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.simulation.kinematic_simulator import CHUNK, KinematicSimulator
from merge_sumo.simulation.plan import Engine, SimulationPlan
from merge_sumo.simulation.simulator import Simulator
from merge_sumo.workers import Workers, when_worker_ends

R = TypeVar("R")


def simulate(plan: SimulationPlan, cases: Sequence[Case]) -> list[Episode]:
    """Run cases in this process; return their episodes in order, with all measures.

    Where the plan has an earlier version of the VUT, each episode has that of the earlier version.

    Args:
        plan: how they run.
        cases: cases of the scenario of the plan.

    Example:
        case = Case(level=0, x_pov0_m=-250.0, v_pov0_mps=30.0, scenario=plan.scenario)
        (episode,) = simulate(plan, [case])

    Raises:
        UserError: if the plan cannot be carried out.
    """
    return simulate_part(plan, cases, with_measures)


def simulate_part(
    plan: SimulationPlan, cases: Sequence[Case], keep: Callable[[Episode], R]
) -> list[R]:
    """Run cases in this process; return what `keep` makes of each episode, in order.

    Args:
        plan: how they run.
        cases: cases of the scenario of the plan.
        keep: returns the result of an episode.

    Raises:
        UserError: if the plan cannot be carried out.
    """
    if (earlier := plan.earlier) is not None:
        return list(map(keep, _simulate_both(plan, earlier, cases)))
    with opened_simulator(plan) as simulator:
        trajectories = simulator.run(cases)
        files, pov_files = hashed(simulator.vut.files()), hashed(simulator.pov.files())
        parts = []
        for outcome in plan.criterion.outcomes(trajectories, centre_lines(plan.road)):
            index = outcome.index
            episode = Episode(
                outcome,
                trajectories[index],
                files,
                pov_files,
                ran_again=index in simulator.ran_again,
                in_sumo=index in simulator.in_sumo,
            )
            parts.append(keep(episode))
        return parts


def with_measures(episode: Episode) -> Episode:
    """Compute all measures of an episode, and return it.

    `Measures` are pickled without their trajectory: in another process nothing can be computed
    any more.

    Args:
        episode: an episode with its trajectory.
    """
    episode.outcome.measures.compute_all()
    return episode


def lost_episode(plan: SimulationPlan, case: Case) -> Episode:
    """Return the episode of a case that ended its worker process each time that it ran.

    Args:
        plan: how it ran.
        case: the case.
    """
    start = [[(x, v, 0.0) for x, v in case.starts()]]
    error = "its worker process died twice"
    trajectory = Trajectory(case, np.array(start), End.SIM_ERROR, error)
    outcome = plan.criterion.outcome(trajectory)
    episode = Episode(outcome, trajectory)
    return episode if plan.against is None else replace(episode, earlier=episode)


def evaluate(
    plan: SimulationPlan,
    cases: Sequence[Case],
    workers: Workers | None,
    keep: Callable[[Episode], R],
) -> Iterator[R]:
    """Simulate cases of a study on workers; return their results in order, as they end.

    A campaign gives its cases to workers itself (`SearchLoop`).

    Args:
        plan: how they run.
        cases: cases of the scenario of the plan.
        workers: where they run; None for this process, which keeps its simulator open.
        keep: gives the part of an episode that travels to this process, such as `with_measures`; a
            function of a module, so that a worker can import it.

    Raises:
        UserError: if the plan cannot be carried out.
    """

    def lost_part(case: Case) -> R:
        return keep(lost_episode(plan, case))

    available = Workers() if workers is None else workers
    chunk = CHUNK if plan.engine is Engine.KINEMATIC else None
    return available.run(partial(simulate_part, plan, keep=keep), cases, lost_part, chunk=chunk)


def open_simulators(plan: SimulationPlan, workers: Workers) -> None:
    """Start all workers, and open the simulator of a plan in one of them.

    Args:
        plan: the plan.
        workers: the workers.

    Raises:
        UserError: if the plan cannot be carried out.
    """

    def died(_: None) -> None:
        raise UserError(f"loading the VUT {plan.vut.spec} or the POV ended the process")

    workers.collect(workers.submit(partial(_open_simulators, plan), [None], died))


_kept: tuple[tuple[object, ...], Simulator] | None = None
"""The simulator of this process, with the key of its plan: it stays open between chunks."""
_one_at_a_time = RLock()
"""libsumo holds one simulation per process, and some clusters give a process several threads."""


@contextmanager
def opened_simulator(plan: SimulationPlan) -> Iterator[Simulator]:
    """Give the simulator of this process, which stays open for the next chunk of the same plan.

    Args:
        plan: the plan.

    Raises:
        UserError: if the plan cannot be carried out.
    """
    global _kept  # noqa: PLW0603 (one SUMO per process)
    with _one_at_a_time:
        try:
            if _kept is None or _kept[0] != _key(plan):
                close_simulator()
                plan.check_software()
                by_equations = plan.engine is Engine.KINEMATIC or plan.substeps > 1
                _kept = _key(plan), KinematicSimulator(plan) if by_equations else Simulator(plan)
                when_worker_ends(close_simulator)
            yield _kept[1]
        except BaseException:
            close_simulator()  # its episodes have not ended
            raise


def close_simulator() -> None:
    """Close the simulator that this process keeps, if any."""
    global _kept
    with _one_at_a_time:
        if _kept is not None:
            simulator, _kept = _kept[1], None
            simulator.close()


def _key(plan: SimulationPlan) -> tuple[object, ...]:
    """Return the key of the simulator that serves a plan."""
    return plan.key(), plan.vut, plan.povs, plan.engine, plan.corridors, plan.substeps


def _simulate_both(
    plan: SimulationPlan, earlier: SimulationPlan, cases: Sequence[Case]
) -> list[Episode]:
    """Run cases with both versions of the VUT, first with the one whose simulator is open."""
    plan = replace(plan, against=None)
    if _kept is not None and _kept[0] == _key(earlier):
        before = simulate(earlier, cases)
        after = simulate(plan, cases)
    else:
        after = simulate(plan, cases)
        before = simulate(earlier, cases)
    return [replace(a, earlier=b) for a, b in zip(after, before, strict=True)]


def _open_simulators(plan: SimulationPlan, nothing: Sequence[None]) -> Sequence[None]:
    """Open the simulator of a plan by running no cases; `_kept` holds it for the first chunk."""
    simulate(plan, [])
    return nothing
