"""The ground truth of a VUT: thousands of uniform cases, run once and kept in a cache."""

from __future__ import annotations

import hashlib
import io
import json
import stat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from merge_sumo.errors import UserError
from merge_sumo.files import (
    CACHE,
    Files,
    cache_folder,
    check_own,
    check_private,
    make_folder,
    replace_own,
    sha256_of,
)
from merge_sumo.metrics.criterion import Criterion
from merge_sumo.metrics.fmc import fmc, growth_bound, regions
from merge_sumo.metrics.outcome import Episode
from merge_sumo.records import decode, read_arrays
from merge_sumo.result import Result
from merge_sumo.scenario.case import FloatArray, from_unit
from merge_sumo.scenario.scenario import OWN, Scenario
from merge_sumo.simulation.evaluate import evaluate
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.workers import Workers

TRUTH_CASES = {0: 10_000, 1: 10_000, 2: 20_000, OWN: 10_000}
"""Uniform cases of the ground truth at each level, as in the paper."""
DENSE_CASES = 1_000_000
"""Uniform cases of a dense truth, which shows most failures that the paper's number has missed."""
REAL_REGION = 0.03
"""A region of the truth counts when it holds at least this share of its failures."""
MOST_GROWTH = 0.2
"""A truth is too small for shares and regions where the same number of further cases could add more
than this share to its FMC. Measured with designs 1 and 2 in two and three coordinates: truths of
2,500 to 160,000 cases that could add less had .77 to .97 of the coverage of 1,000,000 cases, the
others .03 to .83."""


@dataclass(frozen=True, slots=True)
class Truth:
    """The ground truth at one POV level: n uniform cases of d coordinates, and their margins.

    Example:
        ```python
        truth = ms.truth("design1", level=0).truths[0]
        share = len(truth.failures) / len(truth.margin)
        ```

    Attributes:
        points: cases in the unit cube, (n, d).
        margin: margin of each case, (n,); below 0 it fails, NaN if it is not judged.
        in_sumo: number of cases that ran in SUMO.
    """

    points: FloatArray
    margin: FloatArray
    in_sumo: int = 0

    @property
    def failures(self) -> FloatArray:
        """The points of the failing cases, (m, d)."""
        return self.points[self.margin < 0.0]

    @property
    def growth(self) -> float:
        """The largest share that n more cases could add to the FMC."""
        return growth_bound(self.failures)

    @property
    def is_small(self) -> bool:
        """Whether n more cases could add too much to the FMC to give shares and regions."""
        return self.growth > MOST_GROWTH

    def to_record(self) -> dict[str, Any]:
        """Return the object that `--json` prints."""
        failures = self.failures
        return {
            "cases": len(self.margin),
            "failures": len(failures),
            "fmc": fmc(failures),
            "region_sizes": np.bincount(regions(failures)).tolist(),
            "real_regions": None if self.is_small else len(self.real_regions()),
            "fmc_growth": self.growth,
            "too_small": self.is_small,
            "in_sumo": self.in_sumo,
        }

    def real_regions(self) -> list[FloatArray]:
        """Return the points (m, d) of each region with at least `REAL_REGION` of the failures."""
        points = self.failures
        labels = regions(points)
        real = np.flatnonzero(np.bincount(labels) >= REAL_REGION * len(points))
        return [points[labels == label] for label in real]


