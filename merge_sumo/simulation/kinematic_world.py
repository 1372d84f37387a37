"""K corridors that are moved by the paper's equations of motion alone, without SUMO.

SUMO holds the same state to 1e-9 m (`sumo/world.py` checks that in every step), so an episode ends
in the same way. It is for drivers of the package, which need nothing of SUMO.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from merge_sumo.road.corridor import Corridor
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import DT_S, Scenario
from merge_sumo.sumo.world import PARKING_M


class EquationWorld:
    """The state of the vehicles in `corridors` independent corridors, by eq. (4).

    `x_m` and `v_mps` have shape (A, corridors), as those of a `World`.
    """

    vut_type: None = None
    """SUMO drives none of its vehicles."""

    def __init__(
        self, corridors: int, road: Corridor, scenario: Scenario, substeps: int = 1
    ) -> None:
        """Park the vehicles of a scenario on a road; a step is integrated in so many parts."""
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
            own: for a `World` alone.
        """
        for row, (x, v) in enumerate(starts):
            self.x_m[row, corridor], self.v_mps[row, corridor] = x, v

    def park(self, corridor: int) -> None:
        """Put the vehicles of a corridor aside, at a stand before M."""
        self.x_m[:, corridor], self.v_mps[:, corridor] = -PARKING_M, 0.0

    def advance(self) -> None:
        """Do nothing: `command` makes the whole step."""

    def command(self, a_mps2: FloatArray, merged: NDArray[np.bool_] | None = None) -> None:
        """Move all vehicles by one step of eq. (4) with accelerations, (A, corridors).

        Both lanes of a merge have one coordinate, so `merged` changes nothing here.
        """
        if self.substeps > 1:
            self._in_parts(a_mps2)
            return
        self.x_m = self.x_m + self.v_mps * DT_S
        self.v_mps = np.maximum(self.v_mps + a_mps2 * DT_S, 0.0)

    def _in_parts(self, a_mps2: FloatArray) -> None:
        """Move all vehicles by eq. (4) with a shorter step, and the same accelerations.

        An episode that ends in a part stands still for the others: its last row is that part.
        """
        has_ended = self.scenario.has_ended
        goes_on = np.ones(self.corridors, dtype=np.bool_)
        ended_before = has_ended(self.x_m)
        part_s = DT_S / self.substeps
        for _ in range(self.substeps):
            x_m = self.x_m + self.v_mps * part_s
            v_mps = np.maximum(self.v_mps + a_mps2 * part_s, 0.0)
            self.x_m = np.where(goes_on, x_m, self.x_m)
            self.v_mps = np.where(goes_on, v_mps, self.v_mps)
            goes_on = ended_before | ~has_ended(self.x_m)
