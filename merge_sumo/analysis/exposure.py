"""How often cases occur: a stated distribution of each coordinate, or a measured traffic.

A traffic states how dense the mainline is, and how fast its cars are, with a source:

    density_veh_per_km = 8.7     # of the lane beside the ramp, before the ramp meets it
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

from merge_sumo.errors import UserError
from merge_sumo.printable import meant
from merge_sumo.records import Record, convert, decode, read_toml, record_type, to_plain
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import Dimension, Scenario

Weight = Annotated[float, Meta(ge=0.0)]
Weights = Annotated[
    tuple[Weight, ...], Meta(min_length=1, description="weights, numbers of 0 or more")
]
ByLevel = Annotated[dict[str, Weight], Meta(description="weights, numbers of 0 or more, by level")]
LEAST_INSIDE = 1e-9
"""Share of a distribution that the pool has at least, or its quantiles are no numbers."""


class _Shape(Record, frozen=True):
    """A distribution of a coordinate, cut off at `low` and `high`: by default the pool's bounds."""

    low: float | None = None
    high: float | None = None

    @abstractmethod
    def law(self, low: float, high: float) -> Any:
        """Return it as scipy has it, before it is cut off at bounds."""

    def ends(self, low: float, high: float) -> FloatArray:
        """Return the chances to be below each of two bounds, (2,)."""
        return np.asarray(self.law(low, high).cdf([low, high]), dtype=np.float64)

    def quantiles(self, d: Dimension, chances: FloatArray) -> FloatArray:
        """Return the values, (n,), at chances, (n,), in the unit of a coordinate."""
        low, high = self.bounds(d)
        below, up_to = self.ends(low, high)
        values = self.law(low, high).ppf(below + chances * (up_to - below))
        return np.clip(np.asarray(values, dtype=np.float64), low, high)

    def bounds(self, d: Dimension) -> tuple[float, float]:
        """Return where it is cut off."""
        return d.low if self.low is None else self.low, d.high if self.high is None else self.high

    def check(self, d: Dimension) -> None:
        """Raise `UserError` where it reaches out of the pool, or never comes to it."""
        low, high = self.bounds(d)
        if not d.low <= low < high <= d.high:
            raise UserError(
                f"{d.field}: low is {low:g} and high {high:g}: choose low < high within the pool, "
                f"{d.low:g} to {d.high:g}"
            )
        below, up_to = self.ends(low, high)
        if not up_to - below > LEAST_INSIDE:
            raise UserError(f"{d.field}: such a distribution never comes to the pool")


class Uniform(_Shape, frozen=True, tag_field="kind", tag="uniform"):
    """All values alike."""

    def law(self, low: float, high: float) -> Any:
        """Return it as scipy has it."""
        from scipy.stats import uniform

        return uniform(low, high - low)


class Normal(_Shape, frozen=True, kw_only=True, tag_field="kind", tag="normal"):
    """A normal distribution."""

    mean: float
    sd: Annotated[float, Meta(ge=1e-3, le=1e3)]

    def law(self, low: float, high: float) -> Any:
        """Return it as scipy has it."""
        from scipy.stats import norm

        return norm(self.mean, self.sd)


class Histogram(_Shape, frozen=True, kw_only=True, tag_field="kind", tag="histogram"):
    """Weights of bins between rising edges, uniform within a bin."""

    edges: tuple[float, ...]
    weights: Weights

    def law(self, low: float, high: float) -> Any:
        """Return it as scipy has it; `UserError` where edges and weights make no distribution."""
        from scipy.stats import rv_histogram

        edges, weights = np.array(self.edges), self.weights
        if len(edges) != len(weights) + 1:
            raise UserError(f"{len(weights)} weights need {len(weights) + 1} edges")
        if not ((np.diff(edges) > 0.0).all() and np.isfinite(edges).all()):
            raise UserError("edges must rise, and be finite")
        if not 0.0 < sum(weights) < math.inf:
            raise UserError("weights must be not all 0, and finite")
        return rv_histogram((np.array(weights), edges), density=False)


Marginal = Uniform | Normal | Histogram
"""The distribution of one coordinate inside the pool."""


@dataclass(frozen=True, slots=True)
class Distribution:
    """The probabilities of cases: weights of levels, and independent coordinates.

    Attributes:
        levels: probability of each level; they add up to 1.
        marginals: by the name of the coordinate, the same at all levels.
        scenario: whose pool it is over.
    """

    levels: dict[int, float]
    marginals: dict[str, Marginal]
    scenario: Scenario

    def points(self, level: int, chances: FloatArray) -> FloatArray:
        """Return points of the unit cube, (n, d), at chances, (n, d): uniform ones are a sample."""
        columns = []
        for d, chance in zip(self.scenario.dimensions(level), chances.T, strict=True):
            values = self.marginals[d.field].quantiles(d, chance)
            columns.append((values - d.low) / (d.high - d.low))
        return np.column_stack(columns)

    def record(self) -> dict[str, Any]:
        """Return the distribution as a file says it."""
        levels = {str(level): weight for level, weight in self.levels.items()}
        return {"levels": levels, **to_plain(self.marginals)}


