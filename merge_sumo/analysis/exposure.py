"""The distribution of cases: that of each coordinate, or a measured traffic.

A traffic states the density and the speeds of the mainline, with a source:

    density_veh_per_km = 8.7     # of the lane next to the ramp, before the ramp meets it
    source = "who has measured it, and where it is published"

    [speeds]                     # m/s
    kind = "normal"
    mean = 25.1
    sd = 2.85
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from merge_sumo.errors import UserError, explained
from merge_sumo.records import Record, convert, decode, read_toml, record_type, to_plain
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import Coordinate, Scenario

Weight = Annotated[float, Meta(ge=0.0)]
Weights = Annotated[
    tuple[Weight, ...], Meta(min_length=1, description="a list of weights, each 0 or more")
]
ByLevel = Annotated[dict[str, Weight], Meta(description="weights by level, each 0 or more")]
LEAST_INSIDE = 1e-9
"""Minimum share of a distribution within the pool: with less its quantiles are not numbers."""


class _Shape(Record, frozen=True):
    """A distribution of a coordinate, cut off at `low` and `high`: by default the pool's bounds."""

    low: float | None = None
    high: float | None = None

    @abstractmethod
    def law(self, low: float, high: float) -> Any:
        """Return the distribution of scipy, before it is cut off.

        Args:
            low: lower bound, in the unit of the coordinate.
            high: upper bound.

        Raises:
            UserError: for wrong edges or weights of a histogram.
        """

    def ends(self, low: float, high: float) -> tuple[float, float]:
        """Return the probabilities to be below each of two bounds.

        Args:
            low: lower bound, in the unit of the coordinate.
            high: upper bound.
        """
        below, up_to = self.law(low, high).cdf([low, high]).tolist()
        return below, up_to

    def quantiles(self, coordinate: Coordinate, chances: FloatArray) -> FloatArray:
        """Return values of a coordinate, (n,), in its unit.

        Args:
            coordinate: the coordinate.
            chances: probabilities to be below the values, (n,).
        """
        low, high, below, up_to = self.cut(coordinate)
        values = self.law(low, high).ppf(below + chances * (up_to - below))
        return np.clip(np.asarray(values, dtype=np.float64), low, high)

    def cut(self, coordinate: Coordinate) -> tuple[float, float, float, float]:
        """Return the bounds at which it is cut off, and the probabilities to be below each.

        Args:
            coordinate: the coordinate, with the bounds of the pool.

        Raises:
            UserError: where the bounds are not within the pool, or no values are between them.
        """
        low = coordinate.low if self.low is None else self.low
        high = coordinate.high if self.high is None else self.high
        if not coordinate.low <= low < high <= coordinate.high:
            raise UserError(
                f"{coordinate.field}: low is {low:g} and high is {high:g}: choose low < high "
                f"within the pool, {coordinate.low:g} to {coordinate.high:g}"
            )
        below, up_to = self.ends(low, high)
        if not up_to - below > LEAST_INSIDE:
            raise UserError(f"{coordinate.field}: the distribution has no values within the pool")
        return low, high, below, up_to


class Uniform(_Shape, frozen=True, tag_field="kind", tag="uniform"):
    """A uniform distribution."""

    def law(self, low: float, high: float) -> Any:
        """Return the distribution of scipy, before it is cut off.

        Args:
            low: lower bound, in the unit of the coordinate.
            high: upper bound.
        """
        from scipy.stats import uniform

        return uniform(low, high - low)


class Normal(_Shape, frozen=True, kw_only=True, tag_field="kind", tag="normal"):
    """A normal distribution, cut off at the bounds.

    Attributes:
        mean: its mean before it is cut off, in the unit of the coordinate.
        sd: its standard deviation, likewise.
    """

    mean: float
    sd: Annotated[float, Meta(ge=1e-3, le=1e3)]

    def law(self, low: float, high: float) -> Any:
        """Return the distribution of scipy, before it is cut off.

        Args:
            low: lower bound, in the unit of the coordinate.
            high: upper bound.
        """
        from scipy.stats import norm

        return norm(self.mean, self.sd)


