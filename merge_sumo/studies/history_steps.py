"""What changed between two versions of a VUT, by regions of failures, from records alone.

Failures that are linked at the radius of FMC are one region, and what the other version did in it
is what its own cases there say, those within that radius of a failure of the region. A region of
the earlier version in which the later one tested cases and none failed counts as fixed; one of the
later version in which the earlier one tested cases and none failed counts as broken. How much of a
region's volume these cases have looked at says how much that is worth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

import numpy as np
from scipy.spatial import cKDTree

from merge_sumo.analysis.coordinates import coordinates
from merge_sumo.campaigns.run import Run
from merge_sumo.values.case import Case, FloatArray, to_unit
from merge_sumo.values.fmc import fmc, radius_for, regions
from merge_sumo.values.scenario import level_name
from merge_sumo.values.score import Outcome

ROUNDING: Final = 1e-9
"""Share of the radius by which two points may be further apart and still count as near."""


class Became(StrEnum):
    """What became of a region of failures from one version to the next."""

    FIXED = "fixed"
    BROKE = "broke"
    STILL = "still failing"
    NOT_SEEN_AFTER = "not looked at after"
    NOT_SEEN_BEFORE = "not looked at before"


MEANING: Final[dict[Became, str]] = {
    Became.FIXED: "the earlier version fails there; the later one tested cases there, none failed",
    Became.BROKE: "the later version fails there; the earlier one tested cases there, none failed",
    Became.STILL: "both fail there",
    Became.NOT_SEEN_AFTER: "the earlier version fails there; the later one tested no case there",
    Became.NOT_SEEN_BEFORE: "the later version fails there; the earlier one tested no case there",
}


@dataclass(frozen=True, slots=True)
class Region:
    """A region of failures of one of two neighbours, and what the other one did in it.

    Attributes:
        of: number of the version that fails there, from 1.
        level: POV level.
        became: what became of it.
        failures: of that version, in the region.
        worst: index of the worst of them in its campaign.
        where: the box of these failures, in words.
        fmc: their volume.
        cases: cases in the region that the other version tested.
        failed: those of them that failed.
        looked_at: share of the volume that these cases have looked at.
    """

    of: int
    level: int
    became: Became
    failures: int
    worst: int
    where: str
    fmc: float
    cases: int
    failed: int
    looked_at: float


@dataclass(frozen=True, slots=True)
class Step:
    """What changed from a version to the next at one POV level.

    Attributes:
        before: number of the earlier version, from 1.
        after: number of the later one.
        level: POV level.
        regions: those of both versions: what broke comes first, then the largest.
        same: cases that both versions tested, to the last bit.
        same_fixed: those of them in which only the earlier version fails.
        same_broke: those in which only the later one fails.
    """

    before: int
    after: int
    level: int
    regions: tuple[Region, ...]
    same: int
    same_fixed: int
    same_broke: int

    def count(self, became: Became) -> int:
        """Return the number of regions of which that became."""
        return sum(region.became is became for region in self.regions)

    def to_record(self) -> dict[str, Any]:
        """Return it as JSON shows it."""
        record = {name: getattr(self, name) for name in Step.__slots__}
        found = [
            {name: getattr(region, name) for name in Region.__slots__ if name != "level"}
            for region in self.regions
        ]
        counts = {became.value: self.count(became) for became in Became}
        return record | {"level": level_name(self.level), "counts": counts, "regions": found}


def step_between(runs: Sequence[Run], before: int, after: int, level: int) -> Step:
    """Return what changed at a level between two of some campaigns, given by their places."""
    pair = [
        [o for o in runs[place].outcomes if o.case.level == level and o.is_tested]
        for place in (before, after)
    ]
    scenario = runs[before].scenario
    points = [to_unit((o.case for o in tested), level, scenario) for tested in pair]
    found = [
        *_regions(before + 1, level, pair[0], points[0], pair[1], points[1], earlier=True),
        *_regions(after + 1, level, pair[1], points[1], pair[0], points[0], earlier=False),
    ]
    order = (
        *(Became.BROKE, Became.FIXED, Became.STILL),
        *(Became.NOT_SEEN_BEFORE, Became.NOT_SEEN_AFTER),
    )
    found.sort(key=lambda region: (order.index(region.became), -region.fmc, region.worst))
    first, second = (
        {tuple(point): o.failed for point, o in zip(places.tolist(), tested, strict=True)}
        for places, tested in zip(points, pair, strict=True)
    )
    both = [(first[point], second[point]) for point in first.keys() & second.keys()]
    return Step(
        before=before + 1,
        after=after + 1,
        level=level,
        regions=tuple(found),
        same=len(both),
        same_fixed=sum(a and not b for a, b in both),
        same_broke=sum(b and not a for a, b in both),
    )


def _regions(
    of: int,
    level: int,
    own: Sequence[Outcome],
    own_points: FloatArray,
    other: Sequence[Outcome],
    other_points: FloatArray,
    *,
    earlier: bool,
) -> list[Region]:
    """Return the regions of a version's failures, and what the other one's cases say of them.

    Where both fail the region is given once, as one of the earlier version.
    """
    failing = np.array([outcome.failed for outcome in own], dtype=bool)
    failed, points = [o for o in own if o.failed], own_points[failing]
    radius = radius_for(own_points.shape[1])
    others = cKDTree(other_points) if len(other) else None
    label, found = regions(points), []
    for number in range(int(label.max(initial=-1)) + 1):
        members = np.flatnonzero(label == number)
        inside, around = (_near(others, points[members], radius * r) for r in (1.0, 2.0))
        broken = sum(other[place].failed for place in inside)
        if broken and not earlier:
            continue
        volume = fmc(points[members])
        seen = other_points[around]
        shared = volume + fmc(seen) - fmc(np.concatenate([points[members], seen]))
        cases = [failed[member] for member in members]
        worst = min(cases, key=lambda o: (o.score, o.index))
        found.append(
            Region(
                of=of,
                level=level,
                became=_became(len(inside), broken, earlier=earlier),
                failures=len(cases),
                worst=worst.index,
                where=_where([o.case for o in cases]),
                fmc=volume,
                cases=len(inside),
                failed=broken,
                looked_at=min(max(shared / volume, 0.0), 1.0),
            )
        )
    return found


def _near(tree: cKDTree | None, points: FloatArray, radius: float) -> list[int]:
    """Return which points of a tree are no further than a radius from one of some points."""
    if tree is None:
        return []
    return sorted(set().union(*tree.query_ball_point(points, radius * (1.0 + ROUNDING))))


def _became(cases: int, failed: int, *, earlier: bool) -> Became:
    if failed:
        return Became.STILL
    if not cases:
        return Became.NOT_SEEN_AFTER if earlier else Became.NOT_SEEN_BEFORE
    return Became.FIXED if earlier else Became.BROKE


def _where(cases: Sequence[Case]) -> str:
    """Return the box of some cases in words."""
    parts = []
    for coordinate in coordinates(cases[0].scenario, (cases[0].level,)):
        inside = sorted(cases, key=lambda case: coordinate.of(case) or 0.0)
        low, high = coordinate.text(inside[0]), coordinate.text(inside[-1])
        span = low if low == high else f"{low} to {high}"
        parts.append(f"{coordinate.name} {span} {coordinate.unit}")
    return ", ".join(parts)
