"""What the tests of all kinds of VUT share: cases, and running them in a real SUMO simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from support.plans import plan_for
from support.scenes import scene_of

from merge_sumo.controllers.kinds import load
from merge_sumo.controllers.spec import ControllerKind, ControllerOptions
from merge_sumo.drivers.base import Driver, Scene
from merge_sumo.scenario.case import Case, from_unit
from merge_sumo.scenario.scenario import US23, Scenario
from merge_sumo.scenario.trajectory import Trajectory
from merge_sumo.simulation.simulator import Simulator

LEVEL0_CLASS = """
class Level0:
    def act(self, seen):
        return min(max((28.0 - seen.v_vut_mps) / 0.1, 0.0), 1.0)
"""


LANE = replace(US23, lane_m=(-70.0, 130.0), follow_up_s=5.0)
"""The paper's ramp with an acceleration lane."""
ON_LANE = Case(level=0, x_pov0_m=-250.0, v_pov0_mps=30.0, scenario=LANE)


def on_lane(x_vut_m: Sequence[float], merged: Sequence[bool] | None = None) -> Scene:
    """Return a scene of VUTs at 20 m/s, each with a POV at 30 m/s 30 m behind it."""
    x_m = np.array(x_vut_m)
    known = np.zeros(len(x_m), dtype=bool) if merged is None else np.array(merged)
    return scene_of(x_m - 30.0, 30.0, x_m, 20.0, step=7)._replace(merged=known)


def begin(driver: Driver, case: Case = ON_LANE) -> None:
    """Begin an episode in each corridor."""
    for corridor in range(driver.corridors):
        driver.begin(corridor, case)


def cases_of(count: int, seed: int = 0) -> list[Case]:
    return from_unit(np.random.default_rng(seed).random((count, 2)), level=0, scenario=US23)


def factory(spec: object, **options: Any) -> ControllerKind:
    return load(str(spec), ControllerOptions(**options))


def in_process(spec: object, **options: Any) -> ControllerKind:
    """Return a VUT that drives in this process; `test_hosted.py` has those in another one."""
    return factory(spec, in_process=True, **options)


def run_cases(vut: ControllerKind, cases: list[Case], corridors: int = 8) -> list[Trajectory]:
    """Return what became of every case of a scenario, in order."""
    plan = plan_for(vut, scenario=cases[0].scenario, corridors=corridors)
    with Simulator(plan) as ground:
        return ground.run(cases)


def same(ones: list[Trajectory], others: list[Trajectory]) -> bool:
    """Return whether cases end alike, with the same motions to the last bit."""
    pairs = zip(ones, others, strict=True)
    return all(a.end is b.end and np.array_equal(a.motion, b.motion) for a, b in pairs)


def run_on(
    vut: ControllerKind, scenario: Scenario, level: int, count: int, corridors: int = 8
) -> list[Trajectory]:
    """Return what became of some cases of a scenario, in order."""
    points = np.random.default_rng(0).random((count, len(scenario.dimensions(level))))
    return run_cases(vut, from_unit(points, level, scenario=scenario), corridors)
