"""A rule-based VUT for entries where one gives way: it takes a gap, or waits at a line for one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from merge_sumo.drivers.base import BuiltInVut, Design, Scene
from merge_sumo.drivers.level0 import Level0Vut, level0_time_to
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S, US23

STANDS_MPS: Final = 1e-3
"""A POV that is slower is taken to be as fast as this: it is due at M in hours."""


@dataclass(frozen=True, kw_only=True, slots=True)
class GapDesign(Design):
    """Parameters of a VUT that accepts gaps.

    Attributes:
        line_m: distance before M of the line at which it waits.
        lead_s: it goes first where the POV is due at M at least this much after it.
        lag_s: it goes second where the POV is due at M at least this much before it.
        brake_mps2: it begins to brake when to stop at the line takes as much, positive.
    """

    line_m: float
    lead_s: float
    lag_s: float
    brake_mps2: float


ROUNDABOUT: Final = GapDesign(line_m=7.0, lead_s=1.8, lag_s=2.0, brake_mps2=1.5)
"""Noses in 4 m over the yield line. `policies/roundabout/README.md` says how it was chosen."""


class GapAcceptanceVut(Level0Vut):
    """Waits for a gap, and takes the first one by the level-0 profile without looking again.

    A gap is one where both are not due at M at about the same time, if the POV keeps its speed and
    the VUT follows the profile. Without one it goes on at its speed and brakes to stop at the line;
    where it cannot stop there any more it goes.
    """

    def __init__(self, corridors: int, design: GapDesign = ROUNDABOUT) -> None:
        """Prepare a controller of this design for each corridor."""
        super().__init__(corridors)
        self.design = design
        self._goes = np.zeros(corridors, dtype=bool)
        self._a_min = np.full(corridors, US23.a_min_mps2)

    def begin(self, corridor: int, case: Case) -> None:
        """Look for a gap again; take the profile and the limits of the case's scenario."""
        super().begin(corridor, case)
        self._goes[corridor] = False
        self._a_min[corridor] = case.scenario.a_min_mps2

    def act(self, scene: Scene) -> FloatArray:
        """Return the level-0 acceleration where it goes, else what it takes to stop at the line."""
        design, v = self.design, scene.v_vut_mps
        # In the seat of a POV it drives on behind M.
        distance_m = np.maximum(-scene.x_vut_m, 0.0)
        due_s = level0_time_to(distance_m, v, self.a_mps2, self.v_cruise_mps)
        later_s = -scene.x_pov_m / np.maximum(scene.v_pov_mps, STANDS_MPS) - due_s
        # Eq. (4) moves by the speed before the step: to stop takes half a step's way more.
        room_m = distance_m - design.line_m - 0.5 * DT_S * v
        needed = 0.5 * v * v / np.maximum(room_m, 1e-9)
        self._goes |= (later_s >= design.lead_s) | (later_s <= -design.lag_s)
        self._goes |= needed > -self._a_min
        waits = np.where(needed >= design.brake_mps2, -needed, 0.0)
        answer: FloatArray = np.where(self._goes, super().act(scene), waits)
        return answer


VUTS: Final = {"roundabout": BuiltInVut(GapAcceptanceVut, ROUNDABOUT)}
