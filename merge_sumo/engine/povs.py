"""Who drives the POV at each level: a value, so that every process can be told the same."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from merge_sumo.drivers.policies import how_to_train, policies_in, policies_of, policies_sha256
from merge_sumo.errors import UserError
from merge_sumo.values.scenario import ALL_LEVELS, OWN, Scenario, level_name
from merge_sumo.vuts.base import VutOptions
from merge_sumo.vuts.files import Files
from merge_sumo.vuts.registry import VutFactory, kind_of, vut_factory

POLICIES: Final = {1: "pov1", 2: "pov2"}
"""The learned POVs by their level."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Povs:
    """The POVs of all levels.

    Attributes:
        policies: folder of the networks that drive at levels 1 and 2.
        own: makes the controller that drives at the level of a person's own; None without one.
    """

    policies: Path
    own: VutFactory | None = None

    @property
    def levels(self) -> tuple[int, ...]:
        """The levels for which there is a POV."""
        return levels_in(self.policies, own=self.own is not None)

    def check_level(self, level: int) -> None:
        """Raise `UserError` where there is no POV of a level."""
        check_level(level, self.policies, own=self.own is not None)

    def sha256(self) -> dict[str, str]:
        """Return the hashes of the policies by name."""
        return policies_sha256(self.policies)

    @property
    def files(self) -> Files:
        """The files of a POV of a person's own, as far as they are known before it drives."""
        return {} if self.own is None else self.own.files or {}

    def with_log(self, log: Path) -> Povs:
        """Return the same POVs, with what one of a person's own prints added to a file."""
        return self if self.own is None else replace(self, own=self.own.with_log(log))

    def corridors(self, asked: int, cars: int) -> int:
        """Return how many corridors with `cars` cars on the mainline are served of those asked."""
        if self.own is None or self.own.vut.max_corridors is None:
            return asked
        most = self.own.vut.max_corridors
        if most < cars:
            raise UserError(f"--pov {self.own.spec}: it drives {most} car at a time, not {cars}")
        return min(asked, most // cars)


CHOICE: Final = "0, 1, 2 or all, or own with --pov"
ONE: Final = "0, 1 or 2, or own with --pov"


def levels_in(policies: Path, *, own: bool) -> tuple[int, ...]:
    """Return the levels for which there is a POV; level 0 needs no policy."""
    trained = policies_sha256(policies)
    learned = [level for level, name in POLICIES.items() if name in trained]
    return (0, *learned, OWN) if own else (0, *learned)


def check_level(level: int, policies: Path, *, own: bool) -> None:
    """Raise `UserError` where there is no POV of a level."""
    if level not in ALL_LEVELS:
        raise UserError(f"there is no POV level {level}: choose {CHOICE}")
    if level == OWN and not own:
        raise UserError("--level own is a POV that you bring: name it with --pov")
    if level not in levels_in(policies, own=own):
        raise UserError(f"there is no policy for a POV of level {level}{how_to_train(policies)}")


def parse_levels(text: str, policies: Path, *, own: bool, choice: str = CHOICE) -> tuple[int, ...]:
    """Return the levels that `--level` names: one, or all for which there is a POV.

    Raises `UserError` for a name of none, and where a POV of a person's own would not drive.
    """
    if text == "all":
        return levels_in(policies, own=own)
    by_name = {level_name(level): level for level in ALL_LEVELS}
    if text not in by_name:
        raise UserError(f"there is no POV level {text!r}: choose {choice}")
    level = by_name[text]
    check_level(level, policies, own=own)
    if own and level != OWN:
        raise UserError(f"--pov drives at --level own or all, not at --level {text}")
    return (level,)


def one_level(text: str, policies: Path, *, own: bool) -> int:
    """Return the one level that `--level` names."""
    if text == "all":
        raise UserError(f"--level all does not go here: choose {ONE}")
    return parse_levels(text, policies, own=own, choice=ONE)[0]


def policies_folder(policies: str | Path | None, scenario: Scenario) -> Path:
    """Return the folder of the policies that a person names, else of those for a scenario."""
    return policies_of(scenario) if policies is None else policies_in(policies)


def own_pov(spec: str, options: VutOptions) -> VutFactory:
    """Return what makes the POV that a person brings; `UserError` for what cannot be one.

    It is any VUT but one behind TraCI, and is hosted with the same options.
    """
    if why := kind_of(spec).no_pov:
        raise UserError(f"--pov {spec}: {why}")
    try:
        return vut_factory(spec, replace(options, command=None))
    except UserError as error:
        raise UserError(f"--pov {spec}: {error}") from error