def ground_truth(
    plan: SimulationPlan,
    level: int,
    cases: int,
    seed: int = 0,
    *,
    workers: Workers | None = None,
    cache: Path | None = None,
    on_case: Callable[[int], None] = lambda _: None,
) -> Truth:
    """Return the ground truth of a plan at a level, from the cache where it is kept.

    A truth is only used while the files that the VUT loaded are the same. Memory grows by 40 bytes
    a case.

    Args:
        plan: how cases run.
        level: POV level.
        cases: number of uniform cases.
        seed: seed of their points.
        workers: where they run; None for this process.
        cache: folder of truths; None for that of the user.
        on_case: called with the number of cases that have ended.

    Raises:
        UserError: where nothing can be kept in the cache, or others can write it.
    """
    plan = plan.for_verdicts()
    known = known_truth(plan, level, cases, seed, cache=cache)
    if known is not None:
        return known
    path = truth_path(plan, level, cases, seed, cache=cache)
    if not path.parent.is_dir():
        make_folder(path.parent, CACHE)
        path.parent.chmod(stat.S_IRWXU)
    check_own(path)
    check_private(path.parent)
    rng = np.random.default_rng([seed, level])
    points = rng.random((cases, len(plan.scenario.dimensions(level))))
    uniform = from_unit(points, level, scenario=plan.scenario)
    margins, in_sumo = np.full(cases, np.nan), 0
    files = (plan.vut.files or {}) | plan.povs.files
    results = evaluate(plan.at_level(level), uniform, workers, _margin_of)
    for row, (margin, by_sumo, loaded) in enumerate(results):
        margins[row] = margin
        in_sumo += by_sumo
        files = loaded | files
        on_case(row + 1)
    content, text = io.BytesIO(), json.dumps(files)
    np.savez(content, points=points, margin=margins, in_sumo=in_sumo, files=text, of=path.stem)
    replace_own(path, content.getvalue())
    return Truth(points, margins, in_sumo)


def known_truth(
    plan: SimulationPlan, level: int, cases: int, seed: int = 0, *, cache: Path | None = None
) -> Truth | None:
    """Return a truth from the cache.

    Args:
        plan: how the cases would run.
        level: level of the POV.
        cases: number of cases.
        seed: seed of the cases.
        cache: folder of the truths; None for that of the user.

    Returns:
        The truth; None where the file is missing or torn, has other shapes or belongs to another
        key, where others can write the cache, and where a file that the VUT loaded has changed.
    """
    path = truth_path(plan, level, cases, seed, cache=cache)
    try:
        check_private(path.parent)
        data = read_arrays(path, "points", "margin", "in_sumo", "files", "of")
        files = decode(str(data["files"]), dict[str, str | None])
        unchanged = all(sha256_of(Path(name)) == sha256 for name, sha256 in files.items())
    except (OSError, UserError):
        return None
    points, margin = data["points"], data["margin"]
    shape = cases, len(plan.scenario.dimensions(level))
    has_shapes = points.shape == shape and margin.shape == shape[:1]
    if not (unchanged and has_shapes and str(data["of"]) == path.stem):
        return None
    return Truth(points, margin, int(data["in_sumo"]))


def truth_path(
    plan: SimulationPlan, level: int, cases: int, seed: int = 0, *, cache: Path | None = None
) -> Path:
    """Return the file of a truth in the cache: its name is a hash of all that decides it.

    Args:
        plan: how the cases run, with the engine that moves the vehicles.
        level: level of the POV.
        cases: number of cases.
        seed: seed of their points.
        cache: folder of the truths; None for that of the user.
    """
    record = {
        "plan": plan.for_verdicts().key(level),
        "level": level,
        "cases": cases,
        "seed": seed,
        "engine": plan.engine,
    }
    key = hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()[:24]
    return (cache or cache_folder()) / f"truth-{key}.npz"


def _margin_of(episode: Episode) -> tuple[float, bool, Files]:
    """Return the margin (NaN without a verdict), whether SUMO ran the case, and loaded files."""
    margin = episode.outcome.margin
    files = episode.files | episode.pov_files
    return np.nan if margin is None else margin, episode.in_sumo, files


@dataclass(frozen=True, repr=False)
class TruthResult(Result):
    """The ground truth of a controller: thousands of uniform cases at each POV level.

    `ms.truth` returns it.

    Example:
        ```python
        truth = ms.truth("design1", level=0).truths[0]
        failing = truth.points[truth.margin < 0.0]
        ```

    Attributes:
        vut: spec of the controller.
        truths: the truth of each level.
        criterion: failure criterion.
        scenario: scenario of the cases.
    """

    vut: str
    truths: dict[int, Truth]
    criterion: Criterion
    scenario: Scenario

    def to_record(self) -> dict[str, Any]:
        """Return the object that `--json` prints."""
        levels = [{"level": level, **truth.to_record()} for level, truth in self.truths.items()]
        return {"vut": self.vut, "fail_when": self.criterion.as_written, "levels": levels}
