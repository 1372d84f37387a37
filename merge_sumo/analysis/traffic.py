"""The traffic on a mainline: how dense it is, and how fast its cars are, with a source.

density_veh_per_km = 8.7
source = "who has measured it, and where it is published"

[speeds]                         # m/s
kind = "normal"
mean = 25.1
sd = [2.6, 3.1]                  # a number, or a range where only that is known
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from msgspec import Meta

from merge_sumo.analysis.exposure import Histogram, Marginal, Normal, Weights
from merge_sumo.errors import UserError
from merge_sumo.system.records import Record, convert, read_toml, replaced, to_plain
from merge_sumo.system.suggestions import meant
from merge_sumo.values.scenario import Dimension

FOLDER: Final = Path(__file__).resolve().parent / "traffics"
SUFFIX: Final = ".toml"
LEAST_SD_MPS: Final = 0.01
MOST_SD_MPS: Final = 100.0
LEAST_INSIDE: Final = 0.01
"""Share of the speeds of a traffic that a pool has at least, or nothing is estimated."""
Density = Annotated[float, Meta(gt=0.0, le=1000.0)]
"""Vehicles per kilometre of a lane; 1,000 would be cars of a metre, one behind the other."""


@dataclass(frozen=True, slots=True)
class SpeedsInPool:
    """The speeds of a traffic that lie in a pool.

    Attributes:
        share: share of all its speeds.
        marginal: their distribution.
        sd_mps: standard deviation of all speeds, where the traffic states a range of it.
    """

    share: float
    marginal: Marginal
    sd_mps: float | None = None


class NormalSpeeds(Record, frozen=True, tag_field="kind", tag="normal"):
    """A normal distribution of speeds, in m/s; `sd` is [low, high] where only a range is known."""

    mean: Annotated[float, Meta(gt=0.0, le=100.0)]
    # Bounds of a number beside a list are more than msgspec 0.22 can read: `check` has them.
    sd: float | tuple[float, float]

    def check(self) -> None:
        """Raise `UserError` where `sd` is no number within its bounds, and no range of them."""
        low, high = LEAST_SD_MPS, MOST_SD_MPS
        rises = len(self._ends) == 1 or self._ends[0] < self._ends[1]
        if not (rises and all(low <= sd <= high for sd in self._ends)):
            stated = list(self.sd) if isinstance(self.sd, tuple) else self.sd
            raise UserError(f"sd is {stated}: choose {low:g} to {high:g}, or [low, high]")

    @property
    def _ends(self) -> tuple[float, ...]:
        """The standard deviation, or the ends of its range."""
        return self.sd if isinstance(self.sd, tuple) else (self.sd,)

    def within(self, d: Dimension) -> list[SpeedsInPool]:
        """Return the speeds within a coordinate of the pool, at each end of the range of `sd`."""
        from scipy.stats import norm

        found = []
        for sd in self._ends:
            low, high = norm.cdf((np.array([d.low, d.high]) - self.mean) / sd)
            marginal = Normal(mean=self.mean, sd=sd, low=d.low, high=d.high)
            named = sd if len(self._ends) > 1 else None
            found.append(SpeedsInPool(float(high - low), marginal, named))
        return found

    @property
    def words(self) -> str:
        """The distribution in words."""
        sd = " to ".join(f"{end:g}" for end in self._ends)
        return f"{self.mean:g} m/s in the mean, sd {sd}"


class HistogramSpeeds(Record, frozen=True, tag_field="kind", tag="histogram"):
    """Weights of bins of speeds between rising edges, in m/s, uniform within a bin."""

    edges: tuple[float, ...]
    weights: Weights

    def check(self) -> None:
        """Raise `UserError` where edges and weights make no distribution."""
        if len(self.edges) != len(self.weights) + 1:
            count = len(self.weights)
            raise UserError(f"{count} weights of speeds need {count + 1} edges")
        rise = (np.diff(self.edges) > 0.0).all() and np.isfinite(self.edges).all()
        if self.edges[0] < 0.0 or not rise:
            raise UserError("edges of speeds must rise, from 0 up, and be finite")
        if not 0.0 < sum(self.weights) < math.inf:
            raise UserError("weights of speeds must be not all 0, and finite")

    def within(self, d: Dimension) -> list[SpeedsInPool]:
        """Return the speeds within a coordinate of the pool."""
        edges, weights = np.array(self.edges), np.array(self.weights)
        cut = np.clip(edges, d.low, d.high)
        kept = np.diff(cut) > 0.0
        inside = weights * np.diff(cut) / np.diff(edges)
        total = float(inside[kept].sum())
        if total == 0.0:
            return [SpeedsInPool(0.0, self._marginal(edges, weights))]
        bounds = np.append(cut[:-1][kept], cut[1:][kept][-1])
        return [SpeedsInPool(total / weights.sum(), self._marginal(bounds, inside[kept]))]

    @staticmethod
    def _marginal(edges: Any, weights: Any) -> Histogram:
        return Histogram(edges=tuple(edges.tolist()), weights=tuple(weights.tolist()))

    @property
    def words(self) -> str:
        """The distribution in words."""
        return f"{self.edges[0]:g} to {self.edges[-1]:g} m/s, a histogram"


class Traffic(Record, frozen=True):
    """A traffic as its file states it.

    Attributes:
        source: where the figures are from.
        speeds: of the cars of the lane beside the ramp, in m/s.
        density_veh_per_km: cars per kilometre of that lane, before the ramp meets it; None where
            the source has none.
        name: name of its file.
    """

    source: Annotated[str, Meta(min_length=1, description="a text: where the figures are from")]
    speeds: NormalSpeeds | HistogramSpeeds
    density_veh_per_km: Density | None = None
    name: str = ""

    @property
    def density_veh_per_m(self) -> float:
        """Cars per metre; `UserError` without a density."""
        if self.density_veh_per_km is None:
            raise UserError(f"{self.name} states no density: give one with --density, in veh/km")
        return self.density_veh_per_km / 1000.0

    def checked(self) -> Traffic:
        """Return the traffic; `UserError` where it was made of values that no file may have."""
        traffic = convert(to_plain(self), Traffic)
        traffic.speeds.check()
        return traffic

    def with_density(self, density_veh_per_km: float | None) -> Traffic:
        """Return the traffic with another density; None is its own. `UserError` for no density."""
        if density_veh_per_km is None:
            return self
        if not 0.0 < density_veh_per_km <= 1000.0:
            raise UserError(
                f"--density is {density_veh_per_km}: choose more than 0, and up to 1000 veh/km"
            )
        return replaced(self, density_veh_per_km=float(density_veh_per_km))

    def speeds_within(self, d: Dimension) -> list[SpeedsInPool]:
        """Return the speeds within a coordinate of a pool, for each sd that the traffic states.

        Raises `UserError` where next to none lie in it.
        """
        found = self.speeds.within(d)
        if min(one.share for one in found) < LEAST_INSIDE:
            raise UserError(
                f"less than {LEAST_INSIDE:.0%} of the speeds of {self.name} ({self.speeds.words}) "
                f"lie in the pool, {d.low:g} to {d.high:g} m/s: run the campaign on a scenario "
                f"with other {d.field}"
            )
        return found

    def record(self) -> dict[str, Any]:
        """Return the traffic as JSON keeps it."""
        record: dict[str, Any] = to_plain(self)
        return record


def shipped_traffics() -> list[str]:
    """Return the names of the traffics that the package brings."""
    return sorted(path.stem for path in FOLDER.glob(f"*{SUFFIX}"))


def named_traffic(name: str) -> Traffic:
    """Return the traffic of a name or of a TOML file; `UserError` where there is none."""
    known = shipped_traffics()
    if name in known:
        return _read(FOLDER / f"{name}{SUFFIX}")
    if not name.endswith(SUFFIX):
        raise UserError(
            f"there is no traffic {name!r}: {meant(name, known)}choose {', '.join(known)}, or a "
            f"file NAME{SUFFIX}"
        )
    return _read(Path(name))


def _read(path: Path) -> Traffic:
    _, record = read_toml(path, "traffic")
    try:
        return convert({"name": path.stem, **record}, Traffic).checked()
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
