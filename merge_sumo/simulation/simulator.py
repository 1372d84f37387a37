"""The simulator: a VUT and the POVs in SUMO, in the process that runs the cases."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from contextlib import ExitStack
from typing import Self

from merge_sumo.drivers.actuation import ActuatedDriver
from merge_sumo.drivers.after_merge import PovAfterMerge
from merge_sumo.drivers.base import Driver
from merge_sumo.drivers.sensing import SensedDriver
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.trajectory import Trajectory
from merge_sumo.simulation.kinematic_simulation import KinematicSimulation
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.simulation.povs import PovLibrary
from merge_sumo.simulation.rollout import Rollout
from merge_sumo.sumo.sumo_simulation import SumoSimulation


class Simulator:
    """A VUT and the POVs in a simulation; to be used in `with`.

    Example:
        with Simulator(plan) as simulator:
            trajectories = simulator.run(cases)

    Attributes:
        simulation: the simulation of SUMO, or that of a subclass.
        vut: drives the VUTs of all corridors.
        pov: drives the cars of the mainline in all corridors.
        in_sumo: indices of the cases of the last `run` that SUMO ran.
        ran_again: indices of those that ran again after a loss that no case explains.
    """

    simulation: SumoSimulation | KinematicSimulation
    vut: Driver
    pov: Driver
    in_sumo: Collection[int] = ()
    ran_again: Collection[int] = ()

    def __init__(self, plan: SimulationPlan) -> None:
        """Start SUMO and the drivers, with the number of corridors that all of these can serve.

        Args:
            plan: the plan.

        Raises:
            UserError: if the plan cannot be carried out.
        """
        own = plan.povs.own
        with ExitStack() as opened:
            simulation = SumoSimulation(
                corridors_of(plan, plan.corridors),
                plan.road,
                plan.vut.vut_type,
                scenario=plan.scenario,
                car_type=None if own is None else own.vut_type,
            )
            opened.callback(simulation.close)
            self._open_drivers(plan, simulation, opened)

    def _open_drivers(
        self,
        plan: SimulationPlan,
        simulation: SumoSimulation | KinematicSimulation,
        opened: ExitStack,
    ) -> None:
        """Start the drivers.

        Args:
            plan: the plan that names them.
            simulation: the simulation in which they drive.
            opened: closes them and the simulation.
        """
        self.simulation, scenario = simulation, plan.scenario
        sumo = simulation if isinstance(simulation, SumoSimulation) else None
        self.vut = plan.vut.open(simulation.corridors, sumo)
        if not scenario.sense.is_perfect:
            self.vut = SensedDriver(self.vut)
        if not scenario.act.is_perfect:
            self.vut = ActuatedDriver(self.vut)
        opened.callback(self.vut.close)
        cars = simulation.corridors * (scenario.vehicles - 1)
        self.pov = PovLibrary(cars, plan.povs, sumo)
        if scenario.lane_m is not None or scenario.follow_up_s > 0.0:
            self.pov = PovAfterMerge(self.pov)
        opened.callback(self.pov.close)
        self._opened = opened.pop_all()

    def run(self, cases: Sequence[Case]) -> list[Trajectory]:
        """Run cases; return their trajectories in order.

        Args:
            cases: cases of the scenario of the plan.
        """
        self.in_sumo = range(len(cases)) if isinstance(self.simulation, SumoSimulation) else ()
        rollout = Rollout(self.simulation, self.pov, self.vut, cases)
        trajectories = rollout.run()
        self.ran_again = rollout.ran_again
        return trajectories

    def close(self) -> None:
        """Stop the POVs, the VUT, then SUMO."""
        self._opened.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def corridors_of(plan: SimulationPlan, most: int) -> int:
    """Return the number of corridors that VUT and POVs of a plan can serve.

    Args:
        plan: the plan.
        most: largest number.

    Raises:
        UserError: if the POV of the user drives fewer cars than the scenario has.
    """
    corridors = min(most, plan.vut.max_corridors or most)
    return plan.povs.corridors(corridors, plan.scenario.vehicles - 1)
