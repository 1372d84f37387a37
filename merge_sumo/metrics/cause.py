"""The cause of a case in words: its kind, the conduct of both vehicles, and the last way out.

A vehicle brakes where its speed falls `BRAKED_MPS` below the highest speed before; it begins when
it last had that speed. It accelerates where it does not brake and its speed rises as much.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Self

import numpy as np

from merge_sumo.metrics.measures import Measures
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.summary import message_of
from merge_sumo.printable import sentence
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import DT_S, POV, VEHICLES
from merge_sumo.scenario.trajectory import End, Trajectory

BRAKED_MPS = 1.0
"""Change of speed that counts as braking or accelerating; the jitter of a network is smaller."""
ROUNDING_MPS = 1e-6


class Kind(StrEnum):
    """Kinds of failures under the paper's criterion; each of these failures has one kind."""

    STALEMATE = "stalemate"
    SQUEEZE = "squeeze"
    POV_BRAKES = "only the POV brakes"
    LATE_BRAKE = "late brake"
    WEAK_BRAKE = "weak brake"


MEANINGS = {
    Kind.STALEMATE: "both brake, and the VUT begins while a way out is left",
    Kind.SQUEEZE: "neither loses 1 m/s, and both arrive together",
    Kind.POV_BRAKES: "the VUT loses less than 1 m/s, and both arrive together",
    Kind.LATE_BRAKE: "the VUT begins to brake when no way out is left",
    Kind.WEAK_BRAKE: "only the VUT brakes, and begins while a way out is left",
}
"""A way out is full braking or full acceleration that keeps the scenario's limit at M."""


@dataclass(frozen=True, slots=True)
class Conduct:
    """The conduct of a vehicle up to M.

    Attributes:
        brakes_s: time at which it began to brake; None where it did not.
        accelerates: whether it accelerated.
    """

    brakes_s: float | None
    accelerates: bool

    @classmethod
    def of(cls, v_mps: FloatArray) -> Self:
        """Return the conduct of a vehicle.

        Args:
            v_mps: its speeds, (T + 1,), in m/s.
        """
        highest_mps = np.maximum.accumulate(v_mps)
        lost = np.flatnonzero(highest_mps - v_mps >= BRAKED_MPS - ROUNDING_MPS)
        if lost.size:
            at_highest = np.flatnonzero(v_mps[: lost[0]] >= highest_mps[lost[0]] - ROUNDING_MPS)
            return cls(round(float(at_highest[-1]) * DT_S, 1), accelerates=False)
        gained_mps = (v_mps - np.minimum.accumulate(v_mps)).max()
        return cls(None, accelerates=bool(gained_mps >= BRAKED_MPS - ROUNDING_MPS))

    @property
    def in_words(self) -> str:
        """The conduct as the verb of a sentence on the vehicle."""
        if self.brakes_s is not None:
            return f"begins to brake at {self.brakes_s:.1f} s"
        return "accelerates" if self.accelerates else f"keeps its speed within {BRAKED_MPS:g} m/s"


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """The conduct of both vehicles in an episode.

    Attributes:
        vut: conduct of the VUT.
        pov: conduct of the POV; in traffic of the car that is nearest to the VUT at the end.
        kind: kind of a failure under the paper's criterion, else None.
    """

    vut: Conduct
    pov: Conduct
    kind: Kind | None


def diagnose(trajectory: Trajectory, measures: Measures) -> Diagnosis:
    """Return the conduct of both vehicles, and the kind of failure.

    Args:
        trajectory: the motion.
        measures: its measures.
    """
    seen = trajectory.with_pov(VEHICLES.index(measures.nearest))
    vut, pov = Conduct.of(seen.v_vut_mps), Conduct.of(seen.v_pov_mps)
    kind = _kind(vut.brakes_s, pov.brakes_s, measures.last_avoidable_s)
    return Diagnosis(vut, pov, kind if measures.is_close else None)