def read_distribution(path: Path | None, levels: Sequence[int], scenario: Scenario) -> Distribution:
    """Return the distribution that a JSON file states; without a file, uniform over the pool.

    The file has weights of levels and one entry for each coordinate; what is left out is uniform:

        {"levels": {"1": 3, "2": 1},
         "x_pov0_m": {"kind": "uniform", "low": -300, "high": -200},
         "v_pov0_mps": {"kind": "normal", "mean": 30, "sd": 2},
         "svo_rad": {"kind": "histogram", "edges": [0, 0.5, 1.5], "weights": [2, 1]}}

    It is cut off at the pool's bounds. Raises `UserError` with the place in the file where it is no
    distribution over the cases of `levels`.

    Args:
        path: the JSON file; None for the uniform distribution.
        levels: levels of the cases.
        scenario: scenario of the cases.
    """
    coordinates = scenario.dimensions(2)
    fields = [(d.field, Marginal, Uniform()) for d in coordinates]
    even = dict.fromkeys(map(str, levels), 1.0)
    kind = record_type("distribution", [("levels", ByLevel | None, None), *fields])
    try:
        stated = kind() if path is None else decode(path.read_bytes(), kind)
        for d in coordinates:
            getattr(stated, d.field).check(d)
        weights = even if stated.levels is None else stated.levels
        if not weights or not weights.keys() <= even.keys():
            known = ", ".join(sorted(even))
            raise UserError(f"levels must give weights to levels of the campaign: {known}")
        total = sum(weights.values())
        if not 0.0 < total < math.inf:
            raise UserError("levels must have weights that are not all 0, and finite")
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from error
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    shares = {int(level): weight / total for level, weight in weights.items() if weight > 0.0}
    marginals = {d.field: getattr(stated, d.field) for d in coordinates}
    return Distribution(shares, marginals, scenario)


FOLDER = Path(__file__).resolve().parent / "traffics"
SUFFIX = ".toml"
LEAST_SPEEDS = 0.01
"""Share of the speeds of a traffic that a pool has at least, or nothing is estimated."""


class Traffic(Record, frozen=True):
    """A traffic as its file states it.

    Attributes:
        source: where the figures are from.
        speeds: of the cars of the lane beside the ramp, in m/s.
        density_veh_per_km: cars per kilometre of that lane, before the ramp meets it; 1,000 would
            be cars of a metre, one behind the other.
        name: name of its file.
    """

    source: Annotated[str, Meta(min_length=1, description="a text: where the figures are from")]
    speeds: Normal | Histogram
    density_veh_per_km: Annotated[float, Meta(gt=0.0, le=1000.0)]
    name: str = ""

    def share_in_pool(self, scenario: Scenario) -> float:
        """Return the share of the speeds within the pool of a scenario.

        Raises:
            UserError: where the scenario has no coordinates of a single car of the mainline, or
                the pool next to no speeds of this traffic.
        """
        merge = scenario
        if merge.vehicles > 2:
            raise UserError(
                f"{merge.name} has cars ahead of the POV and behind it, at headways of its own: a "
                "traffic needs a scenario without them"
            )
        low, high = merge.v_pov0_mps
        below, up_to = self.speeds.ends(low, high).tolist()
        if up_to - below < LEAST_SPEEDS:
            raise UserError(
                f"less than {LEAST_SPEEDS:.0%} of the speeds of {self.name} lie in the pool, "
                f"{low:g} to {high:g} m/s: run the campaign on a scenario with other v_pov0_mps"
            )
        return float(up_to - below)

    def in_pool(self, scenario: Scenario, levels: Sequence[int]) -> Distribution:
        """Return how often the cases of a scenario occur, levels alike.

        Where cars start is uniform, and so is psi. Raises `UserError` as `share_in_pool`.
        """
        self.share_in_pool(scenario)
        uniform = read_distribution(None, levels, scenario)
        return replace(uniform, marginals={**uniform.marginals, "v_pov0_mps": self.speeds})

    def cars_in_pool(self, scenario: Scenario) -> float:
        """Return how many cars of the mainline, per merge, start in the pool of a scenario."""
        low_m, high_m = scenario.x_pov0_m
        return self.density_veh_per_km / 1000.0 * (high_m - low_m) * self.share_in_pool(scenario)


def shipped_traffics() -> list[str]:
    """Return the names of the traffics that the package brings."""
    return sorted(path.stem for path in FOLDER.glob(f"*{SUFFIX}"))


def named_traffic(name: str) -> Traffic:
    """Return the traffic of a name or of a TOML file; `UserError` where there is none."""
    known = shipped_traffics()
    if name not in known and not name.endswith(SUFFIX):
        raise UserError(
            f"there is no traffic {name!r}: {meant(name, known)}choose {', '.join(known)}, or a "
            f"file NAME{SUFFIX}"
        )
    path = FOLDER / f"{name}{SUFFIX}" if name in known else Path(name)
    _, record = read_toml(path, "traffic")
    try:
        traffic = convert({"name": path.stem, **record}, Traffic)
        traffic.speeds.law(0.0, 1.0)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    return traffic
