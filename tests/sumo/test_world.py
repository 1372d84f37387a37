"""The SUMO world against the paper's equations of motion, and episodes in it."""

# mypy: no-strict-optional

from __future__ import annotations

import numpy as np
import pytest
from plans import POVS

from merge_sumo.drivers.base import Driver
from merge_sumo.drivers.level0 import Level0Vut
from merge_sumo.engine.povs import PovLibrary
from merge_sumo.engine.rollout import Rollout
from merge_sumo.scenario.case import Case, from_unit
from merge_sumo.scenario.scenario import DT_S, US23
from merge_sumo.scenario.trajectory import End
from merge_sumo.sumo.world import SimulationError, World
from merge_sumo.verdict.score import measure
from merge_sumo.vuts.factory import VutFactory

EXACT = 1e-9


def random_cases(count: int, seed: int = 0) -> list[Case]:
    return from_unit(np.random.default_rng(seed).random((count, 2)), level=0, scenario=US23)


class RandomDriver(Driver):
    """Answers random accelerations that depend on case and step only, not on the corridor."""

    def __init__(self, corridors, brake_first_steps=0):
        super().__init__(corridors)
        self.rngs: list[np.random.Generator] = [None] * corridors
        self.brake_first_steps = brake_first_steps

    def begin(self, corridor, case):
        self.rngs[corridor] = np.random.default_rng(int(case.x_pov0_m * -1e9))

    def act(self, scene):
        answer = np.zeros(self.corridors)
        for k in np.flatnonzero(scene.active):
            answer[k] = self.rngs[k].uniform(US23.a_min_mps2, US23.a_max_mps2)
            if scene.step[k] < self.brake_first_steps:
                answer[k] = US23.a_min_mps2
            elif self.brake_first_steps:
                answer[k] = abs(answer[k]) / 2
        return answer


def run_all(world, pov, vut, cases):
    return Rollout(world, pov, vut, cases).run()


def assert_eq4(trajectory):
    """Integrate eq. (4) with the recorded accelerations and compare every row."""
    for row in range(trajectory.motion.shape[1]):
        x, v, a = trajectory.motion[:, row].T
        expected_x, expected_v = x[0], v[0]
        for t in range(len(x) - 1):
            expected_x, expected_v = expected_x + expected_v * DT_S, expected_v + a[t] * DT_S
            assert abs(x[t + 1] - expected_x) < EXACT
            assert abs(v[t + 1] - expected_v) < EXACT


def test_sumo_moves_random_episodes_by_eq_4_at_every_step_with_refills():
    corridors, cases = 32, random_cases(300)
    with World(corridors, scenario=US23) as world:
        trajectories = run_all(world, RandomDriver(corridors), RandomDriver(corridors), cases)
    lengths = {len(t.motion) for t in trajectories}
    assert len(lengths) > 5, "refills happen at different times"
    assert any((t.v_vut_mps == 0).any() or (t.v_pov_mps == 0).any() for t in trajectories)
    for trajectory in trajectories:
        assert_eq4(trajectory)


def test_a_vehicle_brakes_to_a_stand_stays_there_and_starts_again():
    case = random_cases(1)[0]
    with World(2, scenario=US23) as world:
        (trajectory,) = run_all(
            world, PovLibrary(2, POVS), RandomDriver(2, brake_first_steps=60), [case]
        )
    stand = trajectory.v_vut_mps == 0.0
    assert stand.sum() >= 10
    assert not stand[-1]
    assert np.ptp(trajectory.x_vut_m[stand]) == 0.0
    assert_eq4(trajectory)


def test_episodes_are_the_same_in_1_and_in_32_corridors():
    cases = random_cases(300, seed=1)
    outcomes = []
    for corridors in (1, 32):
        with World(corridors, scenario=US23) as world:
            vut = VutFactory.of("design2")(corridors)
            outcomes.append(run_all(world, PovLibrary(corridors, POVS), vut, cases))
    for one, many in zip(*outcomes, strict=True):
        assert np.array_equal(one.motion, many.motion)
        assert measure(one) == measure(many)


@pytest.mark.parametrize("speed_mps", [29.0, 31.0])
def test_a_speed_that_is_not_what_sumo_was_told_shows_in_the_next_step(speed_mps):
    with World(1, scenario=US23) as world:
        world.place(0, [(-300.0, 30.0), (-182.0, 18.0)])
        world.step(np.zeros((2, 1)))
        world._set_speed("pov.0", speed_mps)
        with pytest.raises(SimulationError, match=r"0\.1.* m away from where it drives"):
            world.step(np.zeros((2, 1)))


@pytest.mark.parametrize("half_step", ["advance", "command"])
def test_when_sumo_fails_the_running_cases_are_sim_errors_and_the_others_go_on(
    monkeypatch, half_step
):
    cases = random_cases(30)
    with World(4, scenario=US23) as world:
        call, calls = getattr(world, half_step), iter(range(10_000))

        def failing(*arguments):
            if next(calls) == 50:
                raise SimulationError("the simulation broke")
            call(*arguments)

        monkeypatch.setattr(world, half_step, failing)
        trajectories = run_all(world, PovLibrary(4, POVS), Level0Vut(4), cases)
    broken = [t for t in trajectories if t.end is End.SIM_ERROR]
    assert len(broken) == 4
    assert all("the simulation broke" in t.error for t in broken)
    assert all(len(t.motion) > 0 for t in broken)
    assert all(measure(t).score is None for t in broken)
    assert sum(t.end is End.MERGED for t in trajectories) == 26
