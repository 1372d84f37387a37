"""Who drives the POV at each level: a value, so that every process can be told the same."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from merge_sumo.drivers.policies import policies_of, policies_sha256

POLICIES: Final = {1: "pov1", 2: "pov2"}
"""The learned POVs by their level."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Povs:
    """The POVs of all levels.

    Attributes:
        policies: folder of the networks that drive at levels 1 and 2.
    """

    policies: Path = field(default_factory=policies_of)

    @property
    def levels(self) -> tuple[int, ...]:
        """The levels for which there is a POV; level 0 needs no policy."""
        trained = self.sha256()
        return (0, *(level for level, name in POLICIES.items() if name in trained))

    def sha256(self) -> dict[str, str]:
        """Return the hashes of the policies by name."""
        return policies_sha256(self.policies)