def _kind(vut_s: float | None, pov_s: float | None, way_out_until_s: float | None) -> Kind:
    if vut_s is None:
        return Kind.SQUEEZE if pov_s is None else Kind.POV_BRAKES
    if way_out_until_s is None or vut_s > way_out_until_s:
        return Kind.LATE_BRAKE
    return Kind.WEAK_BRAKE if pov_s is None else Kind.STALEMATE


def cause(outcome: Outcome, trajectory: Trajectory | None, others: str = "") -> str:
    """Return the course of a case, and until when a failure was avoidable, in sentences.

    Apart from the message of an error they have letters, digits and `,.:;` only, as labels of
    sumo-gui need.

    Args:
        outcome: the outcome.
        trajectory: its motion; None where that is lost.
        others: a clause on other drivers that would have avoided the failure.

    Example:
        >>> case = ms.run(vut="design1", level=0, x_pov0_m=-290, v_pov0_mps=34)
        >>> cause(case.outcome, case.trajectory)
        'Squeeze, contact at a relative speed of 8.2 m/s: the VUT accelerates, ...'
    """
    sentences = [_course(outcome, trajectory)]
    avoided = [clause for clause in (_way_out(outcome), others) if clause]
    if avoided:
        sentences.append("; ".join(avoided))
    if outcome.is_tested and outcome.measures.error is not None:
        sentences.append("after M an error ends the follow-up")
    return " ".join(map(sentence, sentences))


def kind_and_severity(outcome: Outcome, diagnosis: Diagnosis | None) -> str:
    """Return the kind and severity of a case without an error, and the speed of its impact.

    Args:
        outcome: the outcome.
        diagnosis: its diagnosis; None where its motion is lost.
    """
    measures = outcome.measures
    text = measures.result.lower()
    if outcome.failed:
        kind = None if diagnosis is None else diagnosis.kind
        text = f"{kind or 'failure'}, {text}"
    if measures.impact_speed_mps is not None:
        text += f" at a relative speed of {measures.impact_speed_mps:.1f} m/s"
    return text


def conflicting_car(measures: Measures) -> str:
    """Return the name of the car of the mainline that is nearest to the VUT at the end.

    Args:
        measures: measures of the case.
    """
    nearest = measures.nearest
    return "POV" if nearest == VEHICLES[POV] else f"car {nearest}"


def _course(outcome: Outcome, trajectory: Trajectory | None) -> str:
    found, at = outcome.measures, f"{outcome.measures.t_end_s:g} s"
    if found.end.is_error:
        return f"{found.end} at {at}: {message_of(outcome)}"
    diagnosis = None if trajectory is None else diagnose(trajectory, found)
    car, text = conflicting_car(found), f"{kind_and_severity(outcome, diagnosis)}: "
    if diagnosis is not None:
        text += f"the VUT {diagnosis.vut.in_words}, the {car} {diagnosis.pov.in_words}, and "
    if found.end is End.TIMEOUT:
        return text + message_of(outcome)
    reaches = "reaches M"
    if found.lane_share is not None:
        reaches = f"merges at {found.lane_share:.2f} of the lane"
    side = "ahead of" if found.merged_first == "VUT" else "behind"
    apart = f"{abs(found.dx_m or 0.0):.1f} m {side} that of the {car}"
    return f"{text}the VUT {reaches} at {at}, its front bumper {apart}"


def _way_out(outcome: Outcome) -> str:
    """Return until when the VUT could keep its distance at M, in a clause."""
    found, scenario = outcome.measures, outcome.case.scenario
    if not outcome.failed or found.avoidable is None:
        return ""
    if found.last_avoidable_s is None:
        kept = f"{scenario.dx_crash_m:g} m at {scenario.place}"
        return f"at no time does full braking or full acceleration of the VUT keep {kept}"
    way_out = "the last way out, full braking or full acceleration of the VUT,"
    return f"{way_out} closes at {found.last_avoidable_s:.1f} s"
