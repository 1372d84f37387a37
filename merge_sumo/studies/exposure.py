"""The distribution of cases that somebody states: levels and coordinates, each by itself."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from merge_sumo.errors import UserError
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import Dimension, Scenario
from merge_sumo.system.records import Record, decode, record_type, replaced, to_plain

Weight = Annotated[float, Meta(ge=0.0)]
Weights = Annotated[
    tuple[Weight, ...], Meta(min_length=1, description="weights, numbers of 0 or more")
]
ByLevel = Annotated[dict[str, Weight], Meta(description="weights, numbers of 0 or more, by level")]


class Uniform(Record, frozen=True, tag_field="kind", tag="uniform"):
    """All values from `low` to `high` alike; the bounds of the pool where none are stated."""

    low: float | None = None
    high: float | None = None

    def quantile(self, chance: FloatArray) -> FloatArray:
        """Return the values, (n,), at chances, (n,), in the unit of the coordinate."""
        assert self.low is not None and self.high is not None, "bounded"  # noqa: S101, PT018
        return self.low + chance * (self.high - self.low)


class Normal(Record, frozen=True, tag_field="kind", tag="normal"):
    """A normal distribution, cut off at `low` and `high`, by default the bounds of the pool."""

    mean: float
    sd: Annotated[float, Meta(ge=1e-3, le=1e3)]
    low: float | None = None
    high: float | None = None

    def check(self) -> None:
        """Raise `UserError` for a mean that is no number."""
        if not math.isfinite(self.mean):
            raise UserError(f"mean is {self.mean}: it must be finite")

    def within(self, low: float, high: float) -> tuple[float, Normal]:
        """Return the share of the values from `low` to `high`, and their distribution."""
        from scipy.stats import norm

        below, up_to = norm.cdf((np.array([low, high]) - self.mean) / self.sd)
        return float(up_to - below), replaced(self, low=low, high=high)

    def quantile(self, chance: FloatArray) -> FloatArray:
        """Return the values, (n,), at chances, (n,), in the unit of the coordinate."""
        from scipy.stats import truncnorm

        assert self.low is not None and self.high is not None, "bounded"  # noqa: S101, PT018
        low, high = (self.low - self.mean) / self.sd, (self.high - self.mean) / self.sd
        values = truncnorm(low, high, loc=self.mean, scale=self.sd).ppf(chance)
        return np.asarray(values, dtype=np.float64)


class Histogram(Record, frozen=True, tag_field="kind", tag="histogram"):
    """Weights of bins between rising edges, uniform within a bin."""

    edges: tuple[float, ...]
    weights: Weights

    def check(self) -> None:
        """Raise `UserError` where edges and weights make no distribution."""
        edges, weights = np.array(self.edges), self.weights
        if len(edges) != len(weights) + 1:
            raise UserError(f"{len(weights)} weights need {len(weights) + 1} edges")
        if not ((np.diff(edges) > 0.0).all() and np.isfinite(edges).all()):
            raise UserError("edges must rise, and be finite")
        if not 0.0 < sum(weights) < math.inf:
            raise UserError("weights must be not all 0, and finite")

    def within(self, low: float, high: float) -> tuple[float, Histogram]:
        """Return the share of the values from `low` to `high`, and their distribution."""
        edges, weights = np.array(self.edges), np.array(self.weights)
        cut = np.clip(edges, low, high)
        inside = weights * np.diff(cut) / np.diff(edges)
        kept = np.diff(cut) > 0.0
        if not kept.any():
            return 0.0, self
        bounds = np.append(cut[:-1][kept], cut[1:][kept][-1])
        cut_off = Histogram(edges=tuple(bounds.tolist()), weights=tuple(inside[kept].tolist()))
        return float(inside.sum() / weights.sum()), cut_off

    def quantile(self, chance: FloatArray) -> FloatArray:
        """Return the values, (n,), at chances, (n,), in the unit of the coordinate."""
        edges, weights = np.array(self.edges), np.array(self.weights)
        below = np.concatenate([[0.0], np.cumsum(weights) / weights.sum()])
        bin_ = np.clip(np.searchsorted(below, chance, side="right") - 1, 0, len(weights) - 1)
        share = (chance - below[bin_]) / np.maximum(np.diff(below)[bin_], 1e-300)
        values = edges[bin_] + np.clip(share, 0.0, 1.0) * np.diff(edges)[bin_]
        return np.asarray(values, dtype=np.float64)


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
            values = self.marginals[d.field].quantile(chance)
            columns.append(np.clip((values - d.low) / (d.high - d.low), 0.0, 1.0))
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

    A normal distribution is cut off at the pool's bounds. Raises `UserError` with the place in the
    file where it is no distribution over the cases of `levels`.
    """
    coordinates = scenario.dimensions(2)
    fields = [(d.field, Marginal, Uniform()) for d in coordinates]
    even = dict.fromkeys(map(str, levels), 1.0)
    kind = record_type("distribution", [("levels", ByLevel | None, None), *fields])
    try:
        stated = kind() if path is None else decode(path.read_bytes(), kind)
        marginals = {d.field: _in_pool(getattr(stated, d.field), d) for d in coordinates}
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
    return Distribution(shares, marginals, scenario)


def _in_pool(stated: Marginal, d: Dimension) -> Marginal:
    """Return a distribution of a coordinate with the bounds of the pool where it has none.

    Raises `UserError` where it reaches out of the pool, or never comes to it.
    """
    if isinstance(stated, Histogram):
        stated.check()
        if stated.edges[0] < d.low or stated.edges[-1] > d.high:
            raise UserError(f"{d.field}: edges must be within the pool, {d.low:g} to {d.high:g}")
        return stated
    low = d.low if stated.low is None else stated.low
    high = d.high if stated.high is None else stated.high
    if not d.low <= low < high <= d.high:
        raise UserError(
            f"{d.field}: low is {low:g} and high {high:g}: choose low < high within the pool, "
            f"{d.low:g} to {d.high:g}"
        )
    bounded = replaced(stated, low=low, high=high)
    if not np.isfinite(bounded.quantile(np.array([0.01, 0.5, 0.99]))).all():
        raise UserError(f"{d.field}: such a normal distribution never comes to the pool")
    return bounded
