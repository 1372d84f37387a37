"""The ground truth of a VUT: thousands of uniform cases, run once and kept in a cache."""

from __future__ import annotations

import hashlib
import io
import json
import stat
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from numbers import Integral
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
    regular,
    replace_own,
    sha256_of,
)
from merge_sumo.metrics.criterion import Criterion
from merge_sumo.metrics.fmc import fmc, growth_bound, has_neighbour, regions
from merge_sumo.metrics.outcome import Episode
from merge_sumo.records import decode, read_arrays
from merge_sumo.result import Result
from merge_sumo.scenario.case import FloatArray, Pool
from merge_sumo.scenario.scenario import OWN, Scenario, level_name
from merge_sumo.simulation.evaluate import evaluate
from merge_sumo.simulation.plan import Engine, SimulationPlan
from merge_sumo.workers import Workers

TRUTH_CASES = {0: 10_000, 1: 10_000, 2: 20_000, OWN: 10_000}
"""Uniform cases of the ground truth at each level, as in the paper."""
DENSE_CASES = 1_000_000
"""Uniform cases of a dense truth: of what the paper's number of them has missed, it shows most."""
COLUMNS = ("points", "margin", "in_sumo")
"""Arrays of a truth in the cache."""
MOST_FILES_BYTES = 1 << 26
"""Of a truth, besides its numbers: names and hashes of files."""
REAL_REGION = 0.03
"""A region of the truth counts when it holds at least this share of its failures."""
MOST_GROWTH = 0.2
"""A truth is too small to be divided by where as many further cases could add more than this to its
FMC. Measured with designs 1 and 2 in two and three coordinates: truths of 2,500 to 160,000 cases
that could add less had .77 to .97 of the coverage of 1,000,000 cases, the others .03 to .83."""
MOST_ALONE = 0.05
"""Share of failures without another one in the radius up to which regions can be told: where it is
more, a region falls apart into single failures. Chosen, not tuned."""


@dataclass(frozen=True, slots=True)
class Truth:
    """The ground truth of a VUT at a level: n uniform cases and what became of them.

    Attributes:
        points: cases in the unit cube, (n, d).
        margin: below 0 for a failure, (n,), NaN without a verdict.
        in_sumo: number of cases that ran in SUMO.
    """

    points: FloatArray
    margin: FloatArray
    in_sumo: int = 0

    @property
    def failures(self) -> FloatArray:
        """Points of the failing cases, (m, d)."""
        return self.points[self.margin < 0.0]

    def __repr__(self) -> str:
        """Return in a line what was found."""
        failures = self.failures
        return (
            f"<Truth: {len(failures)} failures in {len(self.points)} cases, "
            f"FMC {fmc(failures):.4f}>"
        )

    @property
    def growth(self) -> float:
        """The largest share that as many further cases could add to FMC (`growth_bound`)."""
        return growth_bound(self.failures)

    @property
    def is_small(self) -> bool:
        """Whether its FMC is too far from its limit for a share of it to mean anything."""
        return self.growth > MOST_GROWTH

    @property
    def tells_regions(self) -> bool:
        """Whether failures are dense enough to be linked into regions."""
        return self.alone <= MOST_ALONE

    @property
    def alone(self) -> float:
        """Share of the failures that have no other one within the radius of FMC."""
        linked = has_neighbour(self.failures)
        return 1.0 - float(linked.mean()) if len(linked) else 0.0

    def to_record(self) -> dict[str, Any]:
        """Return what JSON says of it."""
        failures = self.failures
        return {
            "cases": len(self.margin),
            "failures": len(failures),
            "fmc": fmc(failures),
            "region_sizes": np.bincount(regions(failures)).tolist(),
            "real_regions": len(self.real_regions()) if self.tells_regions else None,
            "fmc_growth": self.growth,
            "too_small": self.is_small,
            "in_sumo": self.in_sumo,
        }

    def real_regions(self) -> list[FloatArray]:
        """Return the points of each disjoint region with a real share of the failures."""
        points = self.failures
        labels = regions(points)
        groups = [points[labels == label] for label in np.unique(labels)]
        return [group for group in groups if len(group) >= REAL_REGION * len(points)]


