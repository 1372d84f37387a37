"""How likely a VUT is to fail under a stated distribution over the pool, with an interval.

The cases of a campaign were chosen because they were expected to fail, each in the light of those
before it. No share of them says how likely a failure is, and no binomial interval of theirs is
valid. So they only shape a proposal; the estimate rests on fresh cases, drawn independently from a
mixture whose density is known:

    q = DEFENSIVE p + (1 - DEFENSIVE) g,    g in proportion to p sqrt(P(fail | surrogate)),

with p the stated distribution. The square root is what has the least variance where a case fails
with a chance (Kahn and Marshall, 1953); the defensive share bounds the weights p / q by
1 / DEFENSIVE (Hesterberg, 1995), however wrong the surrogate is. The weighted failures are
independent and bounded, and the interval for their mean is by betting (Waudby-Smith and Ramdas,
2024): valid for every number of cases, without any law of large numbers.

The cases from the defensive part are a plain sample of p of their own: the uniform arm. Its
Clopper-Pearson interval is shown for comparison. Which of the two is reported is not to be chosen
after looking; it is the first.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.campaigns.conductor import OnCase
from merge_sumo.campaigns.ground import MAX_CORRIDORS, ProvingGround, road_for
from merge_sumo.campaigns.journal import Run
from merge_sumo.campaigns.settings import CampaignSettings, record_of, settings_of
from merge_sumo.errors import UserError
from merge_sumo.samplers.base import LevelHistory
from merge_sumo.samplers.belief import learn_chance
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.sumo.corridor import Corridor
from merge_sumo.sumo.net import Net
from merge_sumo.system.folders import check_new_file, write_new
from merge_sumo.values.case import Case, FloatArray, dimensions
from merge_sumo.values.scenario import US23, Dimension, Scenario
from merge_sumo.values.score import Outcome, measure

RESULT: Final = "probability.json"
LINES: Final = ".jsonl"
"""End of the name of the file beside it, with a line per fresh case."""
DEFENSIVE: Final = 0.5
"""Share of the fresh cases that are drawn from the stated distribution itself."""
DEFAULT_CASES: Final = 4000
CELLS: Final = {2: 64, 3: 24}
"""Cells per coordinate on which the proposal is constant."""
CHUNK: Final = 4096
"""Cells that are predicted at a time."""
BOLDNESS: Final = 0.9
"""The most that a bet may lose: 1 would be ruin by a single case."""
STREAM: Final = 7
"""Key of the random stream, so that it is none of a sampler's."""
WRITTEN: Final = 500
"""Cases after which outcomes are written and synced."""


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


@dataclass(frozen=True, slots=True)
class Draws:
    """Cases drawn independently from a proposal.

    Attributes:
        level: (n,).
        chances: place of each in the distribution, (n, 3); below level 2 the last is not used.
        weight: p / q, (n,).
        plain: whether it was drawn from the stated distribution itself, (n,).
    """

    level: NDArray[np.int64]
    chances: FloatArray
    weight: FloatArray
    plain: NDArray[np.bool_]


