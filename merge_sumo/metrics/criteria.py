"""The criteria that have a name; here, where their names cost no import (`criterion.py`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

PAPER: Final = "paper"


@dataclass(frozen=True, slots=True)
class NamedCriterion:
    """A criterion that has a name."""

    condition: str  # over measures, under which a case fails
    about: str  # what fails, in a phrase


CRITERIA: Final = {
    PAPER: NamedCriterion(
        "score < -500",
        "the front bumpers are within 6 m as the VUT reaches M: a contact or a conflict",
    ),
    "contact": NamedCriterion("clearance_m <= 0", "a contact: bodies touch"),
    "unsafe": NamedCriterion(
        "clearance_m <= 0 or brake_after_mps2 > 3",
        "a contact, or the rear vehicle must brake harder than the 3 m/s2 that UN Regulation "
        "No. 79 lets a lane change demand of others",
    ),
}
"""Criteria by the name that follows `fail_when`."""
