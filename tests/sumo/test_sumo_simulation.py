"""The SUMO simulation against the paper's equations of motion, and episodes in it."""

# mypy: no-strict-optional

from __future__ import annotations

import numpy as np
import pytest
from support.plans import POVS

from merge_sumo.drivers.level0 import Level0Vut
from merge_sumo.metrics.measures import Measures
from merge_sumo.scenario.case import from_unit
from merge_sumo.scenario.scenario import US23
from merge_sumo.scenario.trajectory import End
from merge_sumo.simulation.povs import PovLibrary
from merge_sumo.simulation.rollout import Rollout
from merge_sumo.sumo.sumo_simulation import SimulationError, SumoSimulation


@pytest.mark.parametrize("speed_mps", [29.0, 31.0])
def test_a_speed_that_is_not_what_sumo_was_told_shows_in_the_next_step(speed_mps):
    with SumoSimulation(1, scenario=US23) as simulation:
        simulation.place(0, [(-300.0, 30.0), (-182.0, 18.0)])
        simulation.advance()
        simulation.command(np.zeros((2, 1)))
        simulation._set_speed("pov.0", speed_mps)
        simulation.advance()
        with pytest.raises(SimulationError, match=r"0\.1.* m away from where it drives"):
            simulation.command(np.zeros((2, 1)))


@pytest.mark.parametrize("half_step", ["advance", "command"])
def test_when_sumo_fails_the_running_cases_are_sim_errors_and_the_others_go_on(
    monkeypatch, half_step
):
    cases = from_unit(np.random.default_rng(0).random((30, 2)), level=0, scenario=US23)
    with SumoSimulation(4, scenario=US23) as simulation:
        call, calls = getattr(simulation, half_step), iter(range(10_000))

        def failing(*arguments):
            if next(calls) == 50:
                raise SimulationError("the simulation broke")
            call(*arguments)

        monkeypatch.setattr(simulation, half_step, failing)
        trajectories = Rollout(simulation, PovLibrary(4, POVS), Level0Vut(4), cases).run()
    broken = [t for t in trajectories if t.end is End.SIM_ERROR]
    assert len(broken) == 4
    assert all("the simulation broke" in t.error for t in broken)
    assert all(len(t.motion) > 0 for t in broken)
    assert all(Measures.of(t).score is None for t in broken)
    assert sum(t.end is End.MERGED for t in trajectories) == 26
