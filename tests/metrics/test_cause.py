"""The cause of a case in words, by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from metrics.test_diagnosis import BRAKES, COASTS, EASES, KEEP, LEVEL0, meeting, phases

from merge_sumo.metrics.cause import cause
from merge_sumo.metrics.measures import Measures
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.scenario.trajectory import End, Trajectory

LATE = phases((7.5, 1.0), (0.5, -4.0))
AHEAD = "and the VUT reaches M at 8 s, its front bumper 1.0 m behind that of the POV."
OPEN = "The last way out, full braking or full acceleration of the VUT, closes at"


def said(trajectory: Trajectory, others: str = "", **changes: Any) -> str:
    measures = Measures(**Measures.of(trajectory).values | changes)
    return cause(Outcome(0, 0, trajectory.case, measures), trajectory, others)


@pytest.mark.parametrize(
    ("a_pov", "a_vut", "kind", "conduct"),
    [
        (BRAKES, LATE, "Late brake", "the VUT begins to brake at 7.5 s, the POV begins to brake"),
        (KEEP, LATE, "Late brake", "the VUT begins to brake at 7.5 s, the POV keeps its speed"),
        (BRAKES, EASES, "Stalemate", "the VUT begins to brake at 2.0 s, the POV begins to brake"),
        (KEEP, EASES, "Weak brake", "the VUT begins to brake at 2.0 s, the POV keeps its speed"),
        (BRAKES, LEVEL0, "Only the POV brakes", "the VUT accelerates, the POV begins to brake"),
        (KEEP + 0.5, LEVEL0, "Squeeze", "the VUT accelerates, the POV accelerates"),
    ],
)
def test_of_a_failure_is_its_kind_the_motion_and_the_last_way_out(a_pov, a_vut, kind, conduct):
    text = said(meeting(a_pov, a_vut), last_avoidable_s=6.2)
    pov = {"brake": " at 3.0 s", "speed": " within 1 m/s"}.get(conduct.split()[-1], "")
    head, _, course = text.partition(": ")
    assert head.split(",")[0] == kind
    assert course == f"{conduct}{pov}, {AHEAD} {OPEN} 6.2 s."


def test_of_a_failure_names_other_drivers():
    text = said(meeting(KEEP, LATE), "in the place of the VUT fsm would have avoided it")
    assert text.endswith("s; in the place of the VUT fsm would have avoided it.")


def test_of_a_failure_without_a_way_out_says_so():
    text = said(meeting(KEEP, LATE), last_avoidable_s=None, avoidable=False)
    never = "At no time does full braking or full acceleration of the VUT keep 6 m at M."
    assert text.endswith(f"{AHEAD} {never}")


def test_of_another_case_is_the_motion_alone():
    trajectory = meeting(BRAKES, COASTS, gap_m=-30.0)
    course = "the VUT accelerates, the POV begins to brake at 3.0 s, and the VUT reaches M at 8 s"
    assert said(trajectory) == f"Safe: {course}, its front bumper 30.0 m ahead of that of the POV."


def test_without_the_motion_is_how_they_arrived():
    trajectory = meeting(BRAKES, COASTS, gap_m=-30.0)
    outcome = Outcome(0, 0, trajectory.case, Measures.of(trajectory))
    arrived = "the VUT reaches M at 8 s, its front bumper 30.0 m ahead of that of the POV."
    assert cause(outcome, None) == f"Safe: {arrived}"


@pytest.mark.parametrize("message", ["boom", "boom."])
def test_of_an_error_is_its_message(message):
    trajectory = replace(meeting(KEEP, LEVEL0), end=End.VUT_ERROR, error=message)
    assert said(trajectory) == "VUT_ERROR at 8 s: boom."
