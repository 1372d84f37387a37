"""The simulator: a VUT and the POVs in SUMO, in the process that runs the cases."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from contextlib import ExitStack
from typing import Self

from merge_sumo.drivers.actuation import ActuatedDriver
from merge_sumo.drivers.base import Driver
from merge_sumo.drivers.lane import LanePov
from merge_sumo.drivers.sensing import SensedDriver
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import Scenario
from merge_sumo.scenario.trajectory import Trajectory
from merge_sumo.simulation.kinematic_world import EquationWorld
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.simulation.povs import PovLibrary, Povs
from merge_sumo.simulation.rollout import Rollout
from merge_sumo.sumo.world import World


class Simulator:
    """A VUT and the POVs in a world; to be used in `with`.

    Example:
        with Simulator(plan) as simulator:
            trajectories = simulator.run(cases)

    Attributes:
        world: the world of SUMO, or of the engine of a subclass.
        in_sumo: indices of the cases of the last `run` that SUMO ran.
        ran_again: indices of those that ran again, because a process was ended from outside.
    """

    world: World | EquationWorld
    vut: Driver
    pov: Driver
    in_sumo: Collection[int] = ()
    ran_again: Collection[int] = ()

    def __init__(self, plan: SimulationPlan) -> None:
        """Start SUMO and the drivers, with the number of corridors that all of these can serve."""
        own = plan.povs.own
        car_type = None if own is None else own.vut_type
        with ExitStack() as opened:
            world = World(
                *(corridors_of(plan, plan.corridors), plan.road, plan.vut.vut_type),
                scenario=plan.scenario,
                car_type=car_type,
            )
            opened.callback(world.close)
            self._open_drivers(plan, world, opened)

    def _open_drivers(
        self, plan: SimulationPlan, world: World | EquationWorld, opened: ExitStack
    ) -> None:
        """Start the drivers.

        Args:
            plan: the plan that names them.
            world: the world in which they drive.
            opened: closes them and the world.
        """
        self.world, scenario = world, plan.scenario
        sumo = world if isinstance(world, World) else None
        self.vut = plan.vut.open(world.corridors, sumo)
        if not scenario.sense.is_perfect:
            self.vut = SensedDriver(self.vut)
        if not scenario.act.is_perfect:
            self.vut = ActuatedDriver(self.vut)
        opened.callback(self.vut.close)
        self.pov = povs_for(scenario, plan.povs, world.corridors, sumo)
        opened.callback(self.pov.close)
        self._opened = opened.pop_all()

    def run(self, cases: Sequence[Case]) -> list[Trajectory]:
        """Run cases; return their trajectories in order."""
        self.in_sumo = range(len(cases)) if isinstance(self.world, World) else ()
        rollout = Rollout(self.world, self.pov, self.vut, cases)
        self.ran_again = rollout.unexplained
        return rollout.run()

    def close(self) -> None:
        """Stop the POVs, the VUT, then SUMO."""
        self._opened.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def corridors_of(plan: SimulationPlan, most: int) -> int:
    """Return the number of corridors, `most` or fewer, that VUT and POVs of a plan can serve."""
    corridors = min(most, plan.vut.max_corridors or most)
    return plan.povs.corridors(corridors, plan.scenario.vehicles - 1)


def povs_for(scenario: Scenario, povs: Povs, corridors: int, sumo: World | None = None) -> Driver:
    """Return the drivers of the mainline of a scenario, for the cars of K `corridors`.

    Args:
        scenario: the scenario.
        povs: drivers of the POV by level.
        corridors: number of corridors, K.
        sumo: the simulation, for drivers of SUMO.
    """
    library = PovLibrary(corridors * (scenario.vehicles - 1), povs, sumo)
    drives_on = scenario.lane_m is not None or scenario.follow_up_s > 0.0
    return LanePov(library) if drives_on else library
