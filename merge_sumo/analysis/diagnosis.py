"""What went wrong in a failure, in words: which vehicle braked when, its kind, and where it lies.

All words follow from the recorded speeds and from the order at M. A vehicle brakes where its speed
falls `BRAKED_MPS` below the highest it had before; it begins when it last had that speed. It
accelerates where it does not brake and its speed rises as much. So the jitter of a network is not
taken for a decision.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

import numpy as np

from merge_sumo.analysis.coordinates import Coordinate, coordinates
from merge_sumo.values.case import Case, FloatArray
from merge_sumo.values.scenario import (
    AHEAD,
    BEHIND,
    DT_S,
    POV,
    VEHICLES,
    VUT,
    MergeScenario,
    Scenario,
    level_name,
)
from merge_sumo.values.score import Measures, Outcome
from merge_sumo.values.trajectory import Trajectory

BRAKED_MPS: Final = 1.0
"""Loss of speed from which a vehicle is said to brake, and gain from which to accelerate."""
ROUNDING_MPS: Final = 1e-6


class Kind(StrEnum):
    """Kinds of failures under the paper's rule; each such failure is of exactly one."""

    STALEMATE = "stalemate"
    SQUEEZE = "squeeze"
    POV_BRAKES = "only the POV brakes"
    LATE_BRAKE = "late brake"
    WEAK_BRAKE = "weak brake"


MEANING: Final[dict[Kind, str]] = {
    Kind.STALEMATE: "both brake, and arrive together",
    Kind.SQUEEZE: "neither brakes, and both arrive together",
    Kind.POV_BRAKES: "the VUT does not brake, and both arrive together",
    Kind.LATE_BRAKE: "only the VUT brakes, and begins when no way out is left",
    Kind.WEAK_BRAKE: "only the VUT brakes, and begins while a way out is left",
}
"""What the kinds mean: "together" is |dx| < 6 m at M, a way out full braking or acceleration."""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """When VUT and POV began to brake, if they did, and otherwise whether they gained speed.

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
    speeds_mps = trajectory.v_vut_mps, trajectory.v_pov_mps
    vut_s, pov_s = (_brakes_s(v_mps) for v_mps in speeds_mps)
    vut, pov = (_accelerates(v_mps) for v_mps in speeds_mps)
    kind = _kind(vut_s, pov_s, measures.last_avoidable_s) if measures.is_close else None
    return Diagnosis(vut_s, pov_s, vut_s is None and vut, pov_s is None and pov, kind)


def _brakes_s(v_mps: FloatArray) -> float | None:
    """Return when a vehicle of speeds (T + 1,) began to brake; None where it did not."""
    highest_mps = np.maximum.accumulate(v_mps)
    lost = np.flatnonzero(highest_mps - v_mps >= BRAKED_MPS - ROUNDING_MPS)
    if not lost.size:
        return None
    at_highest = np.flatnonzero(v_mps[: lost[0]] >= highest_mps[lost[0]] - ROUNDING_MPS)
    return round(float(at_highest[-1]) * DT_S, 1)


def _accelerates(v_mps: FloatArray) -> bool:
    """Return whether a vehicle of speeds (T + 1,) became faster than it had been."""
    gained_mps = v_mps - np.minimum.accumulate(v_mps)
    return bool(gained_mps.max() >= BRAKED_MPS - ROUNDING_MPS)


def _kind(vut_s: float | None, pov_s: float | None, way_out_until_s: float | None) -> Kind:
    if vut_s is None:
        return Kind.SQUEEZE if pov_s is None else Kind.POV_BRAKES
    if pov_s is not None:
        return Kind.STALEMATE
    late = way_out_until_s is None or vut_s > way_out_until_s
    return Kind.LATE_BRAKE if late else Kind.WEAK_BRAKE


@dataclass(frozen=True, slots=True)
class Feature:
    """What a sentence says of a case: a coordinate of the pool, or the time it makes for."""

    name: str
    unit: str
    decimals: int
    value: Callable[[Case], float]


DECIMALS: Final = {"m": 0, "m/s": 1, "s": 2, "rad": 2}
"""With which bounds of regions are written, by unit."""
NAMED: Final = {POV: "POV", AHEAD: "car ahead", BEHIND: "car behind"}


def features(scenario: Scenario, level: int) -> tuple[Feature, ...]:
    """Return what sentences on a level speak of.

    Of a merge it is beside the coordinates the time at which a car would reach M at constant speed:
    failures lie in bands along which it is the same.
    """
    features = tuple(_of_coordinate(c) for c in coordinates(scenario, (level,)))
    if not isinstance(scenario, MergeScenario):
        return features
    x, v, *others = features
    cars = [row for row in range(scenario.vehicles) if row != VUT]
    return (*(_due(row) for row in cars), v, x, *others)


def _of_coordinate(c: Coordinate) -> Feature:
    digits = DECIMALS.get(c.unit, c.digits)
    return Feature(c.name, c.unit, digits, lambda case: c.of(case) or 0.0)


def _due(row: int) -> Feature:
    def due_s(case: Case) -> float:
        x_m, v_mps = case.starts()[row]
        return -x_m / v_mps if v_mps > 0.0 else case.scenario.timeout_s

    return Feature(f"{NAMED[row]} due at M (at constant speed)", "s", 2, due_s)


MOST_BOXES: Final = 10
"""Leaves of the decision tree of a level."""
FEWEST_FAILURES: Final = 3
"""Failures that make a region worth a sentence; of fewer, the cases speak for themselves."""


Bounds = tuple[tuple[Feature, float | None, float | None], ...]


@dataclass(frozen=True, slots=True)
class FailureBox:
    """A region of the pool where at least half of the cases that ran failed.

    Attributes:
        level: POV level.
        bounds: (feature, low, high), rounded as it is written; None where nothing bounds it.
        cases: cases of the run inside, by the bounds as written, and the failures among them.
        indices: the cases.
    """

    level: int
    bounds: Bounds
    cases: int
    failures: int
    indices: tuple[int, ...]

    @property
    def where(self) -> str:
        """Return the bounds in words."""
        parts = [words for bounds in self.bounds if (words := _in_words(*bounds))]
        return " and ".join(parts) or "anywhere"

    @property
    def sentence(self) -> str:
        """Return the box as a sentence."""
        where = f"POV level {level_name(self.level)}, {self.where}"
        return f"{where}: {self.failures} of {self.cases} cases fail."


def failure_boxes(outcomes: Sequence[Outcome], level: int) -> list[FailureBox]:
    """Return where a level's failures lie, as boxes of the pool, those with most failures first.

    A small decision tree (scikit-learn, Gini, balanced classes) tells failing cases from the
    others; its leaves with at least as many failures as other cases are the boxes, joined where
    siblings are. The shares are of cases that a sampler chose: they are no probabilities.
    """
    scored = [o for o in outcomes if o.case.level == level and o.margin is not None]
    failed = np.array([o.failed for o in scored], dtype=bool)
    if failed.sum() < FEWEST_FAILURES:
        return []
    from sklearn.tree import DecisionTreeClassifier

    axes = features(scored[0].case.scenario, level)
    places = np.array([[feature.value(o.case) for feature in axes] for o in scored])
    tree = DecisionTreeClassifier(
        max_leaf_nodes=MOST_BOXES,
        min_samples_leaf=FEWEST_FAILURES,
        class_weight="balanced",
        random_state=0,
    ).fit(places, failed)
    leaf = tree.apply(places)
    failing = {node for node in set(leaf.tolist()) if failed[leaf == node].mean() >= 0.5}
    boxes = [
        _box(level, _rounded(axes, low, high), scored)
        for low, high in _leaf_boxes(tree.tree_, failing, len(axes))
    ]
    boxes = [box for box in boxes if box.failures >= FEWEST_FAILURES]
    return sorted(boxes, key=lambda box: -box.failures)


def _leaf_boxes(tree: Any, failing: set[int], dims: int) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield the lower and upper bounds, (d,), of the failing leaves; siblings that fail are one."""

    def all_fail(node: int) -> bool:
        if tree.children_left[node] < 0:
            return node in failing
        return all_fail(tree.children_left[node]) and all_fail(tree.children_right[node])

    def walk(
        node: int, low: FloatArray, high: FloatArray
    ) -> Iterator[tuple[FloatArray, FloatArray]]:
        if all_fail(node):
            yield low, high
        elif tree.children_left[node] >= 0:
            dim, at = tree.feature[node], tree.threshold[node]
            below, above = high.copy(), low.copy()
            below[dim], above[dim] = at, at
            yield from walk(tree.children_left[node], low, below)
            yield from walk(tree.children_right[node], above, high)

    yield from walk(0, np.full(dims, -np.inf), np.full(dims, np.inf))


