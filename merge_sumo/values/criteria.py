"""The criteria that have a name; here, where their names cost no import (`criterion.py`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from merge_sumo.system.registry import Registry

PAPER: Final = "paper"


@dataclass(frozen=True, slots=True)
class NamedCriterion:
    """A criterion that has a name.

    Attributes:
        condition: over measures, under which a case fails.
        about: what fails, in a phrase.
    """

    condition: str
    about: str


CRITERIA: Final[Registry[NamedCriterion]] = Registry(
    "merge_sumo.verdicts",
    "criterion",
    {
        PAPER: NamedCriterion("score < -500", "front bumpers within 6 m at M"),
        "contact": NamedCriterion("clearance_m <= 0", "bodies touch"),
        "unsafe": NamedCriterion(
            "clearance_m <= 0 or brake_after_mps2 > 3", "a contact, or hard braking after M"
        ),
    },
    accepts=lambda item: isinstance(item, NamedCriterion),
    contract="a merge_sumo.values.criterion.NamedCriterion",
)
"""Criteria by the name that a person writes after `--fail-when`."""
