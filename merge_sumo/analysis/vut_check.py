"""A check of a VUT before a campaign: its faults, and the cost of a step."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from merge_sumo.campaigns.repeatability import difference
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.controllers.built_in import BUILT_IN_VUTS
from merge_sumo.controllers.kinds import KINDS
from merge_sumo.controllers.python import installed_vuts
from merge_sumo.drivers.base import Driver, DriverWrapper, Scene
from merge_sumo.drivers.policies import policies_in, policies_of, read_manifest
from merge_sumo.errors import ControllerError, UserError
from merge_sumo.metrics.plausibility import doubts
from merge_sumo.result import Result, Shown
from merge_sumo.scenario.case import Case, FloatArray, from_unit
from merge_sumo.scenario.scenario import US23, Scenario
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.simulation.simulator import Simulator

CORRIDORS = 4
"""Number of episodes that run at a time."""


@dataclass(frozen=True, kw_only=True, slots=True, repr=False)
class VutCheck(Result):
    """The problems of a controller, and the time of a step. `ms.check_vut` returns it.

    Example:
        ```python
        found = ms.check_vut("my_vut.py:MyVut")
        assert found.ok, found.problems
        ```

    Attributes:
        vut: spec of the controller.
        problems: problems that make results wrong or useless, each in a sentence.
        notes: other sentences for the author of the controller.
        us_per_step_median: median time of a step of one episode without SUMO, in microseconds; None
            for a controller that does not start.
    """

    computed = ("ok",)

    vut: str
    problems: list[str]
    notes: list[str]
    us_per_step_median: float | None

    @property
    def is_good(self) -> bool:
        """Whether the exit code of the command is 0: the same as `ok`."""
        return self.ok

    @property
    def ok(self) -> bool:
        """Whether there are no problems."""
        return not self.problems


def check_vut(settings: CampaignSettings) -> VutCheck:
    """Let a VUT drive a few cases, some of them again, and one from standstill.

    Args:
        settings: settings of a campaign with the VUT at level 0.

    Returns:
        Its faults, also where it does not start.
    """
    problems: list[str] = []
    notes: list[str] = []
    cost_us: list[float] = []
    try:
        plan = settings.load_plan().for_cases(CORRIDORS)
        with _opened(plan) as simulator:
            timed = _Timed(simulator.vut)
            simulator.vut = timed
            problems, notes = _checked(simulator, plan)
            cost_us = timed.us_per_step
    except ControllerError as error:
        problems.append(f"The VUT does not start: {error}")
    return VutCheck(
        vut=settings.vut,
        problems=problems,
        notes=notes,
        us_per_step_median=statistics.median(cost_us) if cost_us else None,
    )


def known_vuts(policies: Path | str | None) -> Shown:
    """Return the VUTs that can be tested: those built in, those installed, and forms of others.

    Args:
        policies: folder or library of the learned drivers; None for the shipped ones.
    """
    trained = read_manifest(policies_of(US23) if policies is None else policies_in(policies))
    built_in = [name for name, vut in BUILT_IN_VUTS.items() if vut.network in ("", *trained)]
    record: dict[str, Any] = {"built in": built_in, "installed": list(installed_vuts())}
    lines = [f"{title}: {', '.join(names)}" for title, names in record.items() if names]
    record["kinds"] = []
    for kind in KINDS.values():
        if kind.form:
            record["kinds"].append({"form": kind.form, "what": kind.what, "example": kind.example})
            lines += [kind.form, f"    {kind.what}", f"    {kind.example}"]
    return Shown(record, lines)


def _opened(plan: SimulationPlan) -> Simulator:
    """Start the drivers; a VUT that cannot be started is its own fault, no mistake of the user."""
    try:
        return Simulator(plan)
    except UserError as error:
        raise ControllerError(str(error)) from error


def _checked(simulator: Simulator, plan: SimulationPlan) -> tuple[list[str], list[str]]:
    """Return the faults of the VUT of a simulator, and notes, in sentences."""
    cases = _ordinary_cases(plan.scenario)
    from_standstill = replace(cases[0], v_vut0_mps=0.0)
    driven = simulator.run(cases)
    failed = [trajectory for trajectory in driven if trajectory.end.is_error]
    if failed:
        problems = [
            f"{len(failed)} of {len(cases)} ordinary cases end as VUT_ERROR, the first at "
            f"t = {failed[0].t_end_s} s: {failed[0].error}"
        ]
    else:
        problems = _memory_faults(simulator, cases, driven, from_standstill)
    notes = _notes(plan, driven)
    return problems + _standstill_faults(simulator, from_standstill), notes


def _memory_faults(
    simulator: Simulator, cases: list[Case], driven: Sequence[Trajectory], from_standstill: Case
) -> list[str]:
    """Return a sentence on the first motion that changes when the same cases run again, if any."""
    for corridor in range(simulator.simulation.corridors):
        simulator.vut.begin(corridor, from_standstill)  # one more reset
    # Without the last case, each case runs next to other cases than before.
    backwards = simulator.run(cases[-2::-1])
    for one, other in zip(driven[:-1], backwards[::-1], strict=True):
        from_s = difference(one, other)
        if from_s is not None:
            return [
                f"The VUT drives differently from t = {from_s:g} s on when the same cases run in "
                "another order. Possible causes: it draws random numbers, reads a clock, mixes "
                "the corridors of `act_batch`, or keeps values of earlier episodes in its object "
                "(does `reset` clear each attribute?), class or module."
            ]
    return []


def _standstill_faults(simulator: Simulator, from_standstill: Case) -> list[str]:
    """Return a sentence on a VUT that does not drive off, if it does not."""
    (driven,) = simulator.run([from_standstill])
    if driven.end.is_error:
        return [
            f"From standstill the VUT ends as VUT_ERROR at t = {driven.t_end_s} s: {driven.error}"
        ]
    if driven.end is End.TIMEOUT and not driven.v_vut_mps.any():
        return ["From standstill the VUT never starts, although the road becomes free."]
    return []


def _notes(plan: SimulationPlan, driven: Sequence[Trajectory]) -> list[str]:
    """Return sentences on behaviour that is allowed, but may surprise the author of the VUT."""
    in_vain: Counter[str] = Counter()
    for trajectory in driven:
        in_vain.update(trajectory.in_vain)
    return doubts(plan.criterion.outcomes(driven, None), in_vain)


def _ordinary_cases(scenario: Scenario) -> list[Case]:
    """Return 16 level-0 cases over the start and the speed of the POV."""
    starts_and_speeds = list(product((0.0, 0.25, 0.5, 0.75), (0.0, 0.3, 0.6, 0.9)))
    points = np.full((len(starts_and_speeds), len(scenario.dimensions(0))), 0.5)
    # The first two coordinates are start and speed of the POV; all others stay in the middle.
    points[:, :2] = starts_and_speeds
    return from_unit(points, 0, scenario=scenario)


class _Timed(DriverWrapper):
    """Measures the time of each step, divided by the number of episodes that it drives, in us."""

    def __init__(self, driver: Driver) -> None:
        super().__init__(driver)
        self.us_per_step: list[float] = []

    def act(self, scene: Scene) -> FloatArray:
        start_s = perf_counter()
        answer = self._driver.act(scene)
        spent_s = perf_counter() - start_s
        self.us_per_step.append(spent_s * 1e6 / max(int(scene.active.sum()), 1))
        return answer
