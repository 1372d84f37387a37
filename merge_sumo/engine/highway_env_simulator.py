"""HighwayEnv as the host: its vehicles take the places of SUMO's, and nothing of SUMO runs.

HighwayEnv (Leurent, 2018) moves a vehicle that does not steer by x + v dt and v + a dt, which is
eq. (4). Each vehicle of an episode has a straight lane of its own there, along which it drives its
lane coordinate: bodies do not meet, as they do not where SUMO moves them by command.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from importlib.metadata import version
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.engine.kinematic_world import EquationWorld
from merge_sumo.engine.plan import SimulationPlan
from merge_sumo.engine.simulator import Simulator, corridors_of
from merge_sumo.errors import UserError
from merge_sumo.road.corridor import Corridor
from merge_sumo.sumo.world import MAX_SPEED_MPS
from merge_sumo.values.case import FloatArray
from merge_sumo.values.scenario import DT_S, VUT, Scenario
from merge_sumo.vuts.registry import KINDS, VutFactory, kind_of

PACKAGE: Final = "highway-env"
LANE_WIDTH_M: Final = 4.0
"""That of HighwayEnv."""


def highway_env() -> Any:
    """Import HighwayEnv and return it; `UserError` where it is not installed."""
    from importlib import import_module

    try:
        import_module("highway_env.vehicle.kinematics")
        import_module("highway_env.road.road")
        return import_module("highway_env")
    except ImportError as error:
        raise UserError(
            f"this needs {PACKAGE}, which is not installed: run `pip install 'merge-sumo[peers]'`"
        ) from error


def peer_name() -> str:
    """Return the name of HighwayEnv and its version."""
    highway_env()
    return f"HighwayEnv {version(PACKAGE)}"


def why_sumo_alone(plan: SimulationPlan) -> str | None:
    """Return why the drivers of a plan cannot drive in HighwayEnv, in a clause; None if they can.

    Its `UserError` for a kind of VUT of another package comes when that is made without a world.
    """
    drivers: list[tuple[str, VutFactory | None]] = [("VUT", plan.vut), ("POV", plan.povs.own)]
    for name, driver in drivers:
        if driver is None:
            continue
        if driver.vut.vut_type is not None:
            return f"the {name} {driver.spec} is a model of SUMO, which drives in SUMO alone"
        if kind_of(driver.spec) is KINDS["traci"]:
            return f"the {name} {driver.spec} asks SUMO, by TraCI"
    return None


class HighwayEnvWorld(EquationWorld):
    """The state of the vehicles in `corridors` independent corridors, moved by HighwayEnv.

    `x_m` and `v_mps` have shape (A, corridors), as those of a `World`: read from its vehicles.
    """

    def __init__(self, corridors: int, road: Corridor, scenario: Scenario) -> None:
        """Make a road of HighwayEnv for each corridor; `UserError` where it is not installed."""
        super().__init__(corridors, road, scenario)
        package = highway_env()
        lengths_m = [scenario.pov_length_m] * self.vehicles
        lengths_m[VUT] = scenario.vut_length_m
        base = package.vehicle.kinematics.Vehicle
        limits = {"MAX_SPEED": MAX_SPEED_MPS, "MIN_SPEED": -MAX_SPEED_MPS}
        self._types = [type("Car", (base,), {"LENGTH": one, **limits}) for one in lengths_m]
        """Its vehicles are as long and as fast as those of SUMO."""
        self._half_m: FloatArray = np.array(lengths_m)[:, None] / 2.0
        """It says where the centre of a vehicle is."""
        self._roads = [self._road(package) for _ in range(corridors)]

    def _road(self, package: Any) -> Any:
        """Return a road of HighwayEnv with a straight lane for each vehicle of an episode."""
        network, far_m = package.road.road.RoadNetwork(), self.scenario.room_after_m
        for row in range(self.vehicles):
            ends = [(x_m, row * LANE_WIDTH_M) for x_m in (-self.scenario.reach_m, far_m)]
            network.add_lane("begin", "end", package.road.lane.StraightLane(*ends, LANE_WIDTH_M))
        return package.road.road.Road(network)

    def restart(self) -> None:
        """Park all vehicles."""
        for corridor in range(self.corridors):
            self.park(corridor)

    def place(
        self, corridor: int, starts: Sequence[tuple[float, float]], *, own: bool = False
    ) -> None:
        """Put new vehicles where an episode starts: (x in m, v in m/s) in the order of rows."""
        road = self._roads[corridor]
        road.vehicles = [
            make(road, (x_m - half_m, row * LANE_WIDTH_M), 0.0, v_mps)
            for row, (make, half_m, (x_m, v_mps)) in enumerate(
                zip(self._types, self._half_m[:, 0].tolist(), starts, strict=True)
            )
        ]
        self._read([corridor])

    def park(self, corridor: int) -> None:
        """Take the vehicles of a corridor from its road."""
        self._roads[corridor].vehicles = []
        super().park(corridor)

    def command(self, a_mps2: FloatArray, merged: NDArray[np.bool_] | None = None) -> None:
        """Let HighwayEnv make a step with accelerations, (A, K); no vehicle drives backwards."""
        least = self.v_mps / -DT_S
        actions = np.maximum(a_mps2, least).T.tolist()
        occupied = [k for k, road in enumerate(self._roads) if road.vehicles]
        for corridor in occupied:
            road = self._roads[corridor]
            for vehicle, a in zip(road.vehicles, actions[corridor], strict=True):
                vehicle.act({"steering": 0.0, "acceleration": a})
            road.step(DT_S)
        self.x_m, self.v_mps = self.x_m.copy(), self.v_mps.copy()
        self._read(occupied)

    def _read(self, corridors: Sequence[int]) -> None:
        """Read the state of corridors from their vehicles."""
        for corridor in corridors:
            vehicles = self._roads[corridor].vehicles
            self.x_m[:, corridor] = [vehicle.position[0] for vehicle in vehicles]
            self.v_mps[:, corridor] = [vehicle.speed for vehicle in vehicles]
        self.x_m[:, corridors] += self._half_m


class HighwayEnvSimulator(Simulator):
    """A VUT and the POVs in HighwayEnv, without SUMO."""

    def __init__(self, plan: SimulationPlan) -> None:
        """Start the drivers; `UserError` where they drive in SUMO alone."""
        if why := why_sumo_alone(plan):
            raise UserError(why)
        with ExitStack() as opened:
            world = HighwayEnvWorld(corridors_of(plan, plan.corridors), plan.road, plan.scenario)
            self._open_drivers(plan, world, None, opened)
