"""A short drill for a VUT before a campaign: what is wrong with it, and what a step costs."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import Final

import numpy as np

from merge_sumo.campaigns.ground import ProvingGround
from merge_sumo.campaigns.plan import resolve
from merge_sumo.drivers.base import Driver, Scene, VutLostError
from merge_sumo.drivers.vut import VutFactory
from merge_sumo.values.case import Case, FloatArray
from merge_sumo.values.criterion import Criterion
from merge_sumo.values.trajectory import End, Trajectory

CORRIDORS: Final = 4
CASES: Final = tuple(
    Case(level=0, x_pov0_m=x, v_pov0_mps=v)
    for x, v in ((-340.0, 25.0), (-300.0, 33.0), (-260.0, 29.0), (-245.0, 35.0), (-200.0, 27.0))
)
FROM_STAND: Final = Case(level=0, x_pov0_m=-340.0, v_pov0_mps=25.0, v_vut0_mps=0.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class VutCheck:
    """What the drill found.

    Attributes:
        problems: sentences on what makes the VUT's results wrong or worthless.
        notes: sentences on what its author may want to know.
        us_per_step_median: cost of one step of one episode, microseconds, without SUMO.
        us_per_step_worst: cost of the slowest step.
    """

    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    us_per_step_median: float
    us_per_step_worst: float


def check_vut(factory: VutFactory) -> VutCheck:
    """Let a VUT drive a few cases, some of them again, and one from a stand."""
    plan = resolve(factory, scenario=CASES[0].scenario, criterion=Criterion(), corridors=CORRIDORS)
    with plan.open() as ground:
        timed = ground.vut = _Timed(ground.vut)
        first = _run(ground, CASES)
        problems = _errors(CASES, first)
        if not problems:
            problems += _differences("the same cases again", first, _run(ground, CASES))
            alone = [_run(ground, [case])[0] for case in CASES]
            problems += _differences("each case alone", first, alone)
            for corridor in range(ground.world.corridors):
                ground.vut.begin(corridor, FROM_STAND)
            problems += _differences("a reset too many", first, _run(ground, CASES))
        notes = _limits(first)
        problems += _from_stand(ground)
        notes += _not_numbers(ground)
        if not problems:
            after = _run(ground, CASES[:1])
            problems += _differences("a state that is no number", first[:1], after)
    return VutCheck(
        problems=problems,
        notes=notes,
        us_per_step_median=statistics.median(timed.us_per_step),
        us_per_step_worst=max(timed.us_per_step),
    )


class _Timed(Driver):
    """Passes everything on and notes what a step of one corridor costs."""

    def __init__(self, driver: Driver) -> None:
        super().__init__(driver.corridors)
        self._driver = driver
        self.begin, self.reason, self.close = driver.begin, driver.reason, driver.close  # type: ignore[method-assign]
        self.us_per_step: list[float] = []

    def act(self, scene: Scene) -> FloatArray:
        start = perf_counter()
        answer = self._driver.act(scene)
        spent = perf_counter() - start
        self.us_per_step.append(spent * 1e6 / max(int(scene.active.sum()), 1))
        return answer


def _run(ground: ProvingGround, cases: Sequence[Case]) -> list[Trajectory]:
    return [t for _, t in sorted(ground.run(cases), key=lambda pair: pair[0])]


def _errors(cases: Sequence[Case], trajectories: Sequence[Trajectory]) -> list[str]:
    wrong = [t for t in trajectories if t.error is not None]
    if not wrong:
        return []
    return [
        f"{len(wrong)} of {len(cases)} ordinary cases end as VUT_ERROR, the first at "
        f"t = {wrong[0].t_end_s} s: {wrong[0].error}"
    ]


def _differences(when: str, before: Sequence[Trajectory], after: Sequence[Trajectory]) -> list[str]:
    """Return a sentence when motions differ that should be the same."""
    why = {
        "the same cases again": "it draws random numbers, reads a clock, or `reset` leaves "
        "something of the episode before",
        "each case alone": "it keeps something between episodes, or shares it between the "
        "episodes that run at the same time",
        "a reset too many": "`reset` does not set everything to its start",
        "a state that is no number": "it did not recover from it at the next `reset`",
    }[when]
    for one, other in zip(before, after, strict=True):
        if not np.array_equal(one.motion, other.motion):
            rows = min(len(one.motion), len(other.motion))
            same = np.flatnonzero((one.motion[:rows] != other.motion[:rows]).any(axis=1))
            at_s = (same[0] if same.size else rows) / 10
            return [f"After {when} it drives differently from t = {at_s:g} s on: {why}."]
    return []


def _limits(trajectories: Sequence[Trajectory]) -> list[str]:
    steps = sum(len(t.motion) - 1 for t in trajectories)
    clipped = sum(t.clipped_steps for t in trajectories)
    if not clipped:
        return []
    return [
        f"In {clipped} of {steps} steps it asks for an acceleration outside -4 to 2 m/s2; that is "
        "clipped, and counted in `clipped_steps`."
    ]


def _from_stand(ground: ProvingGround) -> list[str]:
    (trajectory,) = _run(ground, [FROM_STAND])
    if trajectory.error is not None:
        return [
            f"From a stand (v = 0) it ends as VUT_ERROR at t = {trajectory.t_end_s} s: "
            f"{trajectory.error}"
        ]
    if trajectory.end is End.TIMEOUT and not trajectory.v_vut_mps.any():
        return ["From a stand (v = 0) it never starts, although the road is free at last."]
    return []


def _not_numbers(ground: ProvingGround) -> list[str]:
    """Show the VUT a state of NaN; it may answer anything, but must not hang or end us."""
    corridors = ground.world.corridors
    if ground.world.vut_type is not None:
        return []  # SUMO's own drivers see SUMO's state, which is never NaN
    active = np.zeros(corridors, dtype=bool)
    active[0] = True
    nothing = np.full(corridors, np.nan)
    ground.vut.begin(0, CASES[0])
    scene = Scene.of_pair(active, np.zeros(corridors, dtype=np.int64), *[nothing] * 4)
    try:
        answer = float(ground.vut.act(scene)[0])
    except VutLostError as lost:
        return [f"To a state that is not a number it answers nothing, but {lost.reason}."]
    if np.isfinite(answer):
        return [f"To a state that is not a number it answers {answer:g} m/s2."]
    return []
