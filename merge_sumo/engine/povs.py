"""Who drives the POV at each level: a value, so that every process can be told the same."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from merge_sumo.drivers.policies import policies_of, policies_sha256
from merge_sumo.errors import UserError
from merge_sumo.values.scenario import OWN
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

    policies: Path = field(default_factory=policies_of)
    own: VutFactory | None = None

    @property
    def levels(self) -> tuple[int, ...]:
        """The levels for which there is a POV; level 0 needs no policy."""
        trained = self.sha256()
        learned = [level for level, name in POLICIES.items() if name in trained]
        return (0, *learned) if self.own is None else (0, *learned, OWN)

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

    def workers(self, vut: VutFactory, asked: int | None) -> int:
        """Return in how many processes a VUT is tested: see `VutFactory.workers`."""
        most = vut.workers(asked)
        return most if self.own is None else min(most, self.own.workers(asked))


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
