"""One episode for a terminal: its verdict in words, its measures, and its motion as a table."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from merge_sumo.scenario.coordinates import described
from merge_sumo.scenario.scenario import DT_S, POV, VEHICLES, level_name
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.verdict.campaign_verdict import message_of
from merge_sumo.verdict.diagnosis import diagnose
from merge_sumo.verdict.score import Measures, Outcome, measures_in

LABEL: Final = 31
"""Characters of the name of a measure; more where one is longer."""


def lines_of(outcome: Outcome, trajectory: Trajectory) -> list[str]:
    """Return an episode as a terminal shows it: the case, the verdict, measures and motion."""
    case = outcome.case
    lines = [
        f"case: level {level_name(case.level)}, {described(case)}",
        verdict_of(outcome, trajectory),
    ]
    if outcome.margin is not None:
        verb = "fails" if outcome.failed else "does not fail"
        lines.append(f"{verb}: margin {outcome.margin:.3g}")
    return [*lines, "", *_measures(outcome), "", *motion_lines(trajectory)]


def verdict_of(outcome: Outcome, trajectory: Trajectory) -> str:
    """Return the verdict on an episode as a sentence."""
    found, place = outcome.measures, outcome.case.scenario.place
    met, speed = _met(found), found.impact_speed_mps
    at = f"{found.end.value} at {found.t_end_s:g} s"
    became = f"{at}, {found.severity}"
    if speed is not None:
        became += f" at a relative speed of {speed:.1f} m/s"
    if found.end is End.COMPLETED:
        return became
    if found.end is not End.MERGED:
        return f"{at}: {message_of(outcome)}"
    first = "VUT" if found.merged_first == "VUT" else met
    apart = f"the front bumper of the {first} is {abs(found.dx_m or 0.0):.1f} m ahead at {place}"
    if met != "POV" and first == "VUT":
        apart += f" of that of the {met}"
    if found.lane_share is not None:
        share = found.lane_share
        where = "where the lane ends" if share >= 1.0 else f"after {share:.0%} of the lane"
        apart = f"the VUT merges {where}, {apart}"
    kind = diagnose(trajectory, found).kind
    return f"{became}: {apart}{'' if kind is None else f' ({kind}: {kind.meaning})'}"


def _met(found: Measures) -> str:
    """Return the car of the mainline that the measures are of: the nearest at the end."""
    return "POV" if found.nearest == VEHICLES[POV] else f"car {found.nearest}"


def _measures(outcome: Outcome) -> Iterator[str]:
    found, scenario, met = outcome.measures, outcome.case.scenario, _met(outcome.measures)
    if met != "POV":
        yield f"  of the {met}, which is nearest to the VUT at the end:"
    listed = [
        (text, value, measure.unit)
        for measure in measures_in(scenario)
        if (value := found.value(measure.name)) is not None
        and (text := measure.label_in(scenario).replace("POV", met))
    ]
    width = max([LABEL, *(len(text) for text, _, _ in listed)])
    for text, value, unit in listed:
        yield f"  {text:<{width}} {value:10.2f} {unit}".rstrip()
    if found.clipped_steps:
        yield f"  {'steps beyond its limits':<{width}} {found.clipped_steps:10d}"


def motion_lines(trajectory: Trajectory, every_s: float = 1.0) -> list[str]:
    """Return the motion as a table: a row for each second, for the merge, and for the end.

    Of every vehicle x in m, v in m/s and a in m/s2; then the signals that the VUT has left.
    """
    motion, until = trajectory.whole, len(trajectory.motion) - 1
    cars = VEHICLES[: motion.shape[1]]
    lines = ["  t s" + "".join(f"  {f'x {who.upper()}':>8}   m/s  m/s2" for who in cars)]
    for row in sorted({*range(0, len(motion), round(every_s / DT_S)), until, len(motion) - 1}):
        values = "".join(f"  {x:8.1f} {v:5.1f} {a:5.1f}" for x, v, a in motion[row].tolist())
        signals = {name: of[row] for name, of in (trajectory.signals or {}).items()}
        left = "".join(f"  {name} {value}" for name, value in signals.items() if value is not None)
        place = f"  {trajectory.case.scenario.place}" if row == until < len(motion) - 1 else ""
        lines.append(f"{row * DT_S:5.1f}{values}{place}{left}")
    return lines
