"""The POV: one driver that plays, in each corridor, the level that the case asks for."""

from __future__ import annotations

import numpy as np

from merge_sumo.drivers.base import Driver, Scene
from merge_sumo.drivers.level0 import Level0Pov
from merge_sumo.drivers.policies import load_driver
from merge_sumo.drivers.povs import POLICIES, Povs
from merge_sumo.values.case import Case, FloatArray


class PovLibrary(Driver):
    """Plays a POV of level 0, 1 or 2, corridor by corridor."""

    def __init__(self, corridors: int, povs: Povs | None = None) -> None:
        """Prepare the drivers of all available levels, by default of the paper's scenario."""
        super().__init__(corridors)
        povs = povs or Povs()
        self._drivers: dict[int, Driver] = {0: Level0Pov(corridors)}
        for level in povs.levels[1:]:
            self._drivers[level] = load_driver(POLICIES[level], corridors, povs.policies)
        self._level = np.zeros(corridors, dtype=np.int64)
        self._levels_playing = {0}

    def begin(self, corridor: int, case: Case) -> None:
        """Take the level of a case; KeyError when it has no policy."""
        self._drivers[case.level].begin(corridor, case)
        self._level[corridor] = case.level
        self._levels_playing.add(case.level)

    def act(self, scene: Scene) -> FloatArray:
        """Return each corridor's answer by the driver of its level."""
        levels = self._levels_playing
        if levels == {0}:
            return self._drivers[0].act(scene)
        acceleration = np.zeros(self.corridors)
        for level in levels:
            mine = self._level == level
            acceleration[mine] = self._drivers[level].act(scene)[mine]
        return acceleration
