"""The kinematic engine: vehicles are moved by eq. (4) alone, and SUMO checks a share of the cases.

SUMO holds the state that eq. (4) gives, to rounding errors (`sumo/sumo_simulation.py` checks it in
every step). Where the VUT and the POVs are drivers of this package, which need nothing of SUMO, an
episode has the same end without it, and takes a tenth of the time. At least one case of a hundred,
drawn at random, runs in SUMO as well, and the two must agree. A case that a rounding error could
decide otherwise is decided by SUMO.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace

import numpy as np

from merge_sumo.errors import UserError
from merge_sumo.road.loader import centre_lines
from merge_sumo.scenario.case import Case, described
from merge_sumo.scenario.scenario import VUT
from merge_sumo.scenario.trajectory import Trajectory
from merge_sumo.simulation.kinematic_simulation import KinematicSimulation
from merge_sumo.simulation.plan import Engine, SimulationPlan
from merge_sumo.simulation.simulator import Simulator, corridors_of

CHECKED_SHARE = 0.01
"""Least share of the cases that run in SUMO as well."""
CHUNK = 2500
"""Cases that a worker takes at a time: the same number for any workers, so that the same cases are
checked."""
CORRIDORS = 512
"""Episodes at a time: many enough for quick calls of numpy, few enough for the cache."""
ROUNDING = 1e-6
"""Largest difference between the engines, in m and m/s. Measured: 1e-11."""


class KinematicSimulator(Simulator):
    """A VUT and the POVs by eq. (4), with SUMO only for the cases that it checks.

    A plan with a shorter step than that of SUMO has no such cases.

    Example:
        with KinematicSimulator(plan.with_engine("kinematic")) as simulator:
            trajectories = simulator.run(cases)
    """

    def __init__(self, plan: SimulationPlan) -> None:
        """Start the drivers; SUMO starts with the first case that it checks.

        Args:
            plan: the plan.

        Raises:
            UserError: if a driver needs SUMO.
        """
        self._plan = plan
        self._sumo: Simulator | None = None
        most = CORRIDORS if plan.needs_sumo is None else plan.corridors
        with ExitStack() as opened:
            corridors = corridors_of(plan, most)
            simulation = KinematicSimulation(corridors, plan.road, plan.scenario, plan.substeps)
            self._open_drivers(plan, simulation, opened)

    def run(self, cases: Sequence[Case]) -> list[Trajectory]:
        """Run cases; return their trajectories in order.

        Args:
            cases: cases of the scenario of the plan.

        Raises:
            UserError: if a case ends otherwise in SUMO.
        """
        ended = super().run(cases)
        if not cases or self._plan.substeps > 1:
            return ended
        close = self._close_calls(ended)
        indices = sorted(close | drawn(cases))
        if self._sumo is None:
            self._sumo = Simulator(replace(self._plan, engine=Engine.SUMO))
            self._opened.callback(self._sumo.close)
        in_sumo = self._sumo.run([cases[index] for index in indices])
        for index, trajectory in zip(indices, in_sumo, strict=True):
            if index in close:
                ended[index] = trajectory
            else:
                self._compare(ended[index], trajectory)
        self.in_sumo = frozenset(indices)
        return ended

    def _close_calls(self, ended: Sequence[Trajectory]) -> set[int]:
        """Return the indices where a rounding error could change the verdict or the last step.

        In the last step, or the one before, the VUT is then at M, or at an end of the lane.
        """
        x_vut_m = np.empty((len(ended), 2))
        for index, one in enumerate(ended):
            x_vut_m[index] = one.motion[-2:, VUT, 0]  # one row counts twice
        unclear = np.zeros(len(ended), dtype=np.bool_)
        for place_m in (0.0, *(self._plan.scenario.lane_m or ())):
            unclear |= (np.abs(x_vut_m - place_m) <= ROUNDING).any(axis=1)
        close, lines = set(np.flatnonzero(unclear).tolist()), centre_lines(self._plan.road)
        return close | self._plan.criterion.close_calls(ended, ROUNDING, lines)

    def _compare(self, kinematic: Trajectory, sumo: Trajectory) -> None:
        """Raise `UserError` where a case ended otherwise in SUMO."""
        lines, criterion = centre_lines(self._plan.road), self._plan.criterion
        ours, theirs = kinematic.whole, sumo.whole
        if (
            kinematic.end is sumo.end
            and kinematic.error == sumo.error
            and kinematic.motion.shape == sumo.motion.shape
            and ours.shape == theirs.shape
            and np.abs(ours - theirs)[..., :2].max() <= ROUNDING
            and criterion.outcome(kinematic, lines).failed == criterion.outcome(sumo, lines).failed
        ):
            return
        case = kinematic.case
        raise UserError(
            f"the case {described(case)} at level {case.level} ends differently in SUMO and by "
            "the equations of motion: set `engine` to sumo"
        )


def drawn(cases: Sequence[Case]) -> set[int]:
    """Return the indices of the cases that are drawn at random to be checked.

    The cases are the seed, so that the same are drawn in any worker.

    Args:
        cases: at least one case.
    """
    seed = zlib.crc32(repr((cases[0].level, cases[0].starts())).encode())
    count = math.ceil(CHECKED_SHARE * len(cases))
    return set(np.random.default_rng(seed).choice(len(cases), count, replace=False).tolist())
