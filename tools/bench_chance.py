"""Compare what is learned of failures by chance with probabilities in closed form.

`python tools/bench_chance.py`

The controllers of `tools/chance_vuts.py` fail with a probability that is known for each case. For
each of them, and each tolerated share p, prints the share of the exact coverage of all cases that
fail in more than p of their runs that a campaign reaches after 100 and 400 runs, counting only
cases that truly do, and how many of the cases that it calls failing truly are: with repeats where
they matter, with each case once, and with uniform cases once. Then what its surrogate learned of
P(fail): the Brier score of the next run of a uniform case, the best score that is possible, that
of the mean alone, and by tenths of the learned P(fail) the mean of the true one: within
half the radius of FMC of a case that ran more than once, where the report shows it, and beyond.

The surrogate was chosen on `Slope`; the others are reported, with seeds from 100 on.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import chance_vuts
import numpy as np
from bench_record import add_record_option, append_record
from numpy.typing import NDArray

from merge_sumo import api
from merge_sumo.coverage.fmc import RADIUS, fmc
from merge_sumo.samplers.belief import learn_chance, nearest
from merge_sumo.samplers.uniform import UniformSampler
from merge_sumo.scenario.case import Pool, from_unit, to_unit
from merge_sumo.scenario.scenario import US23
from merge_sumo.verdict.chance import by_case, failing_cases
from merge_sumo.verdict.score import Outcome

FloatArray = NDArray[np.float64]

LEVEL = 0
SHOWN = (100, 400)
NODES = 161
"""Nodes of each axis of the grid over the pool, by which exact values are computed."""
NEAR, FAR = "near cases that ran more than once", "far from them"
ONCE, AUTO, UNIFORM = "coverage, once", "coverage, --repeat auto", "uniform, once"


def nodes() -> FloatArray:
    """Return the nodes of a grid over the unit square, (n, 2)."""
    axes = np.meshgrid(*[np.linspace(0.0, 1.0, NODES)] * 2, indexing="ij")
    return np.stack(axes, axis=-1).reshape(-1, 2)


def exact(vut: str, points: FloatArray) -> FloatArray:
    """Return P(fail) at points of the unit square, (n,), in closed form."""
    cases = from_unit(points, LEVEL, scenario=US23)
    start = np.array([case.starts()[0] for case in cases]).reshape(-1, 2)
    controller: type[chance_vuts.Chance] = getattr(chance_vuts, vut)
    return controller.chance(start[:, 0], start[:, 1])


def searched(vut: str, sampler: str, seed: int, repeat: Any, tolerated: float) -> Sequence[Outcome]:
    """Return the outcomes of a campaign."""
    with tempfile.TemporaryDirectory() as folder:
        run = api.campaign(
            f"{Path(chance_vuts.__file__)}:{vut}",
            sampler=sampler,
            seed=seed,
            level=LEVEL,
            cases=max(SHOWN),
            repeat=repeat,
            tolerated=tolerated,
            out=Path(folder) / "run",
            progress=False,
        )
        return list(run.run.outcomes)


def found(vut: str, outcomes: Sequence[Outcome], tolerated: float) -> tuple[float, float]:
    """Return the covered share of the exact region, and the share of failing cases in it."""
    failing = [one.case for one in failing_cases(outcomes, tolerated)]
    points, grid = to_unit(failing, LEVEL, US23), nodes()
    right = exact(vut, points) > tolerated
    whole = fmc(grid[exact(vut, grid) > tolerated])
    return fmc(points[right]) / whole, float(right.mean()) if len(right) else 1.0


def learned(vut: str, outcomes: Sequence[Outcome], tolerated: float) -> dict[str, Any] | None:
    """Return scores and reliability of the learned P(fail); None where too little was seen."""
    sampler = UniformSampler(Pool(levels=(LEVEL,), scenario=US23), 0)
    sampler.tolerated = tolerated
    sampler.tell(outcomes)
    chance = learn_chance(sampler.history(LEVEL))
    if chance is None:
        return None
    grid = nodes()
    pair = said, true = chance(grid), exact(vut, grid)
    best = float((true * (1.0 - true)).mean())
    tenth = np.minimum((10.0 * said).astype(np.int64), 9)
    again = [one.case for one in by_case(outcomes) if one.runs > 1]
    near = nearest(grid, to_unit(again, LEVEL, US23)) <= RADIUS / 2.0
    return {
        "Brier": best + float(np.square(said - true).mean()),
        "best": best,
        "of the mean": float(true.mean() * (1.0 - true.mean())),
        "tenths": {
            where: {
                int(place): [float(values[inside & (tenth == place)].mean()) for values in pair]
                for place in np.unique(tenth[inside])
            }
            for where, inside in ((NEAR, near), (FAR, ~near))
        },
    }


def bench(
    vut: str, seeds: Sequence[int], tolerated_shares: Sequence[float], only_auto: bool
) -> dict[str, Any]:
    """Print and return the figures of a controller."""
    once = {
        name: [searched(vut, sampler, seed, 1, 0.0) for seed in seeds]
        for name, sampler in (() if only_auto else ((ONCE, "coverage"), (UNIFORM, "uniform")))
    }
    figures: dict[str, Any] = {}
    for tolerated in tolerated_shares:
        runs = {AUTO: [searched(vut, "coverage", seed, "auto", tolerated) for seed in seeds]}
        print(f"{vut}, p = {tolerated:g}: exact coverage reached, and cases called failing that do")
        for name, campaigns in (runs | once).items():
            rows = [[found(vut, outcomes[:n], tolerated) for n in SHOWN] for outcomes in campaigns]
            median = np.median(np.array(rows), axis=0)
            said = [learned(vut, outcomes, tolerated) for outcomes in campaigns]
            figures[f"p = {tolerated:g}, {name}"] = {"found": rows, "learned": said}
            columns = "  ".join(
                f"N={n}: {share:.2f}, {right:4.0%}"
                for n, (share, right) in zip(SHOWN, median.tolist(), strict=True)
            )
            print(f"  {name:24s}{columns}  {scores(said)}", flush=True)
        for where in (NEAR, FAR):
            tenths = reliability(figures[f"p = {tolerated:g}, {AUTO}"], where)
            print(f"  learned {where}, by tenths: {tenths}")
    return figures


def scores(said: Sequence[dict[str, Any] | None]) -> str:
    """Return the median Brier scores as cells of a table."""
    known = [one for one in said if one is not None]
    if not known:
        return "nothing learned"
    values = [float(np.median([one[key] for one in known])) for key in ("Brier", "best")]
    mean = float(np.median([one["of the mean"] for one in known]))
    return f"Brier {values[0]:.4f} (best {values[1]:.4f}, mean alone {mean:.4f})"


def reliability(figures: dict[str, Any], where: str) -> str:
    """Return by tenths of the learned P(fail) its mean and the true one, over all seeds."""
    tenths: dict[int, list[list[float]]] = {}
    for one in figures["learned"]:
        for place, pair in ({} if one is None else one["tenths"][where]).items():
            tenths.setdefault(place, []).append(pair)
    means = {place: np.mean(pairs, axis=0).tolist() for place, pairs in sorted(tenths.items())}
    return ", ".join(f"{said:.2f} is {true:.2f}" for said, true in means.values())


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vut", nargs="*", default=["Bell", "Step"], help="of chance_vuts.py")
    parser.add_argument("--tolerated", nargs="*", type=float, default=[0.1, 0.5])
    parser.add_argument("--only-auto", action="store_true", help="not with each case once")
    parser.add_argument("--first", type=int, default=100, help="first seed")
    parser.add_argument("--seeds", type=int, default=3)
    add_record_option(parser)
    asked = parser.parse_args()
    seeds = range(asked.first, asked.first + asked.seeds)
    figures = {vut: bench(vut, seeds, asked.tolerated, asked.only_auto) for vut in asked.vut}
    append_record(asked.record, "chance", figures)


if __name__ == "__main__":
    main()