class Proposal:
    """The mixture q, relative to the stated distribution p, as a constant on each of many cells.

    The cells of a level are equally likely under p: they are boxes in the chances of its
    coordinates, where p is uniform.
    """

    def __init__(self, weights: Mapping[int, float], chance: Mapping[int, FloatArray]) -> None:
        """Take level weights, and P(fail) as expected in each cell of `cells(level)`, (c,)."""
        self._levels = list(weights)
        self._weights = np.array(list(weights.values()))
        wanted = [np.sqrt(chance[level]) for level in self._levels]
        mean = float(sum(w * s.mean() for w, s in zip(self._weights, wanted, strict=True)))
        # Where nothing is expected to fail anywhere, there is nothing to prefer.
        preferred = [s / mean if mean > 0.0 else np.ones_like(s) for s in wanted]
        self._density = [DEFENSIVE + (1.0 - DEFENSIVE) * s for s in preferred]
        """q / p in each cell of each level."""
        masses = [w * s / len(s) for w, s in zip(self._weights, preferred, strict=True)]
        self._mass = np.concatenate(masses)
        self._starts = np.cumsum([0, *map(len, masses)])

    @property
    def bound(self) -> float:
        """The greatest weight p / q anywhere."""
        return 1.0 / min(float(density.min()) for density in self._density)

    def total(self) -> float:
        """Return the integral of q, which is 1."""
        means = [density.mean() for density in self._density]
        return float(self._weights @ np.array(means))

    def draw(self, n: int, rng: np.random.Generator) -> Draws:
        """Return `n` independent draws."""
        plain = rng.random(n) < DEFENSIVE
        cell = rng.choice(len(self._mass), size=n, p=self._mass / self._mass.sum())
        place = np.where(
            plain,
            rng.choice(len(self._levels), size=n, p=self._weights),
            np.searchsorted(self._starts, cell, side="right") - 1,
        )
        chances = rng.random((n, 3))
        weight = np.empty(n)
        for number, level in enumerate(self._levels):
            here = place == number
            dims = len(dimensions(level))
            per_side = CELLS[dims]
            aimed = here & ~plain
            corner = np.unravel_index(cell[aimed] - self._starts[number], (per_side,) * dims)
            chances[aimed, :dims] = (np.stack(corner, axis=1) + chances[aimed, :dims]) / per_side
            weight[here] = self.weight(level, chances[here, :dims])
        return Draws(np.array(self._levels)[place], chances, weight, plain)

    def weight(self, level: int, chances: FloatArray) -> FloatArray:
        """Return p / q, (n,), at chances, (n, d), of a level."""
        dims = chances.shape[1]
        per_side = CELLS[dims]
        corner = np.minimum((chances * per_side).astype(np.int64), per_side - 1)
        cell = np.ravel_multi_index(tuple(corner.T), (per_side,) * dims)
        return np.asarray(1.0 / self._density[self._levels.index(level)][cell], dtype=np.float64)


def cells(level: int) -> FloatArray:
    """Return the middle of each cell of a level, in chances, (c, d)."""
    dims = len(dimensions(level))
    middle = (np.arange(CELLS[dims]) + 0.5) / CELLS[dims]
    return np.stack(np.meshgrid(*[middle] * dims, indexing="ij"), axis=-1).reshape(-1, dims)


def expected_chance(history: LevelHistory, points: FloatArray) -> FloatArray:
    """Return P(fail), (m,), that a surrogate expects at points, (m, d), from what has run.

    It may be as wrong as it likes: it costs width of the interval, not its validity.
    """
    chance = learn_chance(history)
    if chance is None:
        return np.zeros(len(points))
    parts = [points[first : first + CHUNK] for first in range(0, len(points), CHUNK)]
    return np.concatenate([chance(part) for part in parts])


@dataclass(frozen=True, slots=True)
class Arm:
    """The cases that were drawn from the stated distribution itself, and their interval."""

    cases: int
    failures: int
    probability: float | None
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Estimate:
    """A probability of failure, with an interval that holds with at least `confidence`.

    Attributes:
        probability: the weighted share of failures; cases without a verdict count as safe.
        low: end of the interval; cases without a verdict count as safe.
        high: end of the interval; cases without a verdict count as failures.
        confidence: chance that the interval holds the probability.
        cases: fresh cases.
        failures: failures among them.
        without_verdict: cases that ended as VUT_ERROR or SIM_ERROR.
        weight_bound: the greatest weight that a case could have had.
        uniform_arm: the plain sample among them, with its Clopper-Pearson interval.
    """

    probability: float
    low: float
    high: float
    confidence: float
    cases: int
    failures: int
    without_verdict: int
    weight_bound: float
    uniform_arm: Arm


