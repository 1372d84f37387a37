"""The POV: one driver that plays, in each corridor, the level that the case asks for."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from merge_sumo.drivers.base import Driver, Scene
from merge_sumo.drivers.level0 import Level0Pov
from merge_sumo.drivers.policies import load_driver
from merge_sumo.engine.pov_adapter import in_the_povs_seat
from merge_sumo.engine.povs import POLICIES, Povs
from merge_sumo.sumo.world import World
from merge_sumo.values.case import Case, FloatArray
from merge_sumo.values.scenario import OWN


class PovLibrary(Driver):
    """Plays a POV of level 0, 1 or 2, or one of a person's own, corridor by corridor."""

    def __init__(self, corridors: int, povs: Povs, world: World | None = None) -> None:
        """Prepare the drivers of all available levels."""
        super().__init__(corridors)
        self._drivers: dict[int, Driver] = {0: Level0Pov(corridors)}
        for level in set(povs.levels) & set(POLICIES):
            self._drivers[level] = load_driver(POLICIES[level], corridors, povs.policies)
        if povs.own is not None:
            self._drivers[OWN] = in_the_povs_seat(povs.own, corridors, world)
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
            mine = scene.active & (self._level == level)
            if mine.any():
                of_level = Scene(mine, scene.step, scene.x_m, scene.v_mps)
                acceleration[mine] = self._drivers[level].act(of_level)[mine]
        return acceleration

    def reason(self, corridor: int) -> str | None:
        """Return what the driver of a corridor did wrong."""
        return self._drivers[int(self._level[corridor])].reason(corridor)

    def files(self) -> tuple[Path, ...]:
        """Return the files that a POV of a person's own has loaded so far."""
        return self._drivers[OWN].files() if OWN in self._drivers else ()

    def close(self) -> None:
        """Close the drivers."""
        for driver in self._drivers.values():
            driver.close()
