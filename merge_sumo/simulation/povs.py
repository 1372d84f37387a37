"""The drivers of the POV at each level, and the plan by which each process opens them."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from merge_sumo.controllers.kinds import load
from merge_sumo.controllers.spec import ControllerKind, ControllerOptions
from merge_sumo.controllers.sumo_model import SumoDriver
from merge_sumo.drivers.base import (
    Driver,
    DriverWrapper,
    EpisodesLostError,
    PovEpisodesLostError,
    Scene,
)
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
from merge_sumo.scenario.case import Case, FloatArray, ObservedCase
from merge_sumo.scenario.scenario import (
    ALL_LEVELS,
    OWN,
    VUT,
    AnyLevels,
    Scenario,
    level_name,
    names_of_levels,
)
from merge_sumo.sumo.sumo_simulation import SumoSimulation

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

    def sha256(self) -> dict[str, str]:
        """Return the hashes of the policies by name."""
        return policies_sha256(self.policies)

    @property
    def files(self) -> Files:
        """The files of the user's POV, as far as they are known before it drives."""
        return {} if self.own is None else self.own.files or {}

    def with_log(self, log: Path) -> Povs:
        """Return the same POVs, with a file for the output of the POV of the user."""
        return self if self.own is None else replace(self, own=self.own.with_log(log))

    def corridors(self, asked: int, cars: int) -> int:
        """Return the number of corridors that are served.

        Args:
            asked: number of corridors that the VUT can serve.
            cars: number of cars on the mainline of each.
        """
        if self.own is None or self.own.max_corridors is None:
            return asked
        most = self.own.max_corridors
        if most < cars:
            raise UserError(f"the POV {self.own.spec} drives {most} car at a time, not {cars}")
        return min(asked, most // cars)


CHOICE = "0, 1, 2, all, or own with `pov`"


def levels_in(policies: Path, *, own: bool) -> tuple[int, ...]:
    """Return the levels for which there is a POV; level 0 needs no policy."""
    trained = policies_sha256(policies)
    levels = [0]
    for level, name in POLICIES.items():
        if name in trained:
            levels.append(level)
    if own:
        levels.append(OWN)
    return tuple(levels)


def parse_levels(asked: AnyLevels, policies: Path, *, own: bool) -> tuple[int, ...]:
    """Return the named levels in their order; "all" are those that have a POV.

    Args:
        asked: names of levels.
        policies: folder of the networks.
        own: whether the user brings a POV.

    Raises:
        UserError: for an unknown name, a level without a POV, or if the POV of the user would not
            drive.
    """
    names = names_of_levels(asked)
    available = levels_in(policies, own=own)
    if names == ("all",):
        return available
    by_name = {level_name(level): level for level in ALL_LEVELS}
    for name in names:
        if name not in by_name:
            raise UserError(f"unknown POV level {name!r}: choose {CHOICE}")
        check_level(by_name[name], available, policies)
    if own and level_name(OWN) not in names:
        raise UserError(f"`pov` drives at `level` own or all, not at `level` {','.join(names)}")
    return tuple(level for name, level in by_name.items() if name in names)


def check_level(level: int, available: Collection[int], policies: Path) -> None:
    """Raise `UserError` if a level does not have a POV.

    Args:
        level: the level.
        available: the levels that have a POV.
        policies: folder of the networks.
    """
    if level in available:
        return
    if level in POLICIES:
        raise UserError(f"no policy for a POV of level {level}{how_to_train(policies)}")
    raise UserError(f"unknown POV level {level_name(level)}: choose {CHOICE}")


def one_level(text: str, policies: Path, *, own: bool) -> int:
    """Return the level of a name.

    Args:
        text: the name.
        policies: folder of the networks.
        own: whether the user brings a POV.
    """
    if text == "all" or "," in text:
        raise UserError(f"`level` {text} is not possible here: choose one level")
    return parse_levels(text, policies, own=own)[0]


def policies_folder(policies: str | Path | None, scenario: Scenario) -> Path:
    """Return the named folder of policies, by default the shipped one for a scenario."""
    return policies_of(scenario) if policies is None else policies_in(policies)


def own_pov(text: str, options: ControllerOptions) -> ControllerKind:
    """Return the kind of the POV that a spec names.

    It is any VUT that can drive on the mainline, and is hosted with the same options.

    Raises:
        UserError: if it cannot be a POV.
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

    def __init__(
        self, corridors: int, povs: Povs, simulation: SumoSimulation | None = None
    ) -> None:
        """Prepare the drivers of all available levels."""
        super().__init__(corridors)
        self._drivers: dict[int, Driver] = {0: Level0Pov(corridors)}
        for level in set(povs.levels) & set(POLICIES):
            self._drivers[level] = load_driver(POLICIES[level], corridors, povs.policies)
        if povs.own is not None:
            driver = povs.own.open(corridors, simulation)
            if isinstance(driver, SumoDriver):  # SUMO knows where its vehicles are
                mainline = [row for row in range(driver.simulation.vehicles) if row != VUT]
                self._drivers[OWN] = SumoDriver(corridors, driver.simulation, mainline)
            else:
                self._drivers[OWN] = PovAdapter(driver)
        self._level = np.zeros(corridors, dtype=np.int64)

    def begin(self, corridor: int, case: Case) -> None:
        """Take the level of a case; KeyError when it has no policy."""
        self._drivers[case.level].begin(corridor, case)
        self._level[corridor] = case.level

    def act(self, scene: Scene) -> FloatArray:
        """Return the answer of the driver of each corridor, (K,); 0 where no episode runs."""
        acceleration = np.zeros(self.corridors)
        for level, driver in self._drivers.items():
            plays = scene.active & (self._level == level)
            if plays.any():
                answer = driver.act(scene._replace(active=plays))
                np.copyto(acceleration, answer, where=plays)
        return acceleration

    def reason(self, corridor: int) -> str | None:
        """Return the error of the driver of a corridor."""
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
        """Return the driver's answers; raises `PovEpisodesLostError`."""
        other = scene._replace(x_m=scene.x_m[::-1], v_mps=scene.v_mps[::-1])
        try:
            return self._driver.act(other)
        except EpisodesLostError as lost:
            raise PovEpisodesLostError(str(lost)) from lost


def seen_from(case: Case, car: int) -> Case:
    """Return a case for a VUT in the place of a car of the mainline.

    It is on the mainline from the beginning, and has no acceleration lane.
    """
    starts = case.starts()
    vut = starts.pop(VUT)
    x_m, v_mps = starts[car]
    x_vut0_m = min(x_m, BEFORE_M)
    scenario = replace(case.scenario, x_vut0_m=x_vut0_m, v_vut0_mps=v_mps, lane_m=None)
    observed = vut, (x_m, v_mps)
    return ObservedCase(
        level=0, v_vut0_mps=v_mps, draw=case.draw, scenario=scenario, observed=observed
    )