class Histogram(_Shape, frozen=True, kw_only=True, tag_field="kind", tag="histogram"):
    """A distribution that is uniform within each of n bins.

    Attributes:
        edges: edges of the bins, rising, (n + 1,), in the unit of the coordinate.
        weights: weights of the bins, (n,).
    """

    edges: tuple[float, ...]
    weights: Weights

    def law(self, low: float, high: float) -> Any:
        """Return the distribution of scipy, before it is cut off.

        Args:
            low: lower bound, in the unit of the coordinate.
            high: upper bound.
        """
        from scipy.stats import rv_histogram

        edges, weights = np.array(self.edges), self.weights
        if len(edges) != len(weights) + 1:
            raise UserError(f"{len(weights)} weights need {len(weights) + 1} edges")
        if not ((np.diff(edges) > 0.0).all() and np.isfinite(edges).all()):
            raise UserError("edges must be finite and in rising order")
        if not 0.0 < sum(weights) < math.inf:
            raise UserError("weights must be finite, and one of them above 0")
        return rv_histogram((np.array(weights), edges), density=False)


Marginal = Uniform | Normal | Histogram
"""The distribution of one coordinate inside the pool."""


@dataclass(frozen=True, slots=True)
class Distribution:
    """The probabilities of cases: weights of levels, and independent coordinates.

    Example:
        distribution = read_distribution(Path("cases.json"), levels=(0, 1), scenario=US23)
        points = distribution.points(0, rng.random((100, 2)))

    Attributes:
        levels: probability of each level; they add up to 1.
        marginals: by the name of the coordinate, the same at all levels.
        scenario: the scenario of the pool.
    """

    levels: dict[int, float]
    marginals: dict[str, Marginal]
    scenario: Scenario

    def points(self, level: int, chances: FloatArray) -> FloatArray:
        """Return points of the unit cube, (n, d).

        Args:
            level: level of the POV.
            chances: quantiles of the coordinates, (n, d); uniform ones give a sample.
        """
        columns = []
        for d, chance in zip(self.scenario.dimensions(level), chances.T, strict=True):
            values = self.marginals[d.field].quantiles(d, chance)
            columns.append((values - d.low) / (d.high - d.low))
        return np.column_stack(columns)

    def record(self) -> dict[str, Any]:
        """Return the distribution as a file has it."""
        levels = {str(level): weight for level, weight in self.levels.items()}
        return {"levels": levels, **to_plain(self.marginals)}


def read_distribution(
    path: Path | str | None, levels: Sequence[int], scenario: Scenario
) -> Distribution:
    """Return the distribution in a JSON file, cut off at the pool's bounds.

    The file has weights of levels and one entry for each coordinate; missing ones are uniform:

        {"levels": {"1": 3, "2": 1},
         "x_pov0_m": {"kind": "uniform", "low": -300, "high": -200},
         "v_pov0_mps": {"kind": "normal", "mean": 30, "sd": 2},
         "svo_rad": {"kind": "histogram", "edges": [0, 0.5, 1.5], "weights": [2, 1]}}

    Args:
        path: the JSON file; None for the uniform distribution.
        levels: levels of the cases.
        scenario: scenario of the cases.

    Raises:
        UserError: where the file is not a distribution over the cases of `levels`.
    """
    coordinates = scenario.dimensions(2)
    fields = [(d.field, Marginal, Uniform()) for d in coordinates]
    even = dict.fromkeys(map(str, levels), 1.0)
    kind = record_type("distribution", [("levels", ByLevel, {}), *fields])
    marginals = {}
    with explained(str(path)):
        try:
            content = kind() if path is None else decode(Path(path).read_bytes(), kind)
        except OSError as error:
            raise UserError(f"it cannot be read ({error.strerror})") from error
        for d in coordinates:
            marginals[d.field] = getattr(content, d.field)
            marginals[d.field].cut(d)  # which raises for a wrong one
        weights = content.levels or even
        if not weights.keys() <= even.keys():
            known = ", ".join(sorted(even))
            raise UserError(f"the campaign does not have all of these levels: choose from {known}")
        total = sum(weights.values())
        if not 0.0 < total < math.inf:
            raise UserError("levels must have finite weights, and one of them above 0")
    shares = {int(level): weight / total for level, weight in weights.items() if weight > 0.0}
    return Distribution(shares, marginals, scenario)


