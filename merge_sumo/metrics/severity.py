"""How severe an encounter is, by its motion alone: contact, conflict, harsh or safe.

The four words are the same in records, terminal, report, history, exports and documentation. They
follow from the simulated motion at M and behind it: where bodies are, and how hard a car brakes;
what counts as a failure is another question (`criterion.py`).
"""

from __future__ import annotations

from enum import StrEnum

from merge_sumo.metrics.merge import HARSH_MPS2
from merge_sumo.scenario.scenario import MergeScenario, Scenario
from merge_sumo.scenario.trajectory import End


class Severity(StrEnum):
    """Classes of encounters, the most severe first; an episode is of the first that fits."""

    CONTACT = "contact"
    CONFLICT = "conflict"
    HARSH = "harsh"
    SAFE = "safe"


def meanings(scenario: Scenario) -> dict[Severity, str]:
    """Return what the words mean in a scenario."""
    if not isinstance(scenario, MergeScenario):
        return {Severity.CONTACT: "bodies touch", Severity.SAFE: "no contact"}
    soon = f"within {scenario.follow_up_s:g} s after"
    found = {
        Severity.CONTACT: f"bodies touch at M or {soon} it",
        Severity.CONFLICT: f"front bumpers within {scenario.dx_crash_m:g} m at M, no contact",
        Severity.HARSH: f"a car behind brakes harder than {HARSH_MPS2:g} m/s² {soon} M",
        Severity.SAFE: "none of these",
    }
    if not scenario.follow_up_s:
        del found[Severity.HARSH]
        found[Severity.CONTACT] = "bodies touch at M"
    return {severity: scenario.said(meaning) for severity, meaning in found.items()}


def severity_of(
    end: End, clearance_m: float, *, is_close: bool, brake_mps2: float | None
) -> Severity | None:
    """Return the class of an encounter; None where the VUT never reached M.

    Args:
        end: why the episode ended.
        clearance_m: smallest clearance of bodies from M on.
        is_close: whether the front bumpers were nearer at M than the paper allows.
        brake_mps2: hardest braking behind M of those behind; None without a follow-up.
    """
    if not end.is_tested:
        return None
    if clearance_m <= 0.0:
        return Severity.CONTACT
    if is_close:
        return Severity.CONFLICT
    return Severity.HARSH if (brake_mps2 or 0.0) > HARSH_MPS2 else Severity.SAFE