def estimate(
    draws: Draws,
    failed: NDArray[np.bool_],
    judged: NDArray[np.bool_],
    bound: float,
    confidence: float,
) -> Estimate:
    """Return the estimate from draws, whether each failed, (n,), and had a verdict, (n,)."""
    alpha = 1.0 - confidence
    sure, possible = draws.weight * failed, draws.weight * (failed | ~judged)
    low = bound * mean_at_least(sure / bound, alpha / 2.0)
    high = bound * (1.0 - mean_at_least(1.0 - possible / bound, alpha / 2.0))
    return Estimate(
        probability=float(sure.mean()),
        low=low,
        high=min(high, 1.0),
        confidence=confidence,
        cases=len(failed),
        failures=int(failed.sum()),
        without_verdict=int((~judged).sum()),
        weight_bound=bound,
        uniform_arm=_arm(failed[draws.plain], judged[draws.plain], alpha),
    )


def mean_at_least(x: FloatArray, alpha: float) -> float:
    """Return a lower bound of a mean that is wrong with a chance of at most `alpha`.

    A gambler who doubts that the mean is m bets a part of the capital on each next value to be
    above m. If m is the mean, the game is fair, and the capital ever multiplies by 1 / alpha with
    a chance of at most alpha (Ville's inequality); so every m that made this gambler as rich is too
    small. The bets are those of Waudby-Smith and Ramdas (2024), eq. (26), with the variance of the
    past only.

    Args:
        x: independent values in [0, 1] with one mean, (n,), in the order in which they were drawn.
        alpha: chance of being wrong.
    """
    n = len(x)
    before = np.arange(n)
    number = np.maximum(before, 1)
    total, squares = np.cumsum(x) - x, np.cumsum(x * x) - x * x
    variance = np.maximum(squares / number - np.square(total / number), 0.0) + 1.0 / n
    bet = np.sqrt(2.0 * math.log(1.0 / alpha) / (n * variance))
    rich = math.log(1.0 / alpha)

    def doubted(m: float) -> bool:
        # The part at stake grows with the doubt, but never to ruin: 1 + bet (x - m) > 0.
        capital = np.cumsum(np.log1p(np.minimum(bet, BOLDNESS / m) * (x - m)))
        return bool(capital.max() >= rich)

    # The capital falls with m, so what is doubted ends at one place.
    low, high = 0.0, 1.0
    for _ in range(60):
        middle = (low + high) / 2.0
        low, high = (middle, high) if doubted(middle) else (low, middle)
    return low


def _arm(failed: NDArray[np.bool_], judged: NDArray[np.bool_], alpha: float) -> Arm:
    n, k = len(failed), int(failed.sum())
    low, _ = clopper_pearson(k, n, alpha)
    _, high = clopper_pearson(k + int((~judged).sum()), n, alpha)
    return Arm(n, k, k / n if n else None, low, high)


def clopper_pearson(failures: int, cases: int, alpha: float) -> tuple[float, float]:
    """Return the exact interval of a binomial share (Clopper and Pearson, 1934).

    Only for cases that were drawn independently: never for those that a sampler has chosen.
    """
    from scipy.stats import beta

    low, high = 0.0, 1.0
    if failures > 0:
        low = float(beta.ppf(alpha / 2.0, failures, cases - failures + 1))
    if failures < cases:
        high = float(beta.ppf(1.0 - alpha / 2.0, failures + 1, cases - failures))
    return low, high


