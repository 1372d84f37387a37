"""How often cases occur, as somebody states it: levels and coordinates, each by itself."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from merge_sumo.errors import UserError
from merge_sumo.values.case import FloatArray
from merge_sumo.values.scenario import US23, Dimension, Scenario


@dataclass(frozen=True, slots=True)
class Marginal:
    """The distribution of one coordinate inside the pool.

    Attributes:
        quantile: maps chances, (n,), to values in the coordinate's unit, (n,).
        record: what a file says of it.
    """

    quantile: Callable[[FloatArray], FloatArray]
    record: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Distribution:
    """What is said about how often cases occur: weights of levels, and independent coordinates.

    Attributes:
        levels: probability of each level; they add up to 1.
        marginals: by the name of the coordinate, the same at all levels.
        scenario: whose pool it is over.
    """

    levels: dict[int, float]
    marginals: dict[str, Marginal]
    scenario: Scenario = US23

    def points(self, level: int, chances: FloatArray) -> FloatArray:
        """Return points of the unit cube, (n, d), at chances, (n, d): uniform ones are a sample."""
        columns = []
        for d, chance in zip(self.scenario.dimensions(level), chances.T, strict=True):
            values = self.marginals[d.field].quantile(chance)
            columns.append(np.clip((values - d.low) / (d.high - d.low), 0.0, 1.0))
        return np.column_stack(columns)

    def record(self) -> dict[str, Any]:
        """Return the distribution as a file says it."""
        named = {name: marginal.record for name, marginal in self.marginals.items()}
        return {"levels": {str(level): weight for level, weight in self.levels.items()}, **named}


def read_distribution(
    path: Path | None, levels: Sequence[int], scenario: Scenario = US23
) -> Distribution:
    """Return the distribution that a JSON file states; without a file, uniform over the pool.

    The file has weights of levels and one entry for each coordinate; what is left out is uniform:

        {"levels": {"1": 3, "2": 1},
         "x_pov0_m": {"kind": "uniform", "low": -300, "high": -200},
         "v_pov0_mps": {"kind": "normal", "mean": 30, "sd": 2},
         "svo_rad": {"kind": "histogram", "edges": [0, 0.5, 1.5], "weights": [2, 1]}}

    A normal distribution is cut off at the pool's bounds. Raises `UserError` with the place in the
    file where it is no distribution over the cases of `levels`.
    """
    stated: Any = {}
    if path is not None:
        try:
            stated = json.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise UserError(f"cannot read {path}: {error.strerror}") from error
        except ValueError as error:
            raise UserError(f"{path} is not readable JSON: {error}") from error
    where = str(path)
    if not isinstance(stated, dict):
        raise UserError(f"{where} is not a JSON object")
    coordinates = {d.field: d for d in scenario.dimensions(2)}
    unknown = sorted(set(stated) - {"levels", *coordinates})
    if unknown:
        known = ", ".join(["levels", *coordinates])
        raise UserError(f"{where} has {unknown[0]!r}: it may have {known}")
    weights = _level_weights(stated.get("levels"), levels, where)
    marginals = {
        name: _marginal(stated.get(name, {"kind": "uniform"}), d, f"{where}: {name}")
        for name, d in coordinates.items()
    }
    return Distribution(weights, marginals, scenario)


def _level_weights(stated: Any, levels: Sequence[int], where: str) -> dict[int, float]:
    if stated is None:
        return {level: 1.0 / len(levels) for level in levels}
    able = {str(level) for level in levels}
    if not isinstance(stated, dict) or not stated or not set(stated) <= able:
        raise UserError(
            f"{where}: levels must give weights to levels of the campaign: "
            f"{', '.join(sorted(able))}"
        )
    weights = _numbers(list(stated.values()), f"{where}: levels")
    if min(weights) < 0.0 or sum(weights) <= 0.0:
        raise UserError(f"{where}: weights of levels must be 0 or more, and not all 0")
    return {int(level): w / sum(weights) for level, w in zip(stated, weights, strict=True) if w > 0}


def _marginal(stated: Any, d: Dimension, where: str) -> Marginal:
    if not isinstance(stated, dict):
        raise UserError(f"{where} is not a JSON object with a kind")
    kinds: dict[Any, tuple[tuple[str, ...], Callable[..., Marginal]]] = {
        "uniform": (("low", "high"), _uniform),
        "normal": (("mean", "sd", "low", "high"), _normal),
        "histogram": (("edges", "weights"), _histogram),
    }
    kind = stated.get("kind")
    if not isinstance(kind, str) or kind not in kinds:
        raise UserError(f"{where}: kind is {kind!r}: choose {', '.join(kinds)}")
    names, make = kinds[kind]
    for name in stated:
        if name not in ("kind", *names):
            raise UserError(f"{where}: {kind} has no {name!r}: it has {', '.join(names)}")
    bounds = {"low": d.low, "high": d.high} if "low" in names else {}
    values = {**bounds, **stated}
    for name in names:
        if name not in values:
            raise UserError(f"{where}: {kind} needs {name!r}")
    if bounds:
        low, high = _numbers([values["low"], values["high"]], where)
        if not d.low <= low < high <= d.high:
            raise UserError(
                f"{where}: low is {low:g} and high {high:g}: choose low < high within the pool, "
                f"{d.low:g} to {d.high:g}"
            )
    return make(values, d, where)


def _uniform(values: dict[str, Any], _: Dimension, __: str) -> Marginal:
    low, high = float(values["low"]), float(values["high"])
    return Marginal(lambda chance: low + chance * (high - low), values)


def _normal(values: dict[str, Any], _: Dimension, where: str) -> Marginal:
    from scipy.stats import truncnorm

    mean, sd = _numbers([values["mean"], values["sd"]], where)
    if sd <= 0.0:
        raise UserError(f"{where}: sd is {sd:g}: it must be above 0")
    low, high = ((float(values[end]) - mean) / sd for end in ("low", "high"))
    curve = truncnorm(low, high, loc=mean, scale=sd)
    if not np.isfinite(curve.ppf([0.01, 0.5, 0.99])).all():
        raise UserError(f"{where}: a normal around {mean:g} with sd {sd:g} never comes to the pool")
    return Marginal(lambda chance: np.asarray(curve.ppf(chance), dtype=np.float64), values)


def _histogram(values: dict[str, Any], d: Dimension, where: str) -> Marginal:
    edges = np.array(_numbers(values["edges"], f"{where}: edges"))
    weights = np.array(_numbers(values["weights"], f"{where}: weights"))
    if len(edges) != len(weights) + 1 or len(weights) < 1:
        raise UserError(f"{where}: {len(weights)} weights need {len(weights) + 1} edges")
    if (np.diff(edges) <= 0.0).any() or edges[0] < d.low or edges[-1] > d.high:
        raise UserError(f"{where}: edges must rise within the pool, {d.low:g} to {d.high:g}")
    if (weights < 0.0).any() or weights.sum() <= 0.0:
        raise UserError(f"{where}: weights must be 0 or more, and not all 0")
    below = np.concatenate([[0.0], np.cumsum(weights) / weights.sum()])
    width = np.diff(edges)

    def quantile(chance: FloatArray) -> FloatArray:
        bin_ = np.clip(np.searchsorted(below, chance, side="right") - 1, 0, len(weights) - 1)
        within = (chance - below[bin_]) / np.maximum(np.diff(below)[bin_], 1e-300)
        return np.asarray(edges[bin_] + np.clip(within, 0.0, 1.0) * width[bin_], dtype=np.float64)

    return Marginal(quantile, values)


def _numbers(values: Any, where: str) -> list[float]:
    """Return finite numbers from JSON; `UserError` for anything else."""
    if not isinstance(values, list) or not values:
        raise UserError(f"{where} is not a list of numbers")
    for value in values:
        if type(value) not in (int, float) or not math.isfinite(value):
            raise UserError(f"{where}: {value!r} is not a number")
    return [float(value) for value in values]
