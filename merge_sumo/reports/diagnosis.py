"""What went wrong in a failure, in words: who yielded when, which kind it was, and where it lies.

Yielding is measured against level-0 behaviour, which gives way to nobody: a POV that keeps its
speed, a VUT that accelerates by 1 m/s2 up to 28 m/s. A vehicle has yielded once it is `CEDED_MPS`
slower than that profile; it began to yield when it last left the profile before that. So what a
network jitters by is not taken for a decision, and a vehicle that brakes and then catches up again
before it is 1 m/s behind has not yielded.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

import numpy as np

from merge_sumo.reports.coordinates import Coordinate, coordinates
from merge_sumo.values.case import Case, FloatArray
from merge_sumo.values.scenario import (
    AHEAD,
    BEHIND,
    DT_S,
    POV,
    VEHICLES,
    VUT,
    Scenario,
    level_name,
)
from merge_sumo.values.score import Measures, Outcome
from merge_sumo.values.trajectory import End, Trajectory

KEEPS_UP_MPS2: Final = 0.2
"""A vehicle that falls back by no more than this keeps up with its level-0 profile."""
CEDED_MPS: Final = 1.0
"""A vehicle that is this much slower than its level-0 profile has yielded."""
ROUNDING_MPS: Final = 1e-6


class Kind(StrEnum):
    """Kinds of collision; `MEANING` says what they mean. Every collision is of exactly one."""

    STALEMATE = "stalemate"
    SQUEEZE = "squeeze"
    FORCED_MERGE = "forced merge"
    LATE_BRAKE = "late brake"
    WEAK_BRAKE = "weak brake"


MEANING: Final[dict[Kind, str]] = {
    Kind.STALEMATE: "both yield, and meet",
    Kind.SQUEEZE: "neither yields",
    Kind.FORCED_MERGE: "only the POV yields, and not enough for the VUT that goes on",
    Kind.LATE_BRAKE: "only the VUT yields, and begins when there is no way out any more",
    Kind.WEAK_BRAKE: "only the VUT yields, begins in time, and does not yield enough",
}


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Who yielded in an episode and, of a collision, which kind it was.

    Attributes:
        vut_yields_s: when the VUT began to yield; None if it did not.
        pov_yields_s: when the POV began to yield; None if it did not.
        kind: of a collision; None for every other end.
    """

    vut_yields_s: float | None
    pov_yields_s: float | None
    kind: Kind | None


def diagnose(trajectory: Trajectory, measures: Measures) -> Diagnosis:
    """Return who yielded in an episode and which kind of failure it was.

    In traffic the POV is the car that the measures are of: the one that the VUT meets.
    """
    trajectory = trajectory.facing(VEHICLES.index(measures.nearest))
    time_s = np.arange(len(trajectory.motion)) * DT_S
    v_vut, v_pov = trajectory.v_vut_mps, trajectory.v_pov_mps
    scenario = trajectory.case.scenario
    cruise_mps = max(float(v_vut[0]), scenario.level0_v_mps)
    vut = _yields_s(np.minimum(v_vut[0] + scenario.level0_a_mps2 * time_s, cruise_mps) - v_vut)
    pov = _yields_s(v_pov[0] - v_pov)
    kind = None
    if measures.end is End.COLLISION:
        kind = _kind(vut, pov, measures.last_avoidable_s)
    return Diagnosis(vut, pov, kind)


def _yields_s(behind_mps: FloatArray) -> float | None:
    """Return when a vehicle began to yield that is `behind_mps`, (T + 1,), its level-0 profile.

    That is when it last kept up with the profile; an actuator that lags is behind it all the time.
    """
    ceded = np.flatnonzero(behind_mps >= CEDED_MPS - ROUNDING_MPS)
    if not ceded.size:
        return None
    falls_back_mps = np.diff(behind_mps[: ceded[0] + 1])
    keeps_up = np.flatnonzero(falls_back_mps <= KEEPS_UP_MPS2 * DT_S + ROUNDING_MPS)
    return round(float(keeps_up[-1] + 1) * DT_S, 1) if keeps_up.size else 0.0


def _kind(vut_s: float | None, pov_s: float | None, way_out_until_s: float | None) -> Kind:
    if vut_s is None:
        return Kind.SQUEEZE if pov_s is None else Kind.FORCED_MERGE
    if pov_s is not None:
        return Kind.STALEMATE
    late = way_out_until_s is None or vut_s > way_out_until_s
    return Kind.LATE_BRAKE if late else Kind.WEAK_BRAKE


