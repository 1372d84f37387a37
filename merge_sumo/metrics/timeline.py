"""The timeline of a case: its events in the order of time, and the kind of a failure.

Terminal, report, player and JUnit files show the result of `timeline`. A vehicle brakes in a phase
in which its speed falls by 1 m/s or more without a pause of a second. It accelerates in a phase in
which its speed rises by 1 m/s or more. A speed pauses while it changes by less than 0.1 m/s2.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from merge_sumo.metrics.bodies import NONE_MET, CentreLines, Encounter, encounters
from merge_sumo.metrics.criterion import CRITERIA, PAPER, Criterion
from merge_sumo.metrics.merge import Severity, brakes_needed_mps2
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.summary import message_of
from merge_sumo.scenario.case import Case, FloatArray, described
from merge_sumo.scenario.scenario import DT_S, NAMES, VEHICLES, VUT, Vehicle, level_name
from merge_sumo.scenario.trajectory import End, Trajectory

CHANGED_MPS = 1.0 - 1e-6
"""Change of speed that counts, without rounding errors; the jitter of a network is smaller."""
STEADY_MPS = 0.01 - 1e-6
"""Change of speed in a step below which the speed pauses."""
PAUSE_STEPS = 10
"""Number of such steps that end a phase."""
KIND_STEPS = 30
"""Steps before the last event in which the conduct of both vehicles gives the kind."""
KINDS = {
    "did not arrive": "the VUT does not merge in time",
    "rule broken": "your own rule is broken, not a limit of contact, distance or braking after M",
    "cut in": "the VUT keeps the limit at M, then a car behind it touches it or must brake hard",
    "late brake": "the VUT brakes, but begins when no way out is left",
    "both brake": "both brake, and the VUT begins while a way out is left",
    "weak brake": "only the VUT brakes, and begins while a way out is left",
    "both accelerate": "both accelerate",
    "squeeze": "the VUT does not brake, and at most one car accelerates",
}
"""Rules of the kinds of failures; a failure has the first kind whose rule fits. To classify a
vehicle, find the last time in the 3 s before the last event at which its speed differed by 1 m/s
from its speed at that event. The vehicle brakes if it was faster then, and accelerates if it was
slower. A way out is full braking or full acceleration that keeps the scenario's limit at M."""


@dataclass(frozen=True, slots=True)
class Event:
    """An event of a case.

    Attributes:
        time_s: its time; of a phase, its begin.
        text: the event, in a clause.
        car: the vehicle that brakes or accelerates, or that the VUT meets; else None.
    """

    time_s: float
    text: str
    car: Vehicle | None = None


@dataclass(frozen=True, slots=True)
class Timeline:
    """The events of a case, and its result.

    Attributes:
        events: the events in the order of time; the last one of a failure breaks the rule.
        result: kind and severity in words, with the speed of an impact.
        kind: kind of a failure, of `KINDS`; None for other cases, and where the motion is lost.
    """

    events: tuple[Event, ...]
    result: str
    kind: str | None

    @property
    def in_a_line(self) -> str:
        """Result and last event on one line; a contact in both appears once."""
        last = self.events[-1].text
        _, contact, impact = self.result.partition("contact ")
        if contact and last.endswith(impact):
            return f"{self.kind}: {last}" if self.kind else last
        return f"{self.result}: {last}"

    def lines(self, case: Case, name: str = "case") -> list[str]:
        """Return result, coordinates and events of a case as lines of a terminal.

        Args:
            case: the case.
            name: its name.
        """
        start = f"POV level {level_name(case.level)}, {described(case)}"
        lines = [f"{name}: {self.result}    {start}"]
        for event in self.events:
            lines.append(f"  {event.time_s:5.1f} s   {event.text}")
        return lines


