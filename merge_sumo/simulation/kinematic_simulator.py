"""The kinematic engine: vehicles are moved by eq. (4) alone, and SUMO checks a share of the cases.

SUMO holds the state that eq. (4) gives, to rounding errors (`sumo/world.py` checks that in every
step). Where the VUT and the POVs are drivers of this package, which need nothing of SUMO, an
episode therefore ends without it as it ends in it, and takes a tenth of the time. That is never
taken on trust: at least one case of a hundred, drawn at random, runs in SUMO as well, and the two
must agree. A case that a rounding error could decide otherwise runs in SUMO, and that counts.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace

import numpy as np

from merge_sumo.errors import UserError
from merge_sumo.road.merge import centre_lines
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import VUT
from merge_sumo.scenario.trajectory import Trajectory
from merge_sumo.simulation.kinematic_world import EquationWorld
from merge_sumo.simulation.plan import Engine, SimulationPlan
from merge_sumo.simulation.simulator import Simulator, corridors_of

CHECKED_SHARE = 0.01
"""Least share of the cases that run in SUMO as well."""
CHUNK = 2500
"""Cases that a worker takes at a time. A number of its own, whatever the workers, so that the same
cases are checked."""
CORRIDORS = 512
"""Episodes at a time: enough for the calls of numpy to cost little, and their record fits into the
cache."""
ROUNDING = 1e-6
"""What the engines may differ in, in m and m/s. Measured: 1e-11."""


class KinematicSimulator(Simulator):
    """A VUT and the POVs as arrays, without SUMO but for the cases that it checks."""

    def __init__(self, plan: SimulationPlan) -> None:
        """Start the drivers; SUMO starts with the first case that it checks."""
        self._plan = plan
        self._sumo: Simulator | None = None
        with ExitStack() as opened:
            world = EquationWorld(CORRIDORS, plan.road, plan.scenario)
            self._open_drivers(plan, world, None, opened)

    def run(self, cases: Sequence[Case]) -> list[Trajectory]:
        """Run cases; return their trajectories in order.

        Raises `UserError` where a case ends otherwise in SUMO.
        """
        ended = super().run(cases)
        close = self._close_calls(ended)
        places = sorted(close | drawn(cases))
        if places and self._sumo is None:
            self._sumo = Simulator(replace(self._plan, engine=Engine.SUMO))
            self._opened.callback(self._sumo.close)
        again = [cases[place] for place in places]
        in_sumo = self._sumo.run(again) if self._sumo and places else []
        for place, trajectory in zip(places, in_sumo, strict=True):
            if place in close:
                ended[place] = trajectory
            else:
                self._compare(ended[place], trajectory)
        self.in_sumo = frozenset(places)
        return ended

    def _close_calls(self, ended: Sequence[Trajectory]) -> set[int]:
        """Return the places where a rounding error could turn the verdict or end another step.

        For the end the VUT is put forward and back by one, in the last step and the one before; so
        it is at M, and where the acceleration lane begins.
        """
        if not ended:
            return set()
        criterion, lines = self._plan.criterion, centre_lines(self._plan.road)
        last = np.concatenate([one.motion[-2:] for one in ended])
        starts = np.cumsum([0, *(min(2, len(one.motion)) for one in ended)])[:-1]
        x_m = last[..., 0].T
        by_shift = []
        for shift_m in (ROUNDING, -ROUNDING):
            shifted_m = x_m.copy()
            shifted_m[VUT] += shift_m
            by_shift.append(self._plan.scenario.has_ended(shifted_m))
        differ = by_shift[0] != by_shift[1]
        begin_m, _ = self._plan.scenario.lane_m or (0.0, 0.0)
        differ |= (np.abs(x_m[VUT] - begin_m) <= ROUNDING) | (np.abs(x_m[VUT]) <= ROUNDING)
        unclear = np.logical_or.reduceat(differ, starts)
        return {
            place
            for place, (one, of_end) in enumerate(zip(ended, unclear.tolist(), strict=True))
            if of_end or criterion.is_close_call(one, ROUNDING, lines)
        }

    def _compare(self, kinematic: Trajectory, sumo: Trajectory) -> None:
        """Raise `UserError` where a case ended otherwise in SUMO."""
        lines = centre_lines(self._plan.road)
        verdicts = [self._plan.criterion.judged(one, lines) for one in (kinematic, sumo)]
        ours, theirs = kinematic.whole, sumo.whole
        if (
            kinematic.end is sumo.end
            and kinematic.error == sumo.error
            and kinematic.motion.shape == sumo.motion.shape
            and ours.shape == theirs.shape
            and np.abs(ours - theirs)[..., :2].max() <= ROUNDING
            and verdicts[0].failed == verdicts[1].failed
        ):
            return
        case = kinematic.case
        fields = (d.field for d in case.scenario.dimensions(case.level))
        where = ", ".join(f"{name} {getattr(case, name)!r}" for name in fields)
        raise UserError(
            f"the case {where} at level {case.level} ends otherwise in SUMO ({_said(sumo)}) than "
            f"by the equations of motion alone ({_said(kinematic)}): choose `engine` sumo"
        )


class SubstepSimulator(Simulator):
    """A VUT and the POVs by eq. (4) alone, each step in parts: for a step shorter than SUMO's."""

    def __init__(self, plan: SimulationPlan) -> None:
        """Start the drivers; `UserError` for those that drive in SUMO only."""
        with ExitStack() as opened:
            most = CORRIDORS if plan.needs_sumo is None else plan.corridors
            corridors = corridors_of(plan, most)
            world = EquationWorld(corridors, plan.road, plan.scenario, plan.substeps)
            self._open_drivers(plan, world, None, opened)


def drawn(cases: Sequence[Case]) -> set[int]:
    """Return the places of the cases that are drawn at random to be checked.

    The cases decide, so that the same are drawn whatever worker has them.
    """
    if not cases:
        return set()
    seed = zlib.crc32(repr((cases[0].level, cases[0].starts())).encode())
    count = math.ceil(CHECKED_SHARE * len(cases))
    return set(np.random.default_rng(seed).choice(len(cases), count, replace=False).tolist())


def _said(trajectory: Trajectory) -> str:
    """Return how an episode ended, in short."""
    x_m = ", ".join(f"{x:.6f}" for x in trajectory.motion[-1, :, 0].tolist())
    return f"{trajectory.end} after {trajectory.t_end_s} s at {x_m} m"