@dataclass(frozen=True, slots=True)
class Feature:
    """What a sentence says of a case: a coordinate of the pool, or the time it makes for.

    Attributes:
        name: as it is written.
        unit: of the value.
        decimals: with which it is written.
        value: gives it for a case.
    """

    name: str
    unit: str
    decimals: int
    value: Callable[[Case], float]


DECIMALS: Final = {"m": 0, "m/s": 1, "s": 2, "rad": 2}
"""With which bounds of regions are written, by unit."""
NAMED: Final = {POV: "POV", AHEAD: "car ahead", BEHIND: "car behind"}


def features(scenario: Scenario, level: int) -> tuple[Feature, ...]:
    """Return what sentences on a level speak of.

    Beside the coordinates it is the time at which a car would reach M at constant speed: failures
    lie in bands along which it is the same.
    """
    x, v, *others = (_of_coordinate(c) for c in coordinates(scenario, (level,)))
    cars = [row for row in range(scenario.vehicles) if row != VUT]
    return (*(_due(row) for row in cars), v, x, *others)


def _of_coordinate(coordinate: Coordinate) -> Feature:
    return Feature(
        coordinate.name,
        coordinate.unit,
        DECIMALS[coordinate.unit],
        lambda case: coordinate.of(case) or 0.0,
    )


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
        cases: cases of the run inside, by the bounds as written.
        failures: failures among them.
        kinds: kinds of these failures, the most frequent first.
        indices: the cases.
    """

    level: int
    bounds: Bounds
    cases: int
    failures: int
    kinds: tuple[tuple[Kind, int], ...]
    indices: tuple[int, ...]

    @property
    def where(self) -> str:
        """Return the bounds in words."""
        parts = [words for bounds in self.bounds if (words := _in_words(*bounds))]
        return " and ".join(parts) or "anywhere"

    @property
    def what(self) -> str:
        """Return the kinds of failure in words."""
        if len(self.kinds) == 1:
            return f"{self.kinds[0][0]}: {MEANING[self.kinds[0][0]]}"
        return ", ".join(f"{count} {kind}" for kind, count in self.kinds)

    @property
    def sentence(self) -> str:
        """Return the box as a sentence."""
        text = f"POV level {level_name(self.level)}, {self.where}: "
        text += f"{self.failures} of {self.cases} cases fail"
        return f"{text} ({self.what})." if self.kinds else f"{text}."


def failure_boxes(
    outcomes: Sequence[Outcome], level: int, kinds: Mapping[int, Kind]
) -> list[FailureBox]:
    """Return where a level's failures lie, as boxes of the pool, those with most failures first.

    A small decision tree (scikit-learn, Gini, balanced classes) tells failing cases from the
    others; its leaves with at least as many failures as other cases are the boxes, joined where
    siblings are. The shares are of cases that a sampler chose: they are no probabilities.

    Args:
        outcomes: outcomes of a run, of any level.
        level: POV level.
        kinds: kind of failure by index of the case, as far as known.
    """
    from sklearn.tree import DecisionTreeClassifier

    told = [o for o in outcomes if o.case.level == level and o.score is not None]
    failed = np.array([o.failed for o in told], dtype=bool)
    if failed.sum() < FEWEST_FAILURES:
        return []
    told_of = features(told[0].case.scenario, level)
    places = np.array([[feature.value(o.case) for feature in told_of] for o in told])
    tree = DecisionTreeClassifier(
        max_leaf_nodes=MOST_BOXES,
        min_samples_leaf=FEWEST_FAILURES,
        class_weight="balanced",
        random_state=0,
    ).fit(places, failed)
    leaf = tree.apply(places)
    failing = {node for node in set(leaf.tolist()) if failed[leaf == node].mean() >= 0.5}
    boxes = [
        _box(level, _rounded(told_of, low, high), told, kinds)
        for low, high in _leaf_boxes(tree.tree_, failing, len(told_of))
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


def _rounded(told_of: Sequence[Feature], low: FloatArray, high: FloatArray) -> Bounds:
    def written(feature: Feature, value: float) -> float | None:
        return round(value, feature.decimals) if np.isfinite(value) else None

    return tuple(
        (feature, written(feature, a), written(feature, b))
        for feature, a, b in zip(told_of, low.tolist(), high.tolist(), strict=True)
    )


def _box(
    level: int, bounds: Bounds, told: Sequence[Outcome], kinds: Mapping[int, Kind]
) -> FailureBox:
    inside = [o for o in told if _inside(o, bounds)]
    failures = [o for o in inside if o.failed]
    found = Counter(kinds[o.index] for o in failures if o.index in kinds)
    kinds_found, indices = tuple(found.most_common()), tuple(o.index for o in inside)
    return FailureBox(level, bounds, len(inside), len(failures), kinds_found, indices)


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