FOLDER = Path(__file__).resolve().parent / "traffics"
SUFFIX = ".toml"
LEAST_SPEEDS = 0.01
"""Minimum share of the speeds of a traffic that must be within the pool."""


class Traffic(Record, frozen=True):
    """A traffic of the mainline.

    Example:
        cars_per_merge = named_traffic("exid-5").cars_in_pool(US23)

    Attributes:
        source: source of its figures.
        speeds: distribution of the speeds of cars on the lane next to the ramp, in m/s.
        density_veh_per_km: cars per kilometre of that lane, before the ramp meets it; 1,000 would
            be cars of a metre without gaps.
        name: name of its file.
    """

    source: Annotated[str, Meta(min_length=1, description="a text: the source of the figures")]
    speeds: Normal | Histogram
    density_veh_per_km: Annotated[float, Meta(gt=0.0, le=1000.0)]
    name: str = ""

    def share_in_pool(self, scenario: Scenario) -> float:
        """Return the share of the speeds within the pool of a scenario.

        Args:
            scenario: the scenario.

        Raises:
            UserError: where the scenario has several cars on the mainline, or the pool hardly any
                speeds of this traffic.
        """
        if scenario.vehicles > 2:
            raise UserError(
                f"{scenario.name} has its own cars ahead of the POV and behind it: use a traffic "
                "with a scenario that has none"
            )
        low, high = scenario.v_pov0_mps
        below, up_to = self.speeds.ends(low, high)
        if up_to - below < LEAST_SPEEDS:
            raise UserError(
                f"less than {LEAST_SPEEDS:.0%} of the speeds of {self.name} are within the pool, "
                f"{low:g} to {high:g} m/s: run a campaign on a scenario with another v_pov0_mps"
            )
        return up_to - below

    def in_pool(self, scenario: Scenario, levels: Sequence[int]) -> Distribution:
        """Return the distribution of the cases of a scenario: positions and psi are uniform.

        Args:
            scenario: the scenario.
            levels: levels of the cases.

        Raises:
            UserError: as `share_in_pool`.
        """
        self.share_in_pool(scenario)
        uniform = read_distribution(None, levels, scenario)
        return replace(uniform, marginals={**uniform.marginals, "v_pov0_mps": self.speeds})

    def cars_in_pool(self, scenario: Scenario) -> float:
        """Return the number of cars of the mainline per merge that start in the pool.

        Args:
            scenario: the scenario of the pool.
        """
        low_m, high_m = scenario.x_pov0_m
        return self.density_veh_per_km / 1000.0 * (high_m - low_m) * self.share_in_pool(scenario)


def named_traffic(name: str) -> Traffic:
    """Return a traffic of the package, or that of a TOML file.

    Args:
        name: name of the traffic, or path of the file.

    Raises:
        UserError: where no such traffic exists, or the file is not one.
    """
    shipped = {path.stem: path for path in sorted(FOLDER.glob(f"*{SUFFIX}"))}
    path = shipped.get(name, Path(name))
    if path.suffix != SUFFIX:
        raise UserError(
            f"unknown traffic {name!r}: choose {', '.join(shipped)}, or a file NAME{SUFFIX}"
        )
    _, record = read_toml(path, "traffic")
    with explained(str(path)):
        traffic = convert({"name": path.stem, **record}, Traffic)
        traffic.speeds.law(0.0, 1.0)
    return traffic
