"""One episode for a terminal: what became of it in words, and its motion as a table with a strip.

The strip is the road from above, straightened: both lanes up to the merge point and a little past
it, with a letter for each vehicle.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from merge_sumo.analysis.coordinates import described
from merge_sumo.analysis.diagnosis import MEANING, diagnose
from merge_sumo.analysis.verdict import message_of
from merge_sumo.values.measures import MEASURES
from merge_sumo.values.scenario import DT_S, POV, VEHICLES, VUT, level_name
from merge_sumo.values.score import Measures, Outcome
from merge_sumo.values.trajectory import End, Trajectory

STRIP: Final = 48
"""Characters of the strip."""
PAST_M: Final = 0.08
"""Part of the strip that is behind M."""
LETTERS: Final = ("P", "V", "a", "b")
"""Of the vehicles, in the order of their rows."""


def lines_of(outcome: Outcome, trajectory: Trajectory) -> list[str]:
    """Return an episode as a terminal shows it: the case, the verdict, measures and motion."""
    case = outcome.case
    return [
        f"case: level {level_name(case.level)}, {described(case)}",
        verdict_of(outcome, trajectory),
        *_margin(outcome),
        "",
        *_measures(outcome, _met(outcome.measures)),
        "",
        *motion_lines(trajectory),
    ]


def verdict_of(outcome: Outcome, trajectory: Trajectory) -> str:
    """Return what became of an episode in a sentence."""
    found = outcome.measures
    met = _met(found)
    at = f"{found.end.value} at {found.t_end_s:g} s"
    if found.end is End.COMPLETED:
        return f"{at}, {found.severity}{_impact(found)}"
    if found.end is not End.MERGED:
        return f"{at}: {message_of(outcome)}"
    first = "VUT" if found.merged_first == "VUT" else met
    apart = f"the front bumper of the {first} is {abs(found.dx_m or 0.0):.1f} m ahead at M"
    if met != "POV" and first == "VUT":
        apart += f" of that of the {met}"
    kind = diagnose(trajectory, found).kind
    how = "" if kind is None else f" ({kind}: {MEANING[kind]})"
    return f"{at}, {found.severity}{_impact(found)}: {apart}{how}"


def _met(found: Measures) -> str:
    """Return the car of the mainline that the measures are of: the nearest at the end."""
    return "POV" if found.nearest == VEHICLES[POV] else f"car {found.nearest}"


def _impact(found: Measures) -> str:
    speed = found.impact_speed_mps
    return "" if speed is None else f" at a relative speed of {speed:.1f} m/s"


def _margin(outcome: Outcome) -> Iterator[str]:
    """Yield whether it fails, where that is another question than how it ended."""
    if outcome.margin is not None:
        yield f"{'fails' if outcome.failed else 'does not fail'}: margin {outcome.margin:.3g}"


def _measures(outcome: Outcome, met: str) -> Iterator[str]:
    found, labels = outcome.measures, outcome.case.scenario.measure_labels
    if met != "POV":
        yield f"  of the {met}, which is nearest to the VUT at the end:"
    for name, measure in MEASURES.items():
        value, text = found.value(name), labels.get(name, measure.label).replace("POV", met)
        if value is not None and text:
            yield f"  {text:<31} {value:10.2f} {measure.unit}".rstrip()
    if found.clipped_steps:
        yield f"  {'steps beyond its limits':<31} {found.clipped_steps:10d}"


def motion_lines(trajectory: Trajectory, every_s: float = 1.0) -> list[str]:
    """Return the motion as a table: a row for each second and for the end of the episode.

    Of every vehicle x in m, v in m/s and, where there are two, a in m/s2; then the strip, and the
    signals that the VUT has left.
    """
    motion, last = trajectory.motion, len(trajectory.motion) - 1
    vehicles = motion.shape[1]
    shown = 3 if vehicles == 2 else 2
    low_m = min(float(motion[0, :, 0].min()), -1.0)
    high_m = -PAST_M / (1.0 - PAST_M) * low_m
    heads = "".join(
        f"  {'x ' + who.upper():>8} {'m/s':>5}" + (f" {'m/s2':>5}" if shown == 3 else "")
        for who in VEHICLES[:vehicles]
    )
    at_m = _place(0.0, low_m, high_m)
    lines = [f"{'t s':>5}{heads}   {f'{low_m:.0f} m':<{at_m}}M"]
    step = round(every_s / DT_S)
    rows = [*range(0, last, step), last]
    for row in rows:
        values = "".join(
            f"  {x:8.1f} {v:5.1f}" + (f" {a:5.1f}" if shown == 3 else "")
            for x, v, a in motion[row].tolist()
        )
        strip = _strip(motion[row, :, 0].tolist(), low_m, high_m)
        left = _signals(trajectory, row)
        lines.append(f"{row * DT_S:5.1f}{values}   {strip}{left}")
    return lines


def _signals(trajectory: Trajectory, row: int) -> str:
    """Return what the VUT left at a row, or "" for nothing."""
    left = {name: values[row] for name, values in (trajectory.signals or {}).items()}
    said = (f"{name} {value}" for name, value in left.items() if value is not None)
    return "".join(f"  {one}" for one in said)


def _strip(x_m: list[float], low_m: float, high_m: float) -> str:
    strip = ["."] * STRIP
    strip[_place(0.0, low_m, high_m)] = "|"
    for row, x in sorted(enumerate(x_m), key=lambda pair: pair[0] == VUT):
        if low_m <= x <= high_m:
            at = _place(x, low_m, high_m)
            strip[at] = "X" if row == VUT and strip[at] in LETTERS else LETTERS[row]
    return "".join(strip)


def _place(x_m: float, low_m: float, high_m: float) -> int:
    return round((x_m - low_m) / (high_m - low_m) * (STRIP - 1))
