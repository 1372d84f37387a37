"""A short drill for a VUT before a campaign: what is wrong with it, and what a step costs."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from time import perf_counter
from typing import Final, NamedTuple

import numpy as np

from merge_sumo.controllers.built_in import BUILT_IN_VUTS
from merge_sumo.controllers.kinds import KINDS
from merge_sumo.controllers.python import installed_vuts
from merge_sumo.controllers.spec import HERE
from merge_sumo.drivers.base import Driver, DriverWrapper, Scene, VutLostError
from merge_sumo.drivers.policies import policies_in, policies_of, read_manifest
from merge_sumo.metrics.plausibility import doubts, mostly_clipped
from merge_sumo.result import Result, Shown
from merge_sumo.scenario.case import Case, FloatArray, from_unit
from merge_sumo.scenario.scenario import DT_S, US23, Scenario
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.simulation.simulator import Simulator

CORRIDORS: Final = 4
PLACES: Final = tuple(product((0.0, 0.25, 0.5, 0.75), (0.0, 0.3, 0.6, 0.9)))
"""Cases in the unit square of the first two coordinates of a level-0 pool: where the POV starts and
how fast, in a merge."""


@dataclass(frozen=True, kw_only=True, slots=True, repr=False)
class VutCheck(Result):
    """What the drill found.

    Attributes:
        vut: the VUT.
        problems: sentences on what makes the VUT's results wrong or worthless.
        notes: sentences on what its author may want to know.
        us_per_step_median: cost of one step of one episode, microseconds, without SUMO.
        us_per_step_worst: cost of the slowest step.
    """

    computed = ("ok",)

    vut: str
    problems: list[str]
    notes: list[str]
    us_per_step_median: float
    us_per_step_worst: float

    @property
    def is_good(self) -> bool:
        """See `Result`."""
        return self.ok

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return not self.problems


def check_vut(plan: SimulationPlan) -> VutCheck:
    """Let the VUT of a plan drive a few cases, some of them again, and one from a stand."""
    plan = plan.for_cases(CORRIDORS)
    cases = _ordinary_cases(plan.scenario)
    from_stand = replace(cases[0], v_vut0_mps=0.0)
    with Simulator(plan) as ground:
        timed = ground.vut = _Timed(ground.vut)
        first = ground.run(cases)
        problems, differing = _errors(cases, first), list[_Difference]()
        if not problems:
            backwards = ground.run(cases[::-1])[::-1]
            differing += _differences("the same cases in another order", first, backwards)
            alone = [ground.run([case])[0] for case in cases]
            differing += _differences("each case alone", first, alone)
            for corridor in range(ground.world.corridors):
                ground.vut.begin(corridor, from_stand)
            differing += _differences("a reset too many", first, ground.run(cases))
        outcomes = [plan.criterion.outcome(k, 0, one) for k, one in enumerate(first)]
        vain = Counter(command for one in first for command in one.in_vain)
        headline = [*filter(None, [mostly_clipped(outcomes)])]
        notes = [*headline, *doubts(outcomes, plan.criterion, vain)]
        problems += _from_stand(ground, from_stand)
        notes += _not_numbers(ground, cases[0])
        if not problems and not differing:
            after = ground.run(cases[:1])
            differing += _differences("a state that is no number", first[:1], after)
    if differing:
        problems += [
            f"After {d.when} it drives differently from t = {d.at_s:g} s on." for d in differing
        ]
        problems.append(_why(plan, differing[0]))
    return VutCheck(
        vut=str(plan.vut.spec),
        problems=problems,
        notes=notes,
        us_per_step_median=statistics.median(timed.us_per_step),
        us_per_step_worst=max(timed.us_per_step),
    )


def _ordinary_cases(scenario: Scenario) -> list[Case]:
    points = np.full((len(PLACES), len(scenario.dimensions(0))), 0.5)
    points[:, :2] = PLACES
    return from_unit(points, 0, scenario=scenario)


class _Timed(DriverWrapper):
    """Passes everything on and notes what a step of one corridor costs."""

    def __init__(self, driver: Driver) -> None:
        super().__init__(driver)
        self.us_per_step: list[float] = []

    def act(self, scene: Scene) -> FloatArray:
        start = perf_counter()
        answer = self._driver.act(scene)
        spent = perf_counter() - start
        self.us_per_step.append(spent * 1e6 / max(int(scene.active.sum()), 1))
        return answer


def _errors(cases: Sequence[Case], trajectories: Sequence[Trajectory]) -> list[str]:
    wrong = [t for t in trajectories if t.end.is_error]
    if not wrong:
        return []
    return [
        f"{len(wrong)} of {len(cases)} ordinary cases end as VUT_ERROR, the first at "
        f"t = {wrong[0].t_end_s} s: {wrong[0].error}"
    ]


class _Difference(NamedTuple):
    """A case that went differently when it ran again: after what, and from when on."""

    when: str
    case: Case
    at_s: float


def _differences(
    when: str, before: Sequence[Trajectory], after: Sequence[Trajectory]
) -> list[_Difference]:
    """Return the first of motions that differ and should be the same, if any."""
    for one, other in zip(before, after, strict=True):
        if not np.array_equal(one.motion, other.motion):
            rows = min(len(one.motion), len(other.motion))
            steps = np.flatnonzero((one.motion[:rows] != other.motion[:rows]).any(axis=(1, 2)))
            return [_Difference(when, one.case, float(steps[0] if steps.size else rows) * DT_S)]
    return []


def _why(plan: SimulationPlan, difference: _Difference) -> str:
    """Return why a VUT drives differently; a case that runs first, twice, tells it."""
    spec = plan.vut.spec
    if spec.kind == HERE or plan.vut.waits(spec.argument):
        return (
            "It draws random numbers, reads a clock, or keeps something from earlier episodes, "
            "perhaps in its module or its class."
        )
    motions = []
    for _ in range(2):
        with Simulator(plan.for_cases(1)) as ground:
            motions.append(ground.run([difference.case])[0].motion)
    if not np.array_equal(motions[0], motions[1]):
        return (
            "It draws random numbers, reads a clock, or keeps something outside of its process: as "
            "the first case of a new process such a case does not repeat either."
        )
    return (
        "It keeps something from earlier episodes, or shares it between those that run at a time: "
        "in its object (what does `reset` not clear?), its class or its module. As the first case "
        "of a new process such a case repeats."
    )


def _from_stand(ground: Simulator, from_stand: Case) -> list[str]:
    (trajectory,) = ground.run([from_stand])
    if trajectory.end.is_error:
        return [
            f"From a stand (v = 0) it ends as VUT_ERROR at t = {trajectory.t_end_s} s: "
            f"{trajectory.error}"
        ]
    if trajectory.end is End.TIMEOUT and not trajectory.v_vut_mps.any():
        return ["From a stand (v = 0) it never starts, although the road is free at last."]
    return []


def _not_numbers(ground: Simulator, case: Case) -> list[str]:
    """Show the VUT a state of NaN; it may answer anything, but must not hang or end us."""
    corridors, vehicles = ground.world.corridors, len(ground.world.x_m)
    if ground.world.vut_type is not None:
        return []  # SUMO's own drivers see SUMO's state, which is never NaN
    active = np.zeros(corridors, dtype=bool)
    active[0] = True
    nothing = np.full((vehicles, corridors), np.nan)
    ground.vut.begin(0, case)
    step = np.zeros(corridors, dtype=np.int64)
    merged = None if case.scenario.lane_m is None else np.zeros(corridors, dtype=bool)
    scene = Scene(
        active, step, nothing, nothing, facing=step if vehicles > 2 else None, merged=merged
    )
    try:
        answer = float(ground.vut.act(scene)[0])
    except VutLostError as lost:
        return [f"To a state that is not a number it answers nothing, but {lost}."]
    if np.isfinite(answer):
        return [f"To a state that is not a number it answers {answer:g} m/s2."]
    return []


def known_vuts(policies: Path | str | None) -> Shown:
    """Return the VUTs that can be tested, with the learned drivers of a folder or a library."""
    trained = read_manifest(policies_of(US23) if policies is None else policies_in(policies))
    built_in = [name for name, vut in BUILT_IN_VUTS.items() if vut.network in ("", *trained)]
    names = {"built in": built_in, "installed": list(installed_vuts())}
    lines = [f"{title}: {', '.join(known)}" for title, known in names.items() if known]
    kinds = []
    for kind in KINDS.values():
        if kind.form:
            kinds.append({"form": kind.form, "what": kind.what, "example": kind.example})
            lines += [kind.form, f"    {kind.what}", f"    {kind.example}"]
    return Shown({**names, "kinds": kinds}, lines)