def _rounded(axes: Sequence[Feature], low: FloatArray, high: FloatArray) -> Bounds:
    def written(feature: Feature, value: float) -> float | None:
        return round(value, feature.decimals) if np.isfinite(value) else None

    return tuple(
        (feature, written(feature, a), written(feature, b))
        for feature, a, b in zip(axes, low.tolist(), high.tolist(), strict=True)
    )


def _box(level: int, bounds: Bounds, scored: Sequence[Outcome]) -> FailureBox:
    inside = [o for o in scored if _inside(o, bounds)]
    failures = sum(o.failed for o in inside)
    return FailureBox(level, bounds, len(inside), failures, tuple(o.index for o in inside))


def _inside(outcome: Outcome, bounds: Bounds) -> bool:
    return all(
        (low is None or feature.value(outcome.case) >= low)
        and (high is None or feature.value(outcome.case) <= high)
        for feature, low, high in bounds
    )


def _in_words(feature: Feature, low: float | None, high: float | None) -> str:
    name, unit, decimals = feature.name, feature.unit, feature.decimals
    if low is not None and high is not None:
        return f"{name} between {low:.{decimals}f} and {high:.{decimals}f} {unit}"
    if low is not None:
        return f"{name} above {low:.{decimals}f} {unit}"
    if high is not None:
        return f"{name} below {high:.{decimals}f} {unit}"
    return ""
