"""How often cases occur: the distribution that somebody states, each coordinate by itself."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from msgspec import Meta

from merge_sumo.errors import UserError
from merge_sumo.records import Record, decode, record_type, to_plain
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import Dimension, Scenario

Weight = Annotated[float, Meta(ge=0.0)]
Weights = Annotated[
    tuple[Weight, ...], Meta(min_length=1, description="weights, numbers of 0 or more")
]
ByLevel = Annotated[dict[str, Weight], Meta(description="weights, numbers of 0 or more, by level")]
LEAST_INSIDE: Final = 1e-9
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
