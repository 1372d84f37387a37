"""Contracts of what extends merge-sumo: classes of tests that pytest runs in your subclass.

    from merge_sumo.testing import SamplerContract
    from my_package import MySampler

    class TestMySampler(SamplerContract):
        sampler = MySampler

A contract needs no pytest to be imported, and no SUMO unless it says so.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from merge_sumo import api
from merge_sumo.campaigns.run import Run
from merge_sumo.controllers.kinds import load
from merge_sumo.controllers.spec import ControllerKind
from merge_sumo.drivers.base import Scene
from merge_sumo.drivers.policies import policies_of
from merge_sumo.metrics.criterion import Criterion
from merge_sumo.metrics.measures import Measure
from merge_sumo.road.merge import road_of
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.samplers.contract import SamplerContract, play, play_case
from merge_sumo.scenario.case import Case, FloatArray, MergeCase, Pool, ToldCase
from merge_sumo.scenario.imperfection import Sensing
from merge_sumo.scenario.scenario import DT_S, US23, VUT, Scenario
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.scratch import ScratchFolder
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.simulation.povs import Povs
from merge_sumo.simulation.simulator import Simulator
from merge_sumo.sumo.world import World

__all__ = [
    "MeasureContract",
    "SamplerContract",
    "VutContract",
    "assert_sees_late",
    "episode",
    "play",
    "play_case",
]


def episode(case: Case) -> Trajectory:
    """Return an episode without SUMO: every vehicle keeps its speed until the VUT is at M."""
    starts = np.array(case.starts())  # (A, 2) of x and v
    steps = int(np.ceil(-starts[VUT, 0] / (starts[VUT, 1] * DT_S)))
    time_s = np.arange(steps + 1)[:, None] * DT_S
    x_m, v_mps = starts[:, 0] + starts[:, 1] * time_s, np.tile(starts[:, 1], (steps + 1, 1))
    return Trajectory(case, np.stack([x_m, v_mps, np.zeros_like(x_m)], axis=2), End.MERGED, None)


class MeasureContract:
    """What records, conditions and pages rely on in a measure: a pure function of an episode.

    Attributes:
        measure: the measure under test.
        pool: cases of the episodes.
    """

    measure: Measure
    pool: Pool = Pool(levels=(0,), scenario=US23)

    def values(self) -> list[float | None]:
        """Return the values of some episodes."""
        assert self.measure.of is not None
        cases = self.pool.cases(np.random.default_rng(0).random((10, 2)), self.pool.levels[0])
        return [self.measure.of(episode(case), None) for case in cases]

    def test_says_what_it_is(self) -> None:
        assert self.measure.name.isidentifier()
        assert self.measure.about
        assert "\n" not in self.measure.about
        assert not self.measure.about.endswith(".")
        assert self.measure.missing is not None

    def test_is_a_number_or_none_and_the_same_again(self) -> None:
        """Not a number of an array, which a record does not hold."""
        values = self.values()
        assert all(value is None or type(value) is float for value in values)
        assert values == self.values()

    def test_leaves_the_episode_alone(self) -> None:
        """Other measures look at it, too."""
        assert self.measure.of is not None
        (case,) = self.pool.cases(np.full((1, 2), 0.5), self.pool.levels[0])
        trajectory = episode(case)
        before = trajectory.motion.copy()
        self.measure.of(trajectory, None)
        assert np.array_equal(before, trajectory.motion)


_kept: Final[list[ScratchFolder]] = []
"""Folders that stay until the process ends."""


@cache
def campaign_of(vut: str = "level0", scenario: Scenario = US23) -> Run:
    """Return a campaign in SUMO at level 0; its folder stays until the process ends."""
    scratch = ScratchFolder()
    _kept.append(scratch)
    folder = Path(scratch.name) / "run"
    keywords: dict[str, Any] = {"level": 0, "sampler": "uniform", "cases": 20, "seed": 1}
    return api.campaign(vut, out=folder, scenario=scenario, progress=False, **keywords).run


LATE_STEPS: Final = 2
"""By so many steps the sensors are late."""


def assert_sees_late(factory: ControllerKind) -> None:
    """Assert that a VUT with late sensors answers to the log of its episode, shifted.

    It drives once with such sensors; then it is asked again, without any, about the positions and
    speeds of the POV that many steps before, and those of the VUT at the time.
    """
    late = replace(US23, sense=Sensing(delay_s=LATE_STEPS * DT_S))
    case = MergeCase(level=1, x_pov0_m=-260.0, v_pov0_mps=29.0, scenario=late)
    road, povs = road_of(), Povs(policies=policies_of(US23))
    plan = SimulationPlan(
        scenario=late, road=road, vut=factory, povs=povs, criterion=Criterion(), corridors=1
    )
    with Simulator(plan) as simulator:
        (ran,) = simulator.run([case])
    assert ran.error is None
    seen = shifted(ran.motion, LATE_STEPS)
    told = tuple(map(tuple, seen[0, :, :2].tolist()))
    with World(1, road, scenario=US23) as world, closing(factory.open(1, world)) as driver:
        driver.begin(0, ToldCase(level=1, scenario=US23, told=told))
        answers = []
        for step, state in enumerate(seen[:-1]):
            x_m, v_mps = state[:, 0, None], state[:, 1, None]
            scene = Scene(np.array([True]), np.array([step]), x_m, v_mps)
            answers.append(float(driver.act(scene)[0]))
    obeyed = np.clip(answers, US23.a_min_mps2, US23.a_max_mps2)
    assert np.array_equal(obeyed, ran.a_vut_mps2[:-1]), "it answers to something else"


def shifted(motion: FloatArray, steps: int) -> FloatArray:
    """Return a motion, (T + 1, A, 3), with the other cars where they were some steps before.

    Before the start they drove as they start.
    """
    before = np.repeat(motion[:1], steps, axis=0)
    before[:, :, 0] += before[:, :, 1] * (np.arange(-steps, 0) * DT_S)[:, None]
    late = np.concatenate((before, motion))[: len(motion)]
    late[:, VUT] = motion[:, VUT]
    return late


class VutContract:
    """What a campaign relies on in a VUT, at a point and on an acceleration lane.

    Attributes:
        vut: what a person writes after `--vut`.
        scenarios: names of the shipped scenarios in which it drives.
    """

    vut: str
    scenarios: tuple[str, ...] = ("us23", "us23-lane")

    def runs(self) -> list[Run]:
        """Return a campaign in each scenario."""
        return [campaign_of(self.vut, named_scenario(name)) for name in self.scenarios]

    def test_answers_in_every_step(self) -> None:
        for run in self.runs():
            errors = {outcome.measures.error for outcome in run.outcomes}
            assert errors == {None}, run.record["scenario"]

    def test_does_not_depend_on_other_corridors(self) -> None:
        """A case alone has the outcome that it had among others."""
        for run in self.runs():
            for index in (0, 7):
                alone = api.run(self.vut, recorded=(run.folder, index))
                assert alone.measures == run.outcome(index).measures

    def test_sees_with_late_sensors_what_was_before(self) -> None:
        """SUMO's own drivers see in SUMO, and have no sensors."""
        factory = load(self.vut)
        if factory.vut_type is None:
            assert_sees_late(factory)

    def test_is_found_again_by_its_name(self) -> None:
        """A worker is told the name and makes it anew."""
        first, second = (load(self.vut) for _ in range(2))
        assert first == second
        assert first.files == second.files
