"""How severe an encounter is, by geometry alone: contact, conflict, harsh or safe.

The four words are the same in records, terminal, report, history, exports and documentation. They
follow from the bodies of the cars and from what the state at M asks of whoever is behind; what
counts as a failure is another question (`criterion.py`).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from merge_sumo.values.bodies import CentreLines, closest_before_m
from merge_sumo.values.merge import HARSH_MPS2, closest_after_m
from merge_sumo.values.trajectory import End, Trajectory


class Severity(StrEnum):
    """Classes of encounters, the most severe first; an episode is of the first that fits."""

    CONTACT = "contact"
    CONFLICT = "conflict"
    HARSH = "harsh"
    SAFE = "safe"


MEANING: Final[dict[Severity, str]] = {
    Severity.CONTACT: "bodies touch before, at or right after M",
    Severity.CONFLICT: "front bumpers within 6 m at M, no contact",
    Severity.HARSH: f"the rear car must brake harder than {HARSH_MPS2:g} m/s² after M",
    Severity.SAFE: "none of these",
}
"""What the words mean, at the paper's 6 m (`Scenario.dx_crash_m`)."""


@dataclass(frozen=True, slots=True)
class Closest:
    """How near the bodies of the VUT and the cars of the mainline come.

    Attributes:
        clearance_m: smallest clearance; 0 or less where bodies touch, infinite where they never
            drive on lanes that run together.
        impact_speed_mps: relative speed at the first contact; None without one.
    """

    clearance_m: float
    impact_speed_mps: float | None


def closest(trajectory: Trajectory, lines: CentreLines | None) -> Closest:
    """Return how near bodies come, from where the lanes run together until after M.

    Without the centre lines of the road, bodies are looked at from M on.
    """
    parts = [closest_after_m(trajectory)]
    if lines is not None:
        parts.insert(0, closest_before_m(trajectory, lines))
    speeds = [speed for _, speed in parts if speed is not None]
    return Closest(min(clearance for clearance, _ in parts), speeds[0] if speeds else None)


def severity_of(
    end: End, clearance_m: float, *, is_close: bool, brake_mps2: float
) -> Severity | None:
    """Return the class of an encounter; None where the VUT never reached M and touched nothing.

    Args:
        end: why the episode ended.
        clearance_m: smallest clearance of bodies.
        is_close: whether the front bumpers were nearer at M than the paper allows.
        brake_mps2: deceleration that whoever is behind at M needs.
    """
    if end.is_error:
        return None
    if clearance_m <= 0.0:
        return Severity.CONTACT
    if end is not End.MERGED:
        return None
    if is_close:
        return Severity.CONFLICT
    return Severity.HARSH if brake_mps2 > HARSH_MPS2 else Severity.SAFE
