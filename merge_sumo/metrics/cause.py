"""The cause of a case in words: what happened in it, and what would have avoided it until when.

Every place that shows a case begins with these words. All of them but those of an error are of
letters, digits and `,.:;`, so that a label in sumo-gui can hold them.

They follow from the recorded speeds and from the order at M. A vehicle brakes where its speed falls
`BRAKED_MPS` below the highest it had before; it begins when it last had that speed. It accelerates
where it does not brake and its speed rises as much. So the jitter of a network is not taken for a
decision.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import Any, Self

import numpy as np

from merge_sumo.metrics.measures import Measures
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.summary import message_of
from merge_sumo.scenario.case import Case, Coordinate, FloatArray, coordinates
from merge_sumo.scenario.scenario import AHEAD, BEHIND, DT_S, POV, VEHICLES, VUT, Scenario
from merge_sumo.scenario.trajectory import End, Trajectory

BRAKED_MPS = 1.0
"""Loss of speed from which a vehicle is said to brake, and gain from which to accelerate."""
ROUNDING_MPS = 1e-6


class Kind(StrEnum):
    """Kinds of failures under the paper's rule; each such failure is of exactly one.

    "Together" is within the scenario's limit at M, a way out full braking or acceleration.
    """

    meaning: str

    STALEMATE = "stalemate", "both brake, and the VUT begins while a way out is left"
    SQUEEZE = "squeeze", "neither loses 1 m/s, and both arrive together"
    POV_BRAKES = "only the POV brakes", "the VUT loses less than 1 m/s, and both arrive together"
    LATE_BRAKE = "late brake", "the VUT begins to brake when no way out is left"
    WEAK_BRAKE = "weak brake", "only the VUT brakes, and begins while a way out is left"

    def __new__(cls, name: str, meaning: str) -> Self:
        """Make a kind of its name, and keep what it means."""
        kind = str.__new__(cls, name)
        kind._value_, kind.meaning = name, meaning
        return kind


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """The course of an episode: when VUT and POV began to brake, or whether they gained speed.

    A failure under the paper's rule has a kind; no other episode has one.
    """

    vut_brakes_s: float | None
    pov_brakes_s: float | None
    vut_accelerates: bool
    pov_accelerates: bool
    kind: Kind | None


def diagnose(trajectory: Trajectory, measures: Measures) -> Diagnosis:
    """Return which vehicle braked in an episode and which kind of failure it was.

    In traffic the POV is the car that the measures are of: the nearest to the VUT at the end.
    """
    trajectory = trajectory.facing(VEHICLES.index(measures.nearest))
    vut_mps, pov_mps = trajectory.v_vut_mps, trajectory.v_pov_mps
    vut_s, pov_s = _brakes_s(vut_mps), _brakes_s(pov_mps)
    kind = _kind(vut_s, pov_s, measures.last_avoidable_s) if measures.is_close else None
    accelerates = vut_s is None and _gains(vut_mps), pov_s is None and _gains(pov_mps)
    return Diagnosis(vut_s, pov_s, *accelerates, kind)


def _brakes_s(v_mps: FloatArray) -> float | None:
    """Return when a vehicle of speeds (T + 1,) began to brake; None where it did not."""
    highest_mps = np.maximum.accumulate(v_mps)
    lost = np.flatnonzero(highest_mps - v_mps >= BRAKED_MPS - ROUNDING_MPS)
    if not lost.size:
        return None
    at_highest = np.flatnonzero(v_mps[: lost[0]] >= highest_mps[lost[0]] - ROUNDING_MPS)
    return round(float(at_highest[-1]) * DT_S, 1)


def _gains(v_mps: FloatArray) -> bool:
    """Return whether a vehicle of speeds (T + 1,) became faster than it had been."""
    gained_mps = v_mps - np.minimum.accumulate(v_mps)
    return bool(gained_mps.max() >= BRAKED_MPS - ROUNDING_MPS)


def _kind(vut_s: float | None, pov_s: float | None, way_out_until_s: float | None) -> Kind:
    if vut_s is None:
        return Kind.SQUEEZE if pov_s is None else Kind.POV_BRAKES
    if way_out_until_s is None or vut_s > way_out_until_s:
        return Kind.LATE_BRAKE
    return Kind.WEAK_BRAKE if pov_s is None else Kind.STALEMATE


@dataclass(frozen=True, slots=True)
class Feature:
    """An axis of regions in words: a coordinate of the pool, or the time it makes for.

    Attributes:
        decimals: with which bounds are written.
    """

    name: str
    unit: str
    decimals: int
    value: Callable[[Case], float]


DECIMALS = {"m": 0, "m/s": 1, "s": 2, "rad": 2}
"""With which bounds of regions are written, by unit."""
NAMED = {POV: "POV", AHEAD: "car ahead", BEHIND: "car behind"}
MOST_BOXES = 10
"""Leaves of the decision tree of a level."""
FEWEST_FAILURES = 3
"""Failures that make a region worth a sentence; of fewer, the cases speak for themselves."""

Bounds = tuple[tuple[Feature, float, float], ...]
"""(feature, low, high), rounded as it is written; infinite where nothing bounds it."""


def _value(coordinate: Coordinate, case: Case) -> float:
    return coordinate.of(case) or 0.0


def _due_s(row: int, case: Case) -> float:
    x_m, v_mps = case.starts()[row]
    return -x_m / v_mps if v_mps > 0.0 else case.scenario.timeout_s


def features(scenario: Scenario, level: int) -> tuple[Feature, ...]:
    """Return the axes in which regions of a level are bounded.

    Besides the coordinates it is the time at which a car would reach M at constant speed:
    failures lie in bands along which it is the same.
    """
    own = [
        Feature(c.name, c.unit, DECIMALS.get(c.unit, c.digits), partial(_value, c))
        for c in coordinates(scenario, (level,))
    ]
    due = [
        Feature(f"{NAMED[row]} due at M (at constant speed)", "s", 2, partial(_due_s, row))
        for row in range(scenario.vehicles)
        if row != VUT
    ]
    x, v, *others = own
    return (*due, v, x, *others)


@dataclass(frozen=True, slots=True)
class FailureBox:
    """A region of the pool where at least half of the cases that ran failed.

    Attributes:
        indices: cases of the run inside, by the bounds as written.
    """

    level: int
    bounds: Bounds
    indices: tuple[int, ...]
    failures: int

    @property
    def cases(self) -> int:
        """Number of cases inside."""
        return len(self.indices)

    @property
    def where(self) -> str:
        """The bounds in words."""
        parts = []
        for axis, *bounds in self.bounds:
            low, high = (f"{bound:.{axis.decimals}f}" for bound in bounds)
            is_bounded = [math.isfinite(bound) for bound in bounds]
            if all(is_bounded):
                parts.append(f"{axis.name} between {low} and {high} {axis.unit}")
            elif any(is_bounded):
                side = f"above {low}" if is_bounded[0] else f"below {high}"
                parts.append(f"{axis.name} {side} {axis.unit}")
        return " and ".join(parts) or "anywhere"


def failure_boxes(outcomes: Sequence[Outcome], level: int) -> list[FailureBox]:
    """Return where a level's failures lie, as boxes of the pool, those with most failures first.

    A small decision tree (scikit-learn, Gini, balanced classes) tells failing cases from the
    others; its leaves with at least as many failures as other cases are the boxes, joined where
    siblings are. The shares are of cases that a sampler chose: they are no probabilities.
    """
    judged = [o for o in outcomes if o.case.level == level and o.margin is not None]
    failed = np.array([o.failed for o in judged], dtype=bool)
    if failed.sum() < FEWEST_FAILURES:
        return []
    from sklearn.tree import DecisionTreeClassifier

    axes = features(judged[0].case.scenario, level)
    places = np.array([[feature.value(o.case) for feature in axes] for o in judged])
    tree = DecisionTreeClassifier(
        max_leaf_nodes=MOST_BOXES,
        min_samples_leaf=FEWEST_FAILURES,
        class_weight="balanced",
        random_state=0,
    ).fit(places, failed)
    leaf = tree.apply(places)
    failing = {node for node in set(leaf.tolist()) if failed[leaf == node].mean() >= 0.5}
    boxes = []
    for bounds in _leaf_boxes(tree.tree_, failing, len(axes)):
        # Rounding may move a case over a bound: what is counted is what is written.
        low, high = (
            [round(x, axis.decimals) for axis, x in zip(axes, side.tolist(), strict=True)]
            for side in bounds
        )
        inside = np.flatnonzero(((places >= low) & (places <= high)).all(axis=1)).tolist()
        failures = int(failed[inside].sum())
        if failures >= FEWEST_FAILURES:
            indices = tuple(judged[place].index for place in inside)
            written = tuple(zip(axes, low, high, strict=True))
            boxes.append(FailureBox(level, written, indices, failures))
    return sorted(boxes, key=lambda box: -box.failures)


def _leaf_boxes(tree: Any, failing: set[int], dims: int) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield the lower and upper bounds, (d,), of the failing leaves; siblings that fail are one."""

    def all_fail(node: int) -> bool:
        if tree.children_left[node] < 0:
            return node in failing
        return all_fail(tree.children_left[node]) and all_fail(tree.children_right[node])

    rest = [(0, np.full(dims, -np.inf), np.full(dims, np.inf))]
    while rest:
        node, low, high = rest.pop()
        if all_fail(node):
            yield low, high
        elif tree.children_left[node] >= 0:
            dim, at = tree.feature[node], tree.threshold[node]
            below, above = high.copy(), low.copy()
            below[dim] = above[dim] = at
            rest.append((tree.children_right[node], above, high))
            rest.append((tree.children_left[node], low, below))


def cause(outcome: Outcome, trajectory: Trajectory | None, others: str = "") -> str:
    """Return in a sentence what happened in a case, and for a failure what would have avoided it.

    `trajectory` is None where the motion is lost. `others` is a clause on other drivers.

    Args:
        outcome: the outcome.
        trajectory: its motion; None where that is lost.
        others: a clause on other drivers.
    """
    avoided = "; ".join(clause for clause in (_way_out(outcome), others) if clause)
    fails_behind = outcome.is_tested and outcome.measures.error is not None
    behind = "after M an error ends the follow-up" if fails_behind else ""
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
    if not outcome.failed or found.avoidable is None:
        return ""
    if found.last_avoidable_s is None:
        kept = f"{scenario.dx_crash_m:g} m at {scenario.place}"
        return f"at no time does full braking or full acceleration of the VUT keep {kept}"
    way_out = "the last way out, full braking or full acceleration of the VUT,"
    return f"{way_out} closes at {found.last_avoidable_s:.1f} s"
