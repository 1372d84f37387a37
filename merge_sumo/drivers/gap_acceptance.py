"""A rule-based VUT for roundabouts: it takes a gap, or waits for one at the yield line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from merge_sumo.drivers.base import BuiltInVut, Design, Scene
from merge_sumo.drivers.level0 import Level0Vut, level0_time_to
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S


@dataclass(frozen=True, kw_only=True, slots=True)
class GapDesign(Design):
    """Parameters of a VUT that accepts gaps.

    Attributes:
        line_m: distance before M of the line at which it waits.
        lead_s: least time by which the POV is due at M after it, for it to go first.
        lag_s: least time by which the POV is due at M before it, for it to go second.
        brake_mps2: deceleration, positive, above which it brakes to stop at the line.
    """

    line_m: float
    lead_s: float
    lag_s: float
    brake_mps2: float


ROUNDABOUT = GapDesign(line_m=7.0, lead_s=1.8, lag_s=2.0, brake_mps2=1.5)
"""The line is 4 m past the yield line. `policies/roundabout/README.md` has the reasons."""


class GapAcceptanceVut(Level0Vut):
    """A VUT that waits for a gap, then takes it by the level-0 profile without a second check.

    There is a gap where the VUT and the POV are not due at M at about the same time, if the POV
    keeps its speed and the VUT follows the profile. Without a gap the VUT keeps its speed and
    brakes to stop at the line. Where it cannot stop there, it goes.

    Attributes:
        design: the parameters.
    """

    def __init__(self, corridors: int, design: GapDesign = ROUNDABOUT) -> None:
        """Begin without a gap in all corridors.

        Args:
            corridors: number of corridors, K.
            design: the parameters.
        """
        super().__init__(corridors)
        self.design = design
        self._goes = np.zeros(corridors, dtype=bool)

    def begin(self, corridor: int, case: Case) -> None:
        """Look for a gap again.

        Args:
            corridor: index of the corridor.
            case: the case of the next episode.
        """
        super().begin(corridor, case)
        self._goes[corridor] = False

    def act(self, scene: Scene) -> FloatArray:
        """Return the level-0 acceleration where it goes, else braking to the line, (K,).

        Args:
            scene: the present state.
        """
        design, v = self.design, scene.v_vut_mps
        distance_m = scene.distance_m
        due_s = level0_time_to(distance_m, v, self.scenario)
        # A standing POV is due in hours.
        later_s = -scene.x_pov_m / np.maximum(scene.v_pov_mps, 1e-3) - due_s
        # Eq. (4) moves by the speed before the step: a stop takes half a step's distance more.
        room_m = distance_m - design.line_m - 0.5 * DT_S * v
        needed = 0.5 * v * v / np.maximum(room_m, 1e-9)
        self._goes |= (later_s >= design.lead_s) | (later_s <= -design.lag_s)
        self._goes |= needed > -self.scenario.a_min_mps2
        waits = np.where(needed >= design.brake_mps2, -needed, 0.0)
        return np.where(self._goes, super().act(scene), waits)


VUTS = {"roundabout": BuiltInVut(GapAcceptanceVut, ROUNDABOUT)}