def timeline(
    outcome: Outcome,
    trajectory: Trajectory | None,
    lines: CentreLines | None,
    others: Sequence[Event] = (),
) -> Timeline:
    """Return the timeline of a case.

    Args:
        outcome: the outcome.
        trajectory: its motion; None where that is lost.
        lines: centre lines of the road; None to look for a contact from M on only.
        others: further events, such as the last moment for another driver.

    Example:
        >>> case = ms.run(vut="design1", level=0, x_pov0_m=-285, v_pov0_mps=33)
        >>> timeline(case.outcome, case.trajectory, None).events[-1].text
        'the VUT reaches the merge point 4.8 m behind the POV: contact at 16.7 m/s'
    """
    found, rule, kind, met = outcome.measures, _rule(outcome), None, NONE_MET
    if trajectory is not None and found.impact_speed_mps is not None:
        (met,) = encounters([trajectory], lines)
    ends = sorted(_ends(outcome, trajectory, met, rule), key=lambda event: event.time_s)
    events, last = [*others, *_way_out(outcome), *ends], ends[-1]
    if trajectory is not None:
        whole = trajectory.whole
        if outcome.failed:
            whole = whole[: round(last.time_s / DT_S) + 1]
            kind = _kind(outcome, trajectory, whole, last, rule)
        events += _phases(outcome, whole, {end.car for end in ends})
    events.sort(key=lambda event: event.time_s)
    result = found.result if found.end.is_error else found.result.lower()
    if outcome.failed:
        result = f"{kind or 'failure'}, {result}"
    # Campaigns of earlier versions have recorded the speed at M.
    if impact_mps := met.impact_mps or found.impact_speed_mps:
        result += f" at {impact_mps:.1f} m/s"
    return Timeline(tuple(events), result, kind)


def phases(v_mps: FloatArray) -> Iterator[tuple[int, int]]:
    """Yield first and last row of each phase in which a vehicle brakes or accelerates.

    A phase begins where the speed is for the last time as high, or as low, as at any time in it.

    Args:
        v_mps: its speeds, (T + 1,), in m/s.
    """
    for sign in (-1.0, 1.0):
        gained_mps = sign * v_mps
        rows = np.flatnonzero(np.diff(gained_mps) > STEADY_MPS)
        back_mps = gained_mps[rows[:-1] + 1] - gained_mps[rows[1:]]
        ends = (np.diff(rows) > PAUSE_STEPS) | (back_mps > CHANGED_MPS)
        for part in np.split(rows, np.flatnonzero(ends) + 1):
            if not part.size:
                continue
            phase_mps = gained_mps[part[0] : part[-1] + 2]
            begin = np.flatnonzero(phase_mps <= phase_mps.min() + STEADY_MPS)[-1]
            end = begin + phase_mps[begin:].argmax()
            if phase_mps[end] - phase_mps[begin] > CHANGED_MPS:
                yield int(part[0] + begin), int(part[0] + end)


def _phases(outcome: Outcome, motion: FloatArray, met: set[Vehicle | None]) -> Iterator[Event]:
    """Yield the phases of the VUT and of the cars that it meets."""
    last_s = outcome.measures.last_avoidable_s if outcome.failed else None
    for car, name in enumerate(VEHICLES):
        if car != VUT and name not in met:
            continue
        v_mps = motion[:, car, 1]
        for begin, end in phases(v_mps):
            time_s, brakes = _time_s(begin), v_mps[end] < v_mps[begin]
            does = "brakes" if brakes else "accelerates"
            text = f"the {NAMES[name]} {does}: {v_mps[begin]:.1f} to {v_mps[end]:.1f} m/s"
            if brakes and car == VUT and last_s is not None and time_s > last_s:
                text += f", {time_s - last_s:.1f} s too late"
            yield Event(time_s, text, name)


def _way_out(outcome: Outcome) -> Iterator[Event]:
    """Yield the last time at which the VUT could keep its distance at M."""
    found, scenario = outcome.measures, outcome.case.scenario
    text = "last way out: full braking or full acceleration"
    if found.last_avoidable_s is None:
        kept = f"{scenario.dx_crash_m:g} m at {scenario.place}"
        text = f"no way out: neither full braking nor full acceleration keeps {kept}"
    if outcome.failed and found.is_close:
        yield Event(found.last_avoidable_s or 0.0, text)


def _rule(outcome: Outcome) -> str | None:
    """Return the named criterion by which a case fails; None without one."""
    for name in CRITERIA:
        if outcome.failed and Criterion(name).margin(outcome.measures) == outcome.margin:
            return name
    return None


