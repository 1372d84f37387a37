"""Where on an acceleration lane a VUT merges, as a histogram in SVG without a script."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from merge_sumo.analysis.merging import BINS, SITES, MergeStatistics
from merge_sumo.values.scenario import Bounds

LEFT: Final = 40.0
RIGHT: Final = 380.0
TOP: Final = 22.0
BOTTOM: Final = 132.0
"""Edges of the plot in a picture of 400 by 172 (`templates/lane_picture.jinja`)."""
TICKS: Final = (0.0, 0.25, 0.5, 0.75, 1.0)


@dataclass(frozen=True, slots=True)
class Mark:
    """A published place of merging: CSS class of its label, x, and what it is called."""

    css: str
    x: float
    name: str


@dataclass(frozen=True, slots=True)
class LanePicture:
    """A histogram over the lane.

    Attributes:
        bars: CSS class, x, y, width and height of each bar; failures lie below the others.
        most: merges of the highest bin, at which the axis ends.
        ticks: x and words of the axis of places.
        expected: x of M, where a merge is expected.
        people: published means.
    """

    bars: list[tuple[str, float, float, float, float]]
    most: int
    ticks: list[tuple[float, str]]
    expected: float
    people: list[Mark]


def picture_of(found: MergeStatistics, lane_m: Bounds) -> LanePicture:
    """Return the histogram of merges from a lane that begins and ends at some coordinates."""
    pairs = list(zip(found.failing, found.others, strict=True))
    most = max(*map(sum, pairs), 1)
    bars = []
    for place, (failing, others) in enumerate(pairs):
        left, right = _x(place / BINS), _x((place + 1) / BINS)
        below = 0
        for css, count in (("fail", failing), ("pass", others)):
            if count:
                top, bottom = _y((below + count) / most), _y(below / most)
                bars.append((css, left, top, round(right - left - 0.8, 1), round(bottom - top, 1)))
                below += count
    begin_m, end_m = lane_m
    sites = sorted(SITES, key=lambda site: site.lane_share)
    people = [
        # The labels of the first two, which are a hundredth apart, go to either side.
        Mark("start" if place else "end", _x(site.lane_share), site.name)
        for place, site in enumerate(sites)
    ]
    ticks = [(_x(share), f"{share:.0%}") for share in TICKS]
    return LanePicture(bars, most, ticks, _x(-begin_m / (end_m - begin_m)), people)


def _x(share: float) -> float:
    return round(LEFT + (RIGHT - LEFT) * share, 1)


def _y(share: float) -> float:
    return round(BOTTOM - (BOTTOM - TOP) * share, 1)
