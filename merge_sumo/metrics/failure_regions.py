"""Regions of the pool where cases fail, in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from merge_sumo.metrics.outcome import Outcome
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import POV, VEHICLES, VUT, Scenario

DECIMALS = {"m": 0, "m/s": 1}
"""Decimals of the bounds of regions by unit; 2 in other units."""
FEWEST_FAILURES = 3
"""Failures in the smallest region that is described."""
WIDEST = 0.5
"""Bounds wider than this share of the range of all cases are not told."""
MOST_BOUNDS = 3
"""Quantities in a description: those with the narrowest bounds."""


@dataclass(frozen=True, slots=True)
class FailureRegion:
    """A region of linked failures (`fmc.regions`), and the bounds between which they lie.

    Attributes:
        level: POV level.
        number: number of the region at its level, from 0.
        where: the bounds in words.
        failures: number of failures in the region.
        cases: number of cases within the bounds, also of other regions.
        failing: number of those that fail.
    """

    level: int
    number: int
    where: str
    failures: int
    cases: int
    failing: int


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
            values[f"{name} would reach M after", "s"] = due_s
    for coordinate in scenario.dimensions(cases[0].level):
        own = [coordinate.of(case) or 0.0 for case in cases]
        values[coordinate.name, coordinate.unit] = own
    return values


def failure_regions(
    outcomes: Sequence[Outcome], level: int, regions: Mapping[int, int]
) -> list[FailureRegion]:
    """Return the regions of a level with at least `FEWEST_FAILURES`, in the order of their number.

    A region is told by the quantities in which its failures lie close together.

    Args:
        outcomes: outcomes of a campaign, one a case.
        level: POV level.
        regions: region of each failure, by its index (`regions_of`).

    Example:
        >>> failure_regions(run.cases, 1, regions_of(run.cases))[0].where
        'POV would reach M after 8.29 to 8.80 s'
    """
    judged = [o for o in outcomes if o.case.level == level and o.margin is not None]
    if not judged:
        return []
    cases = [outcome.case for outcome in judged]
    quantities = _quantities(cases, cases[0].scenario)
    places = np.array(list(quantities.values()))
    span = np.ptp(places, axis=1)
    failed = np.array([outcome.failed for outcome in judged])
    number = np.array([regions.get(outcome.index, -1) for outcome in judged])
    found = []
    for region in range(number.max() + 1):
        own = number == region
        if own.sum() < FEWEST_FAILURES:
            continue
        low, high = places[:, own].min(axis=1), places[:, own].max(axis=1)
        share = np.divide(high - low, span, out=np.full(len(span), np.inf), where=span > 0.0)
        words = []
        inside = np.ones(len(judged), dtype=bool)
        for row, (name, unit) in enumerate(quantities):
            if share[row] < WIDEST and (share < share[row]).sum() < MOST_BOUNDS:
                inside &= (places[row] >= low[row]) & (places[row] <= high[row])
                decimals = DECIMALS.get(unit, 2)
                words.append(f"{name} {low[row]:.{decimals}f} to {high[row]:.{decimals}f} {unit}")
        where = ", ".join(words) or "anywhere"
        counts = int(own.sum()), int(inside.sum()), int(failed[inside].sum())
        found.append(FailureRegion(level, region, where, *counts))
    return found
