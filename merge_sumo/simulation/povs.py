"""The drivers of the POV at each level, and the value from which each process opens them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from merge_sumo.controllers.kinds import load
from merge_sumo.controllers.spec import ControllerKind, ControllerOptions
from merge_sumo.controllers.sumo_model import SumoVut
from merge_sumo.drivers.base import Driver, DriverWrapper, PovLostError, Scene, VutLostError
from merge_sumo.drivers.level0 import Level0Pov
from merge_sumo.drivers.policies import (
    how_to_train,
    load_driver,
    policies_in,
    policies_of,
    policies_sha256,
)
from merge_sumo.errors import UserError
from merge_sumo.files import Files
from merge_sumo.scenario.case import Case, FloatArray, ToldCase
from merge_sumo.scenario.scenario import (
    ALL_LEVELS,
    OWN,
    VUT,
    AnyLevels,
    Scenario,
    level_name,
    names_of_levels,
)
from merge_sumo.sumo.world import World

POLICIES = {1: "pov1", 2: "pov2"}
"""The learned POVs by their level."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Povs:
    """The POVs of all levels.

    Attributes:
        policies: folder of the networks that drive at levels 1 and 2.
        own: makes the controller that drives at level own; None without one.
    """

    policies: Path
    own: ControllerKind | None = None

    @property
    def levels(self) -> tuple[int, ...]:
        """The levels for which there is a POV; level 0 needs no policy."""
        return levels_in(self.policies, own=self.own is not None)

    def check_level(self, level: int) -> None:
        """Raise `UserError` where there is no POV of a level."""
        check_level(level, self.policies, own=self.own is not None)

    def sha256(self) -> dict[str, str]:
        """Return the hashes of the policies by name."""
        return policies_sha256(self.policies)

    @property
    def files(self) -> Files:
        """The files of the user's POV, as far as they are known before it drives."""
        return {} if self.own is None else self.own.files or {}

    def with_log(self, log: Path) -> Povs:
        """Return the same POVs, with the output of the user's POV added to a file."""
        return self if self.own is None else replace(self, own=self.own.with_log(log))

    def corridors(self, asked: int, cars: int) -> int:
        """Return how many corridors with `cars` cars on the mainline are served of those asked."""
        if self.own is None or self.own.max_corridors is None:
            return asked
        most = self.own.max_corridors
        if most < cars:
            raise UserError(f"the POV {self.own.spec}: it drives {most} car at a time, not {cars}")
        return min(asked, most // cars)


CHOICE = "0, 1, 2, several with commas, all alone, or own with `pov`"
ONE = "0, 1 or 2, or own with `pov`"


def levels_in(policies: Path, *, own: bool) -> tuple[int, ...]:
    """Return the levels for which there is a POV; level 0 needs no policy."""
    trained = policies_sha256(policies)
    learned = [level for level, name in POLICIES.items() if name in trained]
    return (0, *learned, OWN) if own else (0, *learned)


def check_level(level: int, policies: Path, *, own: bool) -> None:
    """Raise `UserError` where there is no POV of a level.

    Args:
        level: level of the POV.
        policies: folder of the networks.
        own: whether the user names a POV.
    """
    if level not in ALL_LEVELS:
        raise UserError(f"there is no POV level {level}: choose {CHOICE}")
    if level == OWN and not own:
        raise UserError("`level` own is a POV that you bring: name it with `pov`")
    if level not in levels_in(policies, own=own):
        raise UserError(f"there is no policy for a POV of level {level}{how_to_train(policies)}")


def parse_levels(
    asked: AnyLevels,
    policies: Path,
    *,
    own: bool,
    choice: str = CHOICE,
) -> tuple[int, ...]:
    """Return the named levels in their order; "all" are those that have a POV.

    Args:
        asked: names of levels.
        policies: folder of the networks.
        own: whether the user brings a POV.
        choice: the end of the message for an unknown name.

    Raises:
        UserError: for an unknown name, or if the user's POV would not drive.
    """
    names = names_of_levels(asked)
    if names == ("all",):
        return levels_in(policies, own=own)
    by_name = {level_name(level): level for level in ALL_LEVELS}
    for name in names:
        if name not in by_name:
            raise UserError(f"there is no POV level {name!r}: choose {choice}")
        check_level(by_name[name], policies, own=own)
    if own and level_name(OWN) not in names:
        raise UserError(f"`pov` drives at `level` own or all, not at `level` {','.join(names)}")
    return tuple(level for name, level in by_name.items() if name in names)


def one_level(text: str, policies: Path, *, own: bool) -> int:
    """Return the one level of a name.

    Args:
        text: the name.
        policies: folder of the networks.
        own: whether the user brings a POV.
    """
    if text == "all" or "," in text:
        raise UserError(f"`level` {text} does not go here: choose {ONE}")
    return parse_levels(text, policies, own=own, choice=ONE)[0]


def policies_folder(policies: str | Path | None, scenario: Scenario) -> Path:
    """Return the named folder of policies, by default the shipped one for a scenario."""
    return policies_of(scenario) if policies is None else policies_in(policies)


def own_pov(text: str, options: ControllerOptions) -> ControllerKind:
    """Return what makes the POV that a spec names; `UserError` for what cannot be one.

    It is any VUT that can drive on the mainline, and is hosted with the same options.
    """
    try:
        own = load(text, options)
    except UserError as error:
        raise UserError(f"the POV {text}: {str(error).removeprefix(f'{text}: ')}") from error
    if why := own.no_pov:
        raise UserError(f"the POV {text}: {why}")
    return own


class PovLibrary(Driver):
    """Plays a POV of level 0, 1 or 2, or the user's own, corridor by corridor."""

    def __init__(self, corridors: int, povs: Povs, world: World | None = None) -> None:
        """Prepare the drivers of all available levels."""
        super().__init__(corridors)
        self._drivers: dict[int, Driver] = {0: Level0Pov(corridors)}
        for level in set(povs.levels) & set(POLICIES):
            self._drivers[level] = load_driver(POLICIES[level], corridors, povs.policies)
        if povs.own is not None:
            driver = povs.own.open(corridors, world)
            if isinstance(driver, SumoVut):  # SUMO knows where its vehicles are
                mainline = [row for row in range(driver.world.vehicles) if row != VUT]
                self._drivers[OWN] = SumoVut(corridors, driver.world, mainline)
            else:
                self._drivers[OWN] = PovAdapter(driver)
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
                of_level = scene._replace(active=mine)
                acceleration[mine] = self._drivers[level].act(of_level)[mine]
        return acceleration

    def reason(self, corridor: int) -> str | None:
        """Return what the driver of a corridor did wrong."""
        return self._drivers[int(self._level[corridor])].reason(corridor)

    def files(self) -> tuple[Path, ...]:
        """Return the files that the user's POV has loaded so far."""
        return self._drivers[OWN].files() if OWN in self._drivers else ()

    def close(self) -> None:
        """Close the drivers."""
        for driver in self._drivers.values():
            driver.close()


BEFORE_M = -1e-9
"""A VUT starts before M; a car of the mainline may start there or past it."""


class PovAdapter(DriverWrapper):
    """Drives cars of the mainline by a driver of VUTs; `corridors` are those of all C cars."""

    def begin(self, corridor: int, case: Case) -> None:
        """Tell the driver of an episode as if its car were the VUT."""
        cars = case.scenario.vehicles - 1
        car = corridor * cars // self.corridors
        self._driver.begin(corridor, seen_from(case, car))

    def act(self, scene: Scene) -> FloatArray:
        """Return the driver's answers; raises `PovLostError`."""
        other = scene._replace(x_m=scene.x_m[::-1], v_mps=scene.v_mps[::-1])
        try:
            return self._driver.act(other)
        except VutLostError as lost:
            raise PovLostError(str(lost)) from lost


def seen_from(case: Case, car: int) -> Case:
    """Return a case as a VUT in the place of a car of the mainline would be told it.

    It is on the mainline from the beginning, and has no acceleration lane.
    """
    starts = case.starts()
    x_other_m, v_other_mps = starts.pop(VUT)
    x_m, v_mps = starts[car]
    place: dict[str, Any] = {"x_vut0_m": min(x_m, BEFORE_M), "v_vut0_mps": v_mps}
    if case.scenario.lane_m is not None:
        place["lane_m"] = None
    scenario = replace(case.scenario, **place)
    told = (x_other_m, v_other_mps), (x_m, v_mps)
    return ToldCase(level=0, v_vut0_mps=v_mps, draw=case.draw, scenario=scenario, told=told)