def _ends(
    outcome: Outcome, trajectory: Trajectory | None, met: Encounter, rule: str | None
) -> Iterator[Event]:
    """Yield merge, contact and later events; the last one in time breaks the rule of a failure."""
    found, scenario, contact_s = outcome.measures, outcome.case.scenario, None
    text, car = message_of(outcome), found.nearest
    if found.end is End.MERGED:
        text = f"the VUT reaches {scenario.goal}"
        if found.lane_share is not None:
            text = f"the VUT merges at {found.lane_share:.2f} of the lane,"
        side = "ahead of" if found.merged_first == "VUT" else "behind"
        text += f" {abs(found.dx_m or 0.0):.1f} m {side} the {NAMES[car]}"
    if trajectory is not None and met.row is not None:
        contact_s, car = _time_s(met.row), VEHICLES[trajectory.nearest_at(met.row)]
        impact = f"at {met.impact_mps:.1f} m/s"
        if contact_s != found.t_end_s:
            yield Event(contact_s, f"contact with the {NAMES[car]} {impact}", car)
    if contact_s == found.t_end_s:
        text += f": contact {impact}"
    elif rule == PAPER:
        text += f": closer than {scenario.dx_crash_m:g} m"
    elif rule is not None and contact_s is None and trajectory is not None:
        text += f": {_must_brake(trajectory)}"
    if rule in (None, PAPER) or contact_s is None or contact_s >= found.t_end_s:
        yield Event(found.t_end_s, text, found.nearest)
    if trajectory is None:
        return
    hardest_mps2 = found.after_brake_mps2
    breaks_later = rule != PAPER and (rule or found.severity == Severity.HARSH)
    if hardest_mps2 and contact_s is None and breaks_later:
        a_mps2 = trajectory.whole[len(trajectory.motion) - 1 :, :, 2]
        row, index = divmod(int(np.abs(a_mps2 + hardest_mps2).argmin()), len(a_mps2[0]))
        row += len(trajectory.motion) - 1
        text = f"the {NAMES[VEHICLES[index]]} brakes hardest: -{hardest_mps2:.1f} m/s2"
        text += f", down to {trajectory.whole[row:, index, 1].min():.1f} m/s"
        yield Event(_time_s(row), text, VEHICLES[index])
    last_s = _time_s(len(trajectory.whole) - 1)
    if outcome.failed and rule is None and found.end is End.MERGED:
        yield Event(last_s, f"fails: margin {outcome.margin:.3g}")
    if outcome.passes and found.error is not None:
        yield Event(last_s, f"an error ends the follow-up: {message_of(outcome)}")


def _must_brake(trajectory: Trajectory) -> str:
    """Return which vehicle has to brake most after the merge, and how hard."""
    needed_mps2 = np.insert(brakes_needed_mps2(trajectory), VUT, 0.0)
    at_m, car = trajectory.motion[-1], needed_mps2.argmax()
    name = NAMES[VEHICLES[car if at_m[car, 0] < at_m[VUT, 0] else VUT]]
    if np.isinf(needed_mps2[car]):
        return f"the {name} is too close to brake in time"
    return f"the {name} must brake at -{needed_mps2[car]:.1f} m/s2"


def _kind(
    outcome: Outcome, trajectory: Trajectory, motion: FloatArray, last: Event, rule: str | None
) -> str:
    """Return the kind of a failure by the motion up to its last event."""
    found, now = outcome.measures, motion[-1]
    if found.end is not End.MERGED:
        return "did not arrive"
    if rule is None:
        return "rule broken"
    car = (
        trajectory.nearest_at(len(motion) - 1)
        if last.car == VEHICLES[VUT]
        else VEHICLES.index(last.car)
    )
    is_after = last.time_s >= found.t_end_s and not found.is_close
    if is_after and now[car, 0] < now[VUT, 0]:
        return "cut in"
    vut, other = (_trend(motion[:, who, 1]) for who in (VUT, car))
    if vut >= 0.0:
        return "both accelerate" if vut > 0.0 and other > 0.0 else "squeeze"
    v_mps, way_out_s = motion[:, VUT, 1], found.last_avoidable_s
    begun_s = [_time_s(a) for a, b in phases(v_mps) if v_mps[b] < v_mps[a]]
    if found.is_close and begun_s and (way_out_s is None or begun_s[-1] > way_out_s):
        return "late brake"
    return "both brake" if other < 0.0 else "weak brake"


def _trend(v_mps: FloatArray) -> float:
    """Return whether a vehicle brakes at last, -1, accelerates, 1, or keeps its speed, 0."""
    gained_mps = v_mps[-1] - v_mps[-KIND_STEPS - 1 :]
    changed = gained_mps[np.abs(gained_mps) > CHANGED_MPS]
    return float(np.sign(changed[-1])) if changed.size else 0.0


def _time_s(row: int) -> float:
    return round(row * DT_S, 1)
