"""The cause of a case in words: what happened in it, and what would have avoided it until when.

Every place that shows a case begins with these words. All of them but those of an error are of
letters, digits and `,.:;`, so that a label in sumo-gui can hold them.
"""

from __future__ import annotations

from merge_sumo.metrics.campaign_verdict import message_of
from merge_sumo.metrics.diagnosis import BRAKED_MPS, Diagnosis, diagnose
from merge_sumo.metrics.score import Measures, Outcome
from merge_sumo.scenario.scenario import POV, VEHICLES, MergeScenario
from merge_sumo.scenario.trajectory import End, Trajectory


def cause(outcome: Outcome, trajectory: Trajectory | None, others: str = "") -> str:
    """Return in a sentence what happened in a case, and for a failure what would have avoided it.

    `trajectory` is None where the motion is lost. `others` is a clause on other drivers.
    """
    avoided = "; ".join(clause for clause in (_way_out(outcome), others) if clause)
    fails_behind = outcome.is_tested and outcome.measures.error is not None
    behind = "behind M an error ends the follow-up" if fails_behind else ""
    sentences = [_happened(outcome, trajectory), avoided, behind]
    return " ".join(f"{text[0].upper()}{text[1:].removesuffix('.')}." for text in sentences if text)


def met(found: Measures) -> str:
    """Return the car of the mainline that measures are of: the nearest to the VUT at the end."""
    return "POV" if found.nearest == VEHICLES[POV] else f"car {found.nearest}"


def _happened(outcome: Outcome, trajectory: Trajectory | None) -> str:
    found, at = outcome.measures, f"{outcome.measures.t_end_s:g} s"
    if found.end.is_error:
        return f"{found.end} at {at}: {message_of(outcome)}"
    course = None if trajectory is None else diagnose(trajectory, found)
    kind = None if course is None else course.kind
    became = f"{kind or 'failure'}, " if outcome.failed else ""
    became += found.became.lower()
    if found.impact_speed_mps is not None:
        became += f" at a relative speed of {found.impact_speed_mps:.1f} m/s"
    conduct = "" if course is None else f"{_conduct(course, met(found))}, and "
    if found.end is End.COMPLETED:
        return f"{became}: {conduct}the episode ends at {at}"
    if found.end is End.TIMEOUT:
        return f"{became}: {conduct}{message_of(outcome)}"
    reaches = "reaches M"
    if found.lane_share is not None:
        share = found.lane_share
        place = "where the lane ends" if share >= 1.0 else f"at {share:.2f} of the lane"
        reaches = f"merges {place}"
    side = "ahead of" if found.merged_first == "VUT" else "behind"
    apart = f"its front bumper {abs(found.dx_m or 0.0):.1f} m {side} that of the {met(found)}"
    return f"{became}: {conduct}the VUT {reaches} at {at}, {apart}"


def _conduct(course: Diagnosis, other: str) -> str:
    def of(brakes_s: float | None, accelerates: bool) -> str:
        if brakes_s is not None:
            return f"begins to brake at {brakes_s:.1f} s"
        return "accelerates" if accelerates else f"keeps its speed within {BRAKED_MPS:g} m/s"

    vut = of(course.vut_brakes_s, course.vut_accelerates)
    return f"the VUT {vut}, the {other} {of(course.pov_brakes_s, course.pov_accelerates)}"


def _way_out(outcome: Outcome) -> str:
    """Return until when the VUT could avoid that front bumpers are close, in a clause."""
    found, scenario = outcome.measures, outcome.case.scenario
    if not outcome.failed or found.avoidable is None or not isinstance(scenario, MergeScenario):
        return ""
    if found.last_avoidable_s is None:
        kept = f"{scenario.dx_crash_m:g} m at {scenario.place}"
        return f"at no time does full braking or full acceleration of the VUT keep {kept}"
    way_out = "the last way out, full braking or full acceleration of the VUT,"
    return f"{way_out} closes at {found.last_avoidable_s:.1f} s"
