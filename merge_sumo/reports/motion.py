"""One episode for a terminal: its cause, its measures, and its motion as a table."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from merge_sumo.metrics.cause import cause, met
from merge_sumo.metrics.merge import Conflict
from merge_sumo.metrics.score import Outcome, measures_in
from merge_sumo.scenario.coordinates import described
from merge_sumo.scenario.scenario import DT_S, VEHICLES, level_name
from merge_sumo.scenario.trajectory import Trajectory

LABEL: Final = 31
"""Characters of the name of a measure; more where one is longer."""


def lines_of(outcome: Outcome, trajectory: Trajectory, from_s: float | None = None) -> list[str]:
    """Return an episode as a terminal shows it: the case, its cause, measures, motion from then."""
    first, begins = Conflict.of(trajectory).begin(from_s)
    case = outcome.case
    lines = [
        f"case: level {level_name(case.level)}, {described(case)}",
        cause(outcome, trajectory),
    ]
    if outcome.margin is not None:
        verb = "fails" if outcome.failed else "does not fail"
        lines.append(f"{verb}: margin {outcome.margin:.3g}")
    return [*lines, "", *_measures(outcome), "", *begins, *_motion_lines(trajectory, first)]


def _measures(outcome: Outcome) -> Iterator[str]:
    found, scenario, other = outcome.measures, outcome.case.scenario, met(outcome.measures)
    if other != "POV":
        yield f"  of the {other}, which is nearest to the VUT at the end:"
    listed = [
        (text, value, measure.unit)
        for measure in measures_in(scenario)
        if (value := found.value(measure.name)) is not None
        and (text := measure.label_in(scenario).replace("POV", other))
    ]
    width = max([LABEL, *(len(text) for text, _, _ in listed)])
    for text, value, unit in listed:
        yield f"  {text:<{width}} {value:10.2f} {unit}".rstrip()
    if found.clipped_steps:
        yield f"  {'steps beyond its limits':<{width}} {found.clipped_steps:10d}"
    if outcome.is_tested and found.error is not None:
        yield f"  {'error behind M':<{width}} {found.error}"


def _motion_lines(trajectory: Trajectory, first: int) -> list[str]:
    """Return the motion from a row on: a row for each second, for the merge, and for the end.

    Of every vehicle x in m, v in m/s and a in m/s2; then the signals that the VUT has left.
    """
    motion, until = trajectory.whole, len(trajectory.motion) - 1
    cars = VEHICLES[: motion.shape[1]]
    lines = ["  t s" + "".join(f"  {f'x {who.upper()}':>8}   m/s  m/s2" for who in cars)]
    seconds = range(first, len(motion), round(1.0 / DT_S))
    for row in sorted({*seconds, max(until, first), len(motion) - 1}):
        values = "".join(f"  {x:8.1f} {v:5.1f} {a:5.1f}" for x, v, a in motion[row].tolist())
        signals = {name: of[row] for name, of in (trajectory.signals or {}).items()}
        left = "".join(f"  {name} {value}" for name, value in signals.items() if value is not None)
        place = f"  {trajectory.case.scenario.place}" if row == until < len(motion) - 1 else ""
        lines.append(f"{row * DT_S:5.1f}{values}{place}{left}")
    return lines
