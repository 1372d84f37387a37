"""Where on an acceleration lane a VUT merges and which gaps it accepts, beside published figures.

The published figures are those of people in traffic; the cases of a campaign are chosen by a
sampler and more contested than traffic. So they are put side by side, and no test is made of them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from statistics import median
from typing import Final

from merge_sumo.system.printable import counted
from merge_sumo.values.scenario import lane_of
from merge_sumo.values.score import Outcome


@dataclass(frozen=True, slots=True)
class Site:
    """What was published of a ramp: number of its merges, mean place of cars on the lane."""

    name: str
    merges: int
    lane_share: float


SOURCE: Final = "exiD, Li et al. 2023, arXiv 2303.11531"
SITES: Final = (Site("site 2", 1292, 0.32), Site("site 3", 565, 0.46), Site("site 5", 1573, 0.33))
"""Three German motorway ramps of exiD."""
REAR_HEADWAY_S: Final = (2.0, 2.7)
"""Medians of the headway to the car behind at the merge, over types of merges, on these ramps."""


@dataclass(frozen=True, slots=True)
class MergeStatistics:
    """Merges of some cases from an acceleration lane.

    Attributes:
        cases: cases that ran.
        merges: cases in which the VUT merged.
        lane_share: median place, as a share of the lane; None without a merge.
        forced: merges where the lane ends, which leave the VUT no choice.
        stood: cases in which the VUT stood on the lane.
        time_gap_ahead_s: median time gap to the car ahead; None without one.
        time_gap_behind_s: the same of the car behind.
    """

    cases: int
    merges: int
    lane_share: float | None
    forced: int
    stood: int
    time_gap_ahead_s: float | None
    time_gap_behind_s: float | None

    @property
    def sentence(self) -> str:
        """Return it as a line, with the published figures."""
        if self.lane_share is None:
            return f"no merge without an error in {counted(self.cases, 'case')}{self._stops}"
        shares = [site.lane_share for site in SITES]
        text = (
            f"merges {place_in_words(self.lane_share)} in the median (people in the mean: "
            f"{min(shares):.0%} to {max(shares):.0%}), {self.forced} of {self.merges} where it "
            f"ends{self._stops}"
        )
        low_s, high_s = REAR_HEADWAY_S
        if self.time_gap_ahead_s is not None:
            text += f"; median time gap ahead {self.time_gap_ahead_s:.2f} s"
        if self.time_gap_behind_s is not None:
            text += (
                f"; behind {self.time_gap_behind_s:.2f} s (people: headways of {low_s:g} to "
                f"{high_s:g} s)"
            )
        return text

    @property
    def _stops(self) -> str:
        return f"; it stood on the lane in {counted(self.stood, 'case')}" if self.stood else ""


def merging_of(outcomes: Iterable[Outcome]) -> MergeStatistics | None:
    """Return what is found of merges; None without cases, and where there is no lane."""
    ran = list(outcomes)
    if not ran or lane_of(ran[0].case.scenario) is None:
        return None
    shares = [share for o in ran if (share := o.measures.lane_share) is not None]
    return MergeStatistics(
        cases=len(ran),
        merges=len(shares),
        lane_share=_median(shares),
        forced=sum(share >= 1.0 for share in shares),
        stood=sum(o.measures.stood_s > 0.0 for o in ran),
        time_gap_ahead_s=_median(o.measures.time_gap_ahead_s for o in ran),
        time_gap_behind_s=_median(o.measures.time_gap_behind_s for o in ran),
    )


def place_in_words(lane_share: float) -> str:
    """Return where on the lane a merge is, in a phrase."""
    return "where the lane ends" if lane_share >= 1.0 else f"after {lane_share:.0%} of the lane"


def _median(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return median(known) if known else None