def failure_probability(
    run: Run,
    out: Path,
    *,
    cases: int = DEFAULT_CASES,
    distribution: Path | None = None,
    confidence: float = 0.95,
    seed: int = 0,
    net: Net | Corridor | None = None,
    trust: bool = False,
    on_case: OnCase | None = None,
) -> Estimate:
    """Estimate how likely the VUT of a campaign is to fail, with fresh cases in SUMO.

    Writes the estimate with all that decides it to `out`, and the fresh outcomes, each with its
    weight, to the file of the same name that ends in .jsonl, synced every few hundred cases.

    The controller that a folder names runs only where the folder was made here, or with `trust`.

    Raises `UserError` for a distribution or numbers that make no sense, a run whose net or policies
    are not those of today, or files that exist or cannot be written.
    """
    if cases < 1:
        raise UserError(f"--cases is {cases}: it must be 1 or more")
    if not 0.5 <= confidence < 1.0:
        raise UserError(f"--confidence is {confidence}: choose 0.5 or more, and below 1")
    if seed < 0:
        raise UserError(f"--seed is {seed}: it must be 0 or more")
    settings = settings_of(run.folder, run.settings, trust=trust)
    net = net or road_for(settings.scenario)
    _same_system(run, record_of(settings, net))
    stated = read_distribution(distribution, settings.levels, settings.scenario)
    check_new_file(out)
    lines = out.with_suffix(LINES)
    if lines == out:
        raise UserError(f"--out is {out}: end it in .json, as cases go to {LINES} beside it")
    check_new_file(lines)
    told = make_sampler("uniform", settings.pool, 0)
    told.tell(run.outcomes)
    chance = {
        level: expected_chance(told.history(level), stated.points(level, cells(level)))
        for level in stated.levels
    }
    proposal = Proposal(stated.levels, chance)
    draws = proposal.draw(cases, np.random.default_rng([seed, STREAM]))
    outcomes = _run(settings, net, stated, draws, lines, on_case)
    failed = np.array([outcome.failed for outcome in outcomes])
    judged = np.array([outcome.measures.score is not None for outcome in outcomes])
    result = estimate(draws, failed, judged, proposal.bound, confidence)
    record = {
        **asdict(result),
        "distribution": stated.record(),
        "defensive_share": DEFENSIVE,
        "seed": seed,
        "campaign": record_of(settings, net),
    }
    write_new(out, (json.dumps(record, indent=2, allow_nan=False) + "\n").encode())
    return result


def _same_system(run: Run, today: Mapping[str, Any]) -> None:
    for name in ("net_sha256", "policies_sha256"):
        if run.settings.get(name) != today[name]:
            what = name.removesuffix("_sha256")
            hint = "name it with --net" if what == "net" else "run the campaign again"
            raise UserError(f"{run.folder} was run with another {what}: {hint}")


def _run(
    settings: CampaignSettings,
    net: Net | Corridor,
    stated: Distribution,
    draws: Draws,
    lines: Path,
    on_case: OnCase | None,
) -> list[Outcome]:
    """Run the draws in order, some at a time; write each outcome with its weight."""
    by_place: dict[int, Case] = {}
    for level in stated.levels:
        places = np.flatnonzero(draws.level == level)
        points = stated.points(level, draws.chances[places, : len(dimensions(level))])
        drawn = settings.pool.cases(points, level)
        by_place.update(zip(places.tolist(), drawn, strict=True))
    cases = [by_place[place] for place in range(len(by_place))]
    outcomes: list[Outcome] = []
    with ProvingGround(settings.vut_factory, min(MAX_CORRIDORS, len(cases)), net) as ground:
        for first in range(0, len(cases), WRITTEN):
            ran = []
            for place, trajectory in ground.run(cases[first : first + WRITTEN]):
                outcome = Outcome(
                    first + place, first // WRITTEN, trajectory.case, measure(trajectory)
                )
                ran.append(outcome)
                if on_case is not None:
                    on_case(outcome)
            ran.sort(key=lambda outcome: outcome.index)
            _append(lines, ran, draws)
            outcomes += ran
    return outcomes


def _append(lines: Path, outcomes: Sequence[Outcome], draws: Draws) -> None:
    try:
        with lines.open("a" if outcomes[0].index else "x", encoding="utf-8") as file:
            for o in outcomes:
                record = o.to_record()
                record["weight"] = float(draws.weight[o.index])
                record["plain"] = bool(draws.plain[o.index])
                file.write(json.dumps(record, allow_nan=False) + "\n")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise UserError(f"cannot write {lines}: {error.strerror}") from error