OnCases = Callable[[int], None]
"""Told how many cases have just ended."""


def ground_truth(
    plan: SimulationPlan,
    level: int,
    cases: int | None = None,
    seed: int = 0,
    *,
    workers: Workers | None = None,
    cache: Path | None = None,
    on_cases: OnCases = lambda _: None,
) -> Truth:
    """Return the ground truth of a plan at a level, from the cache where it is there.

    Memory grows by 40 bytes a case and no more, whatever the number of cases.

    The cache's key is a hash of level, cases, seed, engine and of what decides outcomes by the
    plan, with the versions of the software. A truth is only used while the files are the same that
    the VUT loaded. A plan for the kinematic engine also takes the truth that SUMO gave.

    Args:
        plan: how cases run.
        level: POV level.
        cases: uniform cases; by default those of the paper at the level.
        seed: of their points.
        workers: where they run, by default in this process.
        cache: folder of truths, by default the user's.
        on_cases: told how many cases have just ended.

    Raises:
        UserError: where nothing can be kept in the cache, or others can write it.
    """
    count = TRUTH_CASES[level] if cases is None else cases
    for name, number, least in (("cases", count, 1), ("seed", seed, 0)):
        if not isinstance(number, Integral) or number < least:
            raise UserError(f"`{name}` is {number!r}: it must be a whole number, {least} or more")
    plan.povs.check_level(level)
    plan = plan.for_verdicts()
    kept = TruthKey(plan.key(level), level, count, seed, plan.engine)
    known = kept.read(plan.scenario, cache, (Engine.SUMO, plan.engine))
    if known is not None:
        return known[0]
    path = kept.path(cache)
    if not path.parent.is_dir():
        make_folder(path.parent, CACHE)
        path.parent.chmod(stat.S_IRWXU)
    check_own(path)
    check_private(path.parent)
    points = np.random.default_rng([seed, level]).random(
        (count, len(plan.scenario.dimensions(level)))
    )
    truth, files = _run(plan.at_level(level), level, points, workers, on_cases)
    arrays, columns = io.BytesIO(), {name: getattr(truth, name) for name in COLUMNS}
    np.savez(arrays, **columns, files=json.dumps(files), of=path.stem)
    replace_own(path, arrays.getvalue())
    return truth


def _run(
    plan: SimulationPlan,
    level: int,
    points: FloatArray,
    workers: Workers | None,
    on_cases: OnCases,
) -> tuple[Truth, Files]:
    """Run the cases at points, (n, d), and return the truth and the files that were loaded."""
    margins, in_sumo = np.full(len(points), np.nan), 0
    files = (plan.vut.files or {}) | plan.povs.files
    cases = Pool(levels=(level,), scenario=plan.scenario).cases(points, level)
    results = evaluate(plan, cases, workers, _margin_of)
    for place, (margin, by_sumo, loaded) in enumerate(results):
        margins[place] = margin
        in_sumo += by_sumo
        files |= {name: sha256 for name, sha256 in loaded.items() if name not in files}
        on_cases(1)
    return Truth(points, margins, in_sumo), files


def known_truth(
    plan: SimulationPlan, level: int, cases: int, seed: int = 0, *, cache: Path | None = None
) -> Truth | None:
    """Return the truth that the cache has, by whichever engine; None where it has none.

    Args:
        plan: how the cases would run.
        level: level of the POV.
        cases: number of cases.
        seed: seed of the cases.
        cache: folder of the truths; by default that of the user.
    """
    plan = plan.for_verdicts()
    found = TruthKey(plan.key(level), level, cases, seed).read(plan.scenario, cache)
    return None if found is None else found[0]


