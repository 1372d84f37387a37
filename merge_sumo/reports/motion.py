"""One episode for a terminal: what became of it in words, and its motion as a table with a strip.

The strip is the road from above, straightened: both lanes up to the merge point, or to the end of
the acceleration lane, and a little past it, with a letter for each vehicle.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from merge_sumo.analysis.coordinates import described
from merge_sumo.analysis.diagnosis import MEANING, diagnose
from merge_sumo.analysis.merging import place_in_words
from merge_sumo.analysis.verdict import message_of
from merge_sumo.values.scenario import DT_S, POV, VEHICLES, VUT, Bounds, lane_of, level_name
from merge_sumo.values.score import Measures, Outcome, measures_in
from merge_sumo.values.trajectory import End, Trajectory

STRIP: Final = 48
"""Characters of the strip."""
PAST_M: Final = 0.08
"""Part of the strip that is behind M, or behind the end of the acceleration lane."""
LABEL: Final = 31
"""Characters of the name of a measure; more where one is longer."""
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
    first, scenario = "VUT" if found.merged_first == "VUT" else met, outcome.case.scenario
    ahead_m = abs(found.dx_m or 0.0)
    apart = f"the front bumper of the {first} is {ahead_m:.1f} m ahead at {scenario.place}"
    if met != "POV" and first == "VUT":
        apart += f" of that of the {met}"
    if found.lane_share is not None:
        apart = f"the VUT merges {place_in_words(found.lane_share)}, {apart}"
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
    found, scenario = outcome.measures, outcome.case.scenario
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
    """Return the motion as a table: a row for each second and for the end of the episode.

    Of every vehicle x in m, v in m/s and, where there are two, a in m/s2; then the strip, and the
    signals that the VUT has left.
    """
    motion, last = trajectory.motion, len(trajectory.motion) - 1
    vehicles = motion.shape[1]
    shown = 3 if vehicles == 2 else 2
    strip = _Strip.of(trajectory)
    heads = "".join(
        f"  {'x ' + who.upper():>8} {'m/s':>5}" + (f" {'m/s2':>5}" if shown == 3 else "")
        for who in VEHICLES[:vehicles]
    )
    lines = [f"{'t s':>5}{heads}   {strip.head}"]
    step = round(every_s / DT_S)
    rows = [*range(0, last, step), last]
    for row in rows:
        values = "".join(
            f"  {x:8.1f} {v:5.1f}" + (f" {a:5.1f}" if shown == 3 else "")
            for x, v, a in motion[row].tolist()
        )
        left = _signals(trajectory, row)
        drawn = strip.drawn(motion[row, :, 0].tolist())
        lines.append(f"{row * DT_S:5.1f}{values}   {drawn}{left}")
    return [*lines, *strip.legend]


def _signals(trajectory: Trajectory, row: int) -> str:
    """Return what the VUT left at a row, or "" for nothing."""
    left = {name: values[row] for name, values in (trajectory.signals or {}).items()}
    said = (f"{name} {value}" for name, value in left.items() if value is not None)
    return "".join(f"  {one}" for one in said)


@dataclass(frozen=True, slots=True)
class _Strip:
    """The road between two coordinates; `lane_m` is the acceleration lane, None without one."""

    low_m: float
    high_m: float
    lane_m: Bounds | None

    @classmethod
    def of(cls, trajectory: Trajectory) -> _Strip:
        """Return the strip of an episode, from the farthest start on."""
        low_m = min(float(trajectory.motion[0, :, 0].min()), -1.0)
        lane_m = lane_of(trajectory.case.scenario)
        end_m = 0.0 if lane_m is None else lane_m[1]
        return cls(low_m, end_m + PAST_M / (1.0 - PAST_M) * (end_m - low_m), lane_m)

    @property
    def head(self) -> str:
        """Where it begins, and where M is."""
        return f"{f'{self.low_m:.0f} m':<{self._place(0.0)}}M"

    @property
    def legend(self) -> list[str]:
        """What its characters mean where that is more than the head says."""
        if self.lane_m is None:
            return []
        return ["", "  = acceleration lane, from {:g} to {:g} m".format(*self.lane_m)]

    def drawn(self, x_m: list[float]) -> str:
        """Return it with vehicles at positions (A,)."""
        strip = ["."] * STRIP
        if self.lane_m is not None:
            begin, end = map(self._place, self.lane_m)
            strip[begin : end + 1] = "=" * (end + 1 - begin)
        strip[self._place(0.0)] = "|"
        for row, x in sorted(enumerate(x_m), key=lambda pair: pair[0] == VUT):
            if self.low_m <= x <= self.high_m:
                at = self._place(x)
                strip[at] = "X" if row == VUT and strip[at] in LETTERS else LETTERS[row]
        return "".join(strip)

    def _place(self, x_m: float) -> int:
        return round((x_m - self.low_m) / (self.high_m - self.low_m) * (STRIP - 1))
