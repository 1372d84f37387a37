"""Experiments on samplers: the ground truth of a VUT, and how near samplers come to it."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final

import numpy as np

from merge_sumo.campaign import ProvingGround, conduct, versions
from merge_sumo.case import Case, FloatArray, Pool, dimensions, from_unit, to_unit
from merge_sumo.drivers.policies import read_manifest
from merge_sumo.errors import UserError
from merge_sumo.fmc import RADIUS, fmc, regions
from merge_sumo.journal import UNREADABLE_NPZ
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.scenario import V_VUT0_MPS
from merge_sumo.score import FAILURE_SCORE, Outcome, measure
from merge_sumo.sumo.net import Net

TRUTH_CASES: Final = {0: 10_000, 1: 10_000, 2: 20_000}
"""Uniform cases of the ground truth at each level, as in the paper."""
CHUNK: Final = 500
"""Cases that a worker takes at a time."""
REAL_REGION: Final = 0.03
"""A region of the truth counts when it holds at least this share of its failures."""


@dataclass(frozen=True, slots=True)
class Truth:
    """The ground truth of a VUT at a level: n uniform cases and what became of them.

    Attributes:
        points: cases in the unit cube, (n, d).
        score: P, (n,), NaN without a verdict.
    """

    points: FloatArray
    score: FloatArray

    @property
    def failures(self) -> FloatArray:
        """Points of the failing cases, (m, d)."""
        return self.points[self.score < FAILURE_SCORE]

    def real_regions(self) -> list[FloatArray]:
        """Return the points of each disjoint region with a real share of the failures."""
        points = self.failures
        labels = regions(points)
        groups = [points[labels == label] for label in np.unique(labels)]
        return [group for group in groups if len(group) >= REAL_REGION * len(points)]


OnCases = Callable[[int], None]
"""Told how many cases have just ended."""


def workers_or_cores(workers: int | None) -> int:
    """Return the number of worker processes: as asked, or one for each core."""
    if workers is not None and workers < 1:
        raise UserError(f"--workers is {workers}: it must be 1 or more")
    return workers or os.cpu_count() or 1


def ground_truth(
    vut: str,
    level: int,
    cases: int | None = None,
    seed: int = 0,
    *,
    workers: int | None = None,
    cache: Path | None = None,
    on_cases: OnCases | None = None,
) -> Truth:
    """Return the ground truth of a VUT at a level, from the cache where it is there.

    The cache's key is a hash of everything that the outcomes depend on: VUT, cases, seed, net,
    policies, versions, and the sources of this package.
    """
    count = cases or TRUTH_CASES[level]
    if count < 1:
        raise UserError(f"--cases is {count}: it must be 1 or more")
    folder = cache or cache_folder()
    path = folder / f"truth-{_key(vut=vut, level=level, cases=count, seed=seed)}.npz"
    if path.is_file():
        try:
            with np.load(path, allow_pickle=False) as data:
                return Truth(data["points"], data["score"])
        except UNREADABLE_NPZ:
            path.unlink()  # a torn file of the cache is made again
    points = np.random.default_rng([seed, level]).random((count, len(dimensions(level))))
    chunks = [points[first : first + CHUNK] for first in range(0, count, CHUNK)]
    scores = []
    with _pool(workers_or_cores(workers), vut) as pool:
        for score in pool.map(_scores, [(level, chunk) for chunk in chunks]):
            scores.append(score)
            if on_cases is not None:
                on_cases(len(score))
    truth = Truth(points, np.concatenate(scores))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        torn = path.with_suffix(f".{os.getpid()}.tmp")
        with torn.open("wb") as file:
            np.savez(file, points=truth.points, score=truth.score)
        torn.replace(path)
    except OSError as error:
        raise UserError(f"cannot write the cache {folder}: {error.strerror}") from error
    return truth


def cache_folder() -> Path:
    """Return where ground truths are kept: MERGE_SUMO_CACHE, or the user's cache folder."""
    named = os.environ.get("MERGE_SUMO_CACHE")
    if named:
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "merge-sumo"


def _key(**what: Any) -> str:
    package = Path(__file__).resolve().parent
    sources = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        sources.update(source.read_bytes())
    depends = {
        **what,
        "v_vut0_mps": V_VUT0_MPS,
        "versions": versions(),
        "sources": sources.hexdigest(),
        "net": Net().sha256,
        "policies": {name: entry["sha256"] for name, entry in read_manifest().items()},
    }
    return hashlib.sha256(json.dumps(depends, sort_keys=True).encode()).hexdigest()[:24]


_ground: ProvingGround | None = None
"""The ground of a worker process."""


def _open_ground(vut: str) -> None:
    global _ground  # noqa: PLW0603 (one SUMO per process, opened once)
    _ground = ProvingGround(vut)


def _pool(workers: int, vut: str) -> ProcessPoolExecutor:
    # Spawned, because libsumo's simulation must not be forked.
    return ProcessPoolExecutor(workers, get_context("spawn"), _open_ground, (vut,))


def _run(cases: list[Case]) -> Iterator[tuple[int, Outcome]]:
    assert _ground is not None, "the pool's initialiser opens it"  # noqa: S101
    for place, trajectory in _ground.run(cases):
        yield place, Outcome(place, 0, trajectory.case, measure(trajectory))


