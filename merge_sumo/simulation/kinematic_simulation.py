"""The kinematic simulation: K corridors by the equations of motion of the paper, without SUMO.

SUMO holds the same state to 1e-9 m (`sumo/sumo_simulation.py` checks that in every step).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from merge_sumo.road.road import Road
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import DT_S, Scenario
from merge_sumo.sumo.sumo_simulation import PARKING_M


class KinematicSimulation:
    """The state of the vehicles in `corridors` independent corridors, by eq. (4).

    Example:
        simulation = KinematicSimulation(1, road_for(US23), US23)
        simulation.place(0, case.starts())
        simulation.command(a_mps2)

    Attributes:
        corridors: number of corridors.
        vehicles: number of vehicles A in each.
        x_m: positions, (A, corridors).
        v_mps: speeds, (A, corridors).
    """

    def __init__(self, corridors: int, road: Road, scenario: Scenario, substeps: int = 1) -> None:
        """Park the vehicles.

        Args:
            corridors: number of corridors.
            road: the road.
            scenario: the scenario.
            substeps: number of parts in which a step is integrated.
        """
        self.corridors, self.road, self.scenario = corridors, road, scenario
        self.substeps = substeps
        self.vehicles = scenario.vehicles
        self.x_m: FloatArray = np.full((self.vehicles, corridors), -PARKING_M)
        self.v_mps: FloatArray = np.zeros((self.vehicles, corridors))

    def restart(self) -> None:
        """Park all vehicles."""
        self.x_m, self.v_mps = np.full_like(self.x_m, -PARKING_M), np.zeros_like(self.v_mps)

    def place(
        self, corridor: int, starts: Sequence[tuple[float, float]], *, own: bool = False
    ) -> None:
        """Put the vehicles of a corridor where an episode starts.

        Args:
            corridor: the corridor.
            starts: (x in m, v in m/s) of each vehicle, in the order of rows.
            own: for a `SumoSimulation` alone.
        """
        self.x_m[:, corridor], self.v_mps[:, corridor] = np.array(starts).T

    def park(self, corridor: int) -> None:
        """Park the vehicles of a corridor.

        Args:
            corridor: index of the corridor.
        """
        self.x_m[:, corridor], self.v_mps[:, corridor] = -PARKING_M, 0.0

    def advance(self) -> None:
        """Leave the step to `command`; SUMO makes the first half of a step here."""

    def command(self, a_mps2: FloatArray, merged: NDArray[np.bool_] | None = None) -> None:
        """Move all vehicles by one step of eq. (4).

        Args:
            a_mps2: accelerations, (A, corridors).
            merged: not used, because both lanes of a merge have one coordinate.
        """
        if self.substeps > 1:
            self._in_parts(a_mps2)
            return
        self.x_m = self.x_m + self.v_mps * DT_S
        self.v_mps = np.maximum(self.v_mps + a_mps2 * DT_S, 0.0)

    def _in_parts(self, a_mps2: FloatArray) -> None:
        """Move all vehicles by eq. (4) with a shorter step, and the same accelerations.

        An episode that ends in a part stays there for the others.
        """
        has_ended = self.scenario.has_ended
        moves = np.ones(self.corridors, dtype=np.bool_)
        ended_before = has_ended(self.x_m)
        part_s = DT_S / self.substeps
        for _ in range(self.substeps):
            x_m = self.x_m + self.v_mps * part_s
            v_mps = np.maximum(self.v_mps + a_mps2 * part_s, 0.0)
            self.x_m = np.where(moves, x_m, self.x_m)
            self.v_mps = np.where(moves, v_mps, self.v_mps)
            moves = ended_before | ~has_ended(self.x_m)