@dataclass(frozen=True, slots=True)
class TruthKey:
    """What a truth in the cache is of; nothing of the VUT is loaded to look for it.

    Attributes:
        plan: what decides the outcomes: `SimulationPlan.key` for the level.
        level: level of the POV.
        cases: number of cases.
        seed: seed of their points.
        engine: what moved the vehicles.
    """

    plan: Mapping[str, Any]
    level: int
    cases: int
    seed: int
    engine: Engine = Engine.SUMO

    def path(self, cache: Path | None = None) -> Path:
        """Return the file of the cache that such a truth is in."""
        key = hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()[:24]
        return (cache or cache_folder()) / f"truth-{key}.npz"

    def read(
        self,
        scenario: Scenario,
        cache: Path | None = None,
        engines: Iterable[Engine] = (Engine.SUMO, Engine.KINEMATIC),
    ) -> tuple[Truth, Path] | None:
        """Return the truth that is kept by the first of some engines, and its file; or None.

        Args:
            scenario: scenario of the cases.
            cache: folder of the truths; by default that of the user.
            engines: engines in the order of preference.
        """
        for engine in engines:
            path = replace(self, engine=engine).path(cache)
            truth = read_truth(path, self.level, self.cases, scenario)
            if truth is not None:
                return truth, path
        return None


def read_truth(path: Path, level: int, cases: int, scenario: Scenario) -> Truth | None:
    """Return what a file of the cache holds, which only its user can write.

    None where there is none, or it is torn, of other shapes or types, or another truth under this
    name, others can write the cache, or a file that the VUT loaded is not what it was.

    Args:
        path: the file.
        level: level that it is to hold.
        cases: number of cases that it is to hold.
        scenario: scenario of the cases.
    """
    dims = len(scenario.dimensions(level))
    try:
        numbers_bytes = 8 * cases * (dims + 1)
        check_private(path.parent)
        if regular(path).stat().st_size > numbers_bytes + MOST_FILES_BYTES:
            return None
        data = read_arrays(path, *COLUMNS, "files", "of")
        points, margin, in_sumo = (data[name] for name in COLUMNS)
        files = decode(str(data["files"]), dict[str, str | None])
        unchanged = all(sha256_of(Path(name)) == sha256 for name, sha256 in files.items())
        if str(data["of"]) != path.stem or not unchanged:
            return None
    except (OSError, UserError):
        return None
    shapes = points.shape, margin.shape, in_sumo.shape
    types = points.dtype.kind, margin.dtype.kind, in_sumo.dtype.kind
    if shapes != ((cases, dims), (cases,), ()) or types != ("f", "f", "i"):
        return None
    if not ((points >= 0.0) & (points <= 1.0)).all() or not 0 <= in_sumo <= cases:
        return None
    return Truth(points, margin, int(in_sumo))


def _margin_of(episode: Episode) -> tuple[float, bool, Files]:
    """Return the margin, NaN without a verdict, whether SUMO ran the case, and the loaded files."""
    margin = episode.outcome.margin
    files = episode.files | episode.pov_files
    return np.nan if margin is None else margin, episode.in_sumo, files


@dataclass(frozen=True, repr=False)
class TruthResult(Result):
    """The ground truth of a VUT at one or more POV levels.

    Attributes:
        vut: the VUT.
        truths: `Truth` by level: `points` in the unit cube, (n, d), their `margin`, (n,), and the
            points of the `failures`, (m, d).
        criterion: what counts as a failure.
        scenario: the scenario of the cases.
    """

    vut: str
    truths: dict[int, Truth]
    criterion: Criterion
    scenario: Scenario

    def to_record(self) -> dict[str, Any]:
        """Return what `--json` prints: that of the level, or sums with a list of the levels."""
        levels = [
            {"vut": self.vut, "level": level, **truth.to_record(), "fail_when": self.criterion.text}
            for level, truth in self.truths.items()
        ]
        if len(levels) == 1:
            return levels[0]
        sums: dict[str, Any] = {}
        for name in ("cases", "failures", "fmc", "real_regions"):
            of_levels = [one[name] for one in levels]
            sums[name] = None if None in of_levels else sum(of_levels)
        text, named = self.criterion.text, ",".join(map(level_name, self.truths))
        return {"vut": self.vut, "level": named, **sums, "fail_when": text, "levels": levels}