def _scores(task: tuple[int, FloatArray]) -> FloatArray:
    level, points = task
    scores = np.full(len(points), np.nan)
    for place, outcome in _run(from_unit(points, level)):
        if outcome.measures.score is not None:
            scores[place] = outcome.measures.score
    return scores


@dataclass(frozen=True, slots=True)
class Search:
    """What one sampler found with one seed.

    Attributes:
        fmc: failure mode coverage after each batch.
        failures: failures found in all.
        points: points of the failures, (m, d).
        sampler_s: seconds spent in the sampler, without simulation.
    """

    fmc: list[float]
    failures: int
    points: FloatArray
    sampler_s: float


def _search(task: tuple[str, int, int, int, int]) -> Search:
    name, level, cases, batch, seed = task
    assert _ground is not None, "the pool's initialiser opens it"  # noqa: S101
    sampler = make_sampler(name, Pool(levels=(level,)), seed)
    spent = _Stopwatch()
    sampler.ask = spent.timed(sampler.ask)  # type: ignore[method-assign]
    sampler.tell = spent.timed(sampler.tell)  # type: ignore[method-assign]
    found: list[Case] = []
    curve = []
    for ran in conduct(sampler, _ground, cases, batch):
        found += [outcome.case for outcome, _ in ran if outcome.failed]
        curve.append(fmc(to_unit(found, level)))
    return Search(curve, len(found), to_unit(found, level), spent.seconds)


class _Stopwatch:
    def __init__(self) -> None:
        self.seconds = 0.0

    def timed(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def wrapper(*arguments: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*arguments)
            finally:
                self.seconds += time.perf_counter() - start

        return wrapper


@dataclass(frozen=True, slots=True)
class Comparison:
    """One sampler over all seeds: medians, with quartiles where they are named.

    `cases_to_50_percent_median` and `cases_to_90_percent_median` are cases until that share of
    the truth's FMC, None where the median seed does not reach it.
    """

    fmc_median: float
    fmc_quartiles: tuple[float, float]
    fmc_over_truth_median: float
    fmc_over_truth_quartiles: tuple[float, float]
    failures_median: float
    regions_found_median: float
    seeds_with_all_regions: int
    cases_to_50_percent_median: float | None
    cases_to_90_percent_median: float | None
    sampler_s_median: float
    fmc_by_batch_median: list[float]


def compare(
    vut: str,
    level: int,
    samplers: Sequence[str],
    *,
    seeds: int = 10,
    cases: int = 400,
    batch: int = 20,
    truth: Truth,
    workers: int | None = None,
    on_search: Callable[[str, int], None] | None = None,
) -> dict[str, Comparison]:
    """Run samplers with several seeds each and compare what they find with the truth."""
    tasks = [(name, level, cases, batch, seed) for name in samplers for seed in range(seeds)]
    searches: dict[str, list[Search]] = {name: [] for name in samplers}
    with _pool(workers_or_cores(workers), vut) as pool:
        for (name, *_, seed), search in zip(tasks, pool.map(_search, tasks), strict=True):
            searches[name].append(search)
            if on_search is not None:
                on_search(name, seed)
    truth_fmc, real = fmc(truth.failures), truth.real_regions()
    return {
        name: _compared(found, truth_fmc, real, batch, cases) for name, found in searches.items()
    }


def _compared(
    searches: list[Search], truth_fmc: float, real: list[FloatArray], batch: int, cases: int
) -> Comparison:
    final = np.array([search.fmc[-1] for search in searches])
    share = final / truth_fmc if truth_fmc > 0.0 else np.full(len(final), np.nan)
    found = np.array([sum(_found(search.points, region) for region in real) for search in searches])

    def cases_to(part: float) -> float | None:
        needed = []
        for search in searches:
            reached = np.flatnonzero(np.array(search.fmc) >= part * truth_fmc)
            needed.append(min((reached[0] + 1) * batch, cases) if reached.size else np.inf)
        median = float(np.median(needed))
        return median if np.isfinite(median) else None

    def quartiles(values: FloatArray) -> tuple[float, float]:
        low, high = np.quantile(values, [0.25, 0.75])
        return float(low), float(high)

    return Comparison(
        fmc_median=float(np.median(final)),
        fmc_quartiles=quartiles(final),
        fmc_over_truth_median=float(np.median(share)),
        fmc_over_truth_quartiles=quartiles(share),
        failures_median=float(np.median([search.failures for search in searches])),
        regions_found_median=float(np.median(found)),
        seeds_with_all_regions=int((found == len(real)).sum()),
        cases_to_50_percent_median=cases_to(0.5),
        cases_to_90_percent_median=cases_to(0.9),
        sampler_s_median=float(np.median([search.sampler_s for search in searches])),
        fmc_by_batch_median=np.median([search.fmc for search in searches], axis=0).tolist(),
    )


def _found(points: FloatArray, region: FloatArray) -> bool:
    """Return whether some failure that was found lies in a region of the truth."""
    if not len(points):
        return False
    distance = np.linalg.norm(points[:, None, :] - region[None, :, :], axis=2)
    return bool((distance <= RADIUS).any())
