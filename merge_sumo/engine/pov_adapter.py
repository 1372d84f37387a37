"""A controller that was written as a VUT, in the POV's seat: it drives on the mainline.

It is told and shown what it would be as a VUT: itself as the VUT, and the vehicle under test as the
POV. So the same file works in either seat.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

from merge_sumo.drivers.base import Driver, PovLostError, Scene, VutLostError
from merge_sumo.sumo.world import World
from merge_sumo.values.case import Case, FloatArray
from merge_sumo.values.scenario import VUT
from merge_sumo.vuts.registry import VutFactory
from merge_sumo.vuts.sumo_model import SumoVut

BEFORE_M: Final = -1e-9
"""A VUT starts before M; a car of the mainline may start there or past it."""


def in_the_povs_seat(own: VutFactory, corridors: int, world: World | None) -> Driver:
    """Return the driver of the C cars of the mainline of a world, for `corridors` = C K."""
    driver = own(corridors, world)
    if isinstance(driver, SumoVut):  # SUMO knows where its vehicles are
        mainline = [row for row in range(driver.world.vehicles) if row != VUT]
        return SumoVut(corridors, driver.world, mainline)
    return PovAdapter(driver)


class PovAdapter(Driver):
    """Drives cars of the mainline by a driver of VUTs; `corridors` are those of all C cars."""

    def __init__(self, driver: Driver) -> None:
        """Take the driver."""
        super().__init__(driver.corridors)
        self._driver = driver

    def begin(self, corridor: int, case: Case) -> None:
        """Tell the driver of an episode as if its car were the VUT."""
        cars = case.scenario.vehicles - 1
        car = corridor * cars // self.corridors
        self._driver.begin(corridor, seen_from(case, car))

    def act(self, scene: Scene) -> FloatArray:
        """Return the driver's answers; raises `PovLostError`."""
        other = Scene(scene.active, scene.step, scene.x_m[::-1], scene.v_mps[::-1])
        try:
            return self._driver.act(other)
        except VutLostError as lost:
            how = {"final": lost.final, "killed": lost.killed}
            raise PovLostError(lost.reason, lost.corridor, **how) from lost

    def reason(self, corridor: int) -> str | None:
        """Return what the driver did wrong in a corridor."""
        return self._driver.reason(corridor)

    def files(self) -> tuple[Path, ...]:
        """Return the files that the driver has loaded so far."""
        return self._driver.files()

    def close(self) -> None:
        """Close the driver."""
        self._driver.close()


def seen_from(case: Case, car: int) -> Case:
    """Return a case as a VUT in the place of a car of the mainline would be told it."""
    starts = case.starts()
    x_other_m, v_other_mps = starts.pop(VUT)
    x_m, v_mps = starts[car]
    scenario = replace(
        case.scenario,
        x_vut0_m=min(x_m, BEFORE_M),
        v_vut0_mps=v_mps,
        headway_ahead_s=None,
        headway_behind_s=None,
    )
    return Case(
        level=0,
        x_pov0_m=x_other_m,
        v_pov0_mps=v_other_mps,
        v_vut0_mps=v_mps,
        scenario=scenario,
    )
