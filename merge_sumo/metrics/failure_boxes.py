"""Boxes of the pool where cases fail, in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from merge_sumo.metrics.outcome import Outcome
from merge_sumo.scenario.case import Case, FloatArray, coordinates
from merge_sumo.scenario.scenario import POV, VEHICLES, VUT, Scenario

DECIMALS = {"m": 0, "m/s": 1}
"""Decimals of the bounds of boxes by unit; 2 in other units."""
MOST_BOXES = 10
"""Leaves of the decision tree of a level."""
FEWEST_FAILURES = 3
"""Failures in the smallest box."""


@dataclass(frozen=True, slots=True)
class FailureBox:
    """A box of the pool in which at least half of the cases fail.

    Attributes:
        level: POV level.
        where: the bounds of the box in words.
        indices: the cases inside, by these bounds.
        failures: number of failing cases inside.
    """

    level: int
    where: str
    indices: tuple[int, ...]
    failures: int

    @property
    def cases(self) -> int:
        """Number of cases inside."""
        return len(self.indices)


def _quantities(cases: Sequence[Case], scenario: Scenario) -> dict[tuple[str, str], list[float]]:
    """Return the values of cases of a level by name and unit of each quantity.

    With the coordinates there is the time at which a car would reach M at constant speed: failures
    lie in bands of equal time.
    """
    values = {}
    for row in range(scenario.vehicles):
        if row != VUT:
            due_s = []
            for case in cases:
                x_m, v_mps = case.starts()[row]
                due_s.append(-x_m / v_mps if v_mps > 0.0 else scenario.timeout_s)
            name = "POV" if row == POV else f"car {VEHICLES[row]}"
            values[f"{name} due at M (at constant speed)", "s"] = due_s
    for coordinate in coordinates(scenario, (cases[0].level,)):
        own = [coordinate.of(case) or 0.0 for case in cases]
        values[coordinate.name, coordinate.unit] = own
    return values


def failure_boxes(outcomes: Sequence[Outcome], level: int) -> list[FailureBox]:
    """Return the boxes in which the failures of a level lie, the one with most failures first.

    A small decision tree (scikit-learn, Gini, balanced classes) separates failing from other
    cases. Its leaves in which at least half of the cases fail are the boxes. The shares are of
    cases that a sampler chose: they are not probabilities.

    Args:
        outcomes: outcomes of a campaign, one a case.
        level: POV level.

    Example:
        >>> failure_boxes(run.cases, 1)[0].where
        'POV due at M (at constant speed) between 8.29 and 8.80 s'
    """
    judged = [o for o in outcomes if o.case.level == level and o.margin is not None]
    failed = np.array([o.failed for o in judged], dtype=bool)
    if failed.sum() < FEWEST_FAILURES:
        return []
    from sklearn.tree import DecisionTreeClassifier

    cases = [outcome.case for outcome in judged]
    quantities = _quantities(cases, cases[0].scenario)
    places = np.array(list(quantities.values())).T
    tree = DecisionTreeClassifier(
        max_leaf_nodes=MOST_BOXES,
        min_samples_leaf=FEWEST_FAILURES,
        class_weight="balanced",
        random_state=0,
    ).fit(places, failed)
    boxes = []
    unbounded = np.full(places.shape[1], np.inf)
    for lows, highs in _bounds(tree.tree_, 0, -unbounded, unbounded):
        words = []
        inside = np.ones(len(judged), dtype=bool)
        for (name, unit), values, low, high in zip(quantities, places.T, lows, highs, strict=True):
            # Rounding may move a case over a bound: the written bound decides.
            least, most = (f"{bound:.{DECIMALS.get(unit, 2)}f}" for bound in (low, high))
            inside &= (values >= float(least)) & (values <= float(most))
            if np.isfinite(low) and np.isfinite(high):
                words.append(f"{name} between {least} and {most} {unit}")
            elif np.isfinite(low):
                words.append(f"{name} above {least} {unit}")
            elif np.isfinite(high):
                words.append(f"{name} below {most} {unit}")
        failures = int(failed[inside].sum())
        if failures >= max(FEWEST_FAILURES, inside.sum() / 2):
            indices = tuple(judged[place].index for place in np.flatnonzero(inside))
            where = " and ".join(words) or "anywhere"
            boxes.append(FailureBox(level, where, indices, failures))
    return sorted(boxes, key=lambda box: -box.failures)


def _bounds(
    tree: Any, node: int, low: FloatArray, high: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    """Return the lower and upper bounds, (d,), of the leaves below a node."""
    left, right = tree.children_left[node], tree.children_right[node]
    if left < 0:
        return [(low, high)]
    below, above = high.copy(), low.copy()
    below[tree.feature[node]] = above[tree.feature[node]] = tree.threshold[node]
    return _bounds(tree, left, low, below) + _bounds(tree, right, above, high)
