"""The problems of the benchmark of samplers, and their dense truths, kept beside this file.

A problem is a frozen VUT, a scenario and POV levels. Its truth is what so many uniform cases found:
the failures alone, each coordinate in steps of 1 / 65,535 of its axis, in a file of
`truths/`, whose SHA-256 is in `manifest.json`. `make_truths.py` makes
both. With the failures come probe cases and the verdicts on them: whatever has changed in the code,
the benchmark goes on only where these verdicts are the same.
"""

from __future__ import annotations

import hashlib
import io
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Final

import frozen  # noqa: F401 (registers the VUTs)
import numpy as np
from numpy.typing import NDArray
from oracle import oracle
from scipy.spatial import cKDTree

from merge_sumo.analysis.truth import Truth, ground_truth
from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.errors import UserError
from merge_sumo.files import sha256_of
from merge_sumo.metrics.fmc import fmc, growth_bound, radius_for
from merge_sumo.printable import meant
from merge_sumo.records import Record, RecordError, read_arrays, read_record
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.case import FloatArray, Pool
from merge_sumo.scenario.imperfection import Actuation, Sensing
from merge_sumo.simulation.evaluate import simulate
from merge_sumo.simulation.kinematic_simulator import CHUNK
from merge_sumo.simulation.plan import SimulationPlan

TRUTHS: Final = Path(__file__).parent / "truths"
"""The folder of the truths."""
MANIFEST: Final = "manifest.json"
ORACLE_CASES: Final = 400
"""Cases up to which the oracle's coverage is kept."""
MOST_FAILURES: Final = 20_000
"""Failures of a level that a truth keeps at most: the first ones, which are as uniform as all."""
PROBES: Final = 48
"""Probe cases of a level that fail, and as many that pass within a radius of one that fails."""
STEPS: Final = 65_535
"""Steps of an axis in which a coordinate of a failure is kept."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Problem:
    """A problem that a sampler is to solve: find the failures of a VUT.

    Attributes:
        name: its name, also of its file.
        family: what kind of controller the VUT is, in a phrase.
        vut: spec of the VUT.
        scenario: name of the scenario.
        levels: POV levels; a search shares its cases out over them.
        cases: uniform cases of the truth at each level.
        sense: imperfect sensors, as after `--sense`.
        act: imperfect actuators, as after `--act`.
    """

    name: str
    family: str
    vut: str
    levels: tuple[int, ...]
    cases: int
    scenario: str = "us23"
    sense: str = ""
    act: str = ""

    def settings(self) -> CampaignSettings:
        """Return the settings of a campaign on it."""
        scenario = named_scenario(self.scenario)
        if self.sense:
            scenario = replace(scenario, sense=Sensing.parsed(self.sense, "--sense"))
        if self.act:
            scenario = replace(scenario, act=Actuation.parsed(self.act, "--act"))
        return CampaignSettings(vut=self.vut, levels=self.levels, scenario=scenario)

    def plan(self) -> SimulationPlan:
        """Return how its cases run: by the kinematic engine where VUT and POVs need no SUMO."""
        return resolve(self.settings()).with_engine(None)


PROBLEMS: Final = (
    Problem(
        name="rules",
        family="rules by thresholds, against POVs of all social orientations",
        vut="design1",
        levels=(2,),
        cases=1_000_000,
    ),
    Problem(
        name="reactive",
        family="rules by thresholds and a PID, against POVs that react",
        vut="design2",
        levels=(1,),
        cases=100_000,
    ),
    Problem(
        name="stateful",
        family="gap acceptance with hysteresis",
        vut="frozen:hysteresis",
        levels=(0,),
        cases=50_000,
    ),
    Problem(
        name="table",
        family="tabular",
        vut="frozen:table",
        levels=(1,),
        cases=100_000,
    ),
    Problem(
        name="planner",
        family="a planner of one step",
        vut="frozen:planner",
        levels=(0,),
        cases=50_000,
    ),
    Problem(
        name="noisy",
        family="a learned driver that sees late and with noise",
        vut="level1",
        levels=(0,),
        cases=40_000,
        sense="delay_s=1,noise_x_m=5,noise_v_mps=1",
    ),
    Problem(
        name="learned",
        family="a learned driver against POVs that it was not trained with",
        vut="level2",
        levels=(0,),
        cases=100_000,
    ),
    Problem(
        name="islands",
        family="errs by its first sight, which nothing foretells",
        vut="frozen:islands",
        levels=(0, 1),
        cases=50_000,
    ),
    Problem(
        name="ring",
        family="gap acceptance at a yield line",
        vut="roundabout",
        levels=(1,),
        cases=100_000,
        scenario="roundabout",
    ),
    Problem(
        name="late-ring",
        family="a learned driver with late sensors and a slow actuator",
        vut="level1",
        levels=(1,),
        cases=40_000,
        scenario="roundabout",
        sense="delay_s=0.7",
        act="lag_s=0.2",
    ),
    Problem(
        name="queue",
        family="rules by thresholds, in traffic",
        vut="design2",
        levels=(1,),
        cases=200_000,
        scenario="us23-traffic",
    ),
    Problem(
        name="sumo",
        family="car following of SUMO",
        vut="sumo:IDM",
        levels=(0,),
        cases=30_000,
    ),
)
"""The problems. `sumo` runs in SUMO; SUMO checks a share of the cases of the others."""


class KnownTruth(Record, frozen=True):
    """What the manifest says of a truth.

    Attributes:
        sha256: of its file.
        engine: what moved the vehicles.
        cases: uniform cases of each level.
        failures: failures that the file has, by level.
        fmc: FMC of these, by level.
        growth: the most that as many cases again could add to it, as a share, by level.
        versions: software with which it was made.
    """

    sha256: str
    engine: str
    cases: int
    failures: dict[str, int]
    fmc: dict[str, float]
    growth: dict[str, float]
    versions: dict[str, str]


class Manifest(Record, frozen=True):
    """`manifest.json`: the truths by the name of their problem."""

    truths: dict[str, KnownTruth]


@dataclass(frozen=True, slots=True)
class ProbeCases:
    """Cases of a level whose verdicts show whether the code still gives those of the truth.

    Attributes:
        points: in the unit cube, (n, d).
        failed: whether they fail, (n,).
    """

    points: FloatArray
    failed: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class ProblemTruth:
    """The dense truth of a problem.

    Attributes:
        failures: failing points of the unit cube by level, (m, d).
        fmc: FMC of all failures, summed over the levels.
        oracle: FMC of an oracle after 0 to `ORACLE_CASES` cases, (401,): see `benchmark.oracle`.
        probes: probe cases by level.
    """

    failures: dict[int, FloatArray]
    fmc: float
    oracle: FloatArray
    probes: dict[int, ProbeCases]

    def share(self, found_fmc: float) -> float:
        """Return the share of the FMC that was found, 1 at most.

        A search may fail where the truth's cases have missed: that gives no more than the truth.
        """
        return min(1.0, found_fmc / self.fmc)

    def oracle_cases_to(self, share: float) -> int | None:
        """Return the cases that the oracle needs to a share of the FMC; None for more than 400."""
        reached = np.flatnonzero(self.oracle >= share * self.fmc)
        return int(reached[0]) if len(reached) else None


def named_problems(names: tuple[str, ...] | None) -> tuple[Problem, ...]:
    """Return the problems of these names, or all; `UserError` for an unknown name."""
    if names is None:
        return PROBLEMS
    known = {problem.name: problem for problem in PROBLEMS}
    for name in names:
        if name not in known:
            raise UserError(
                f"--problems: there is no problem {name!r}: {meant(name, known)}choose from "
                f"{', '.join(known)}"
            )
    if not names:
        raise UserError(f"--problems is empty: choose from {', '.join(known)}")
    return tuple(known[name] for name in dict.fromkeys(names))


@cache
def manifest(folder: Path = TRUTHS) -> Manifest:
    """Return the manifest of a folder of truths; `UserError` where there is none."""
    found = read_record(folder / MANIFEST, Manifest)
    if found is None:
        raise UserError(f"there is no {folder / MANIFEST}: run tools/benchmark/make_truths.py")
    return found


def shipped_truth(problem: Problem, folder: Path = TRUTHS) -> ProblemTruth:
    """Return the truth of a problem.

    Raises `UserError` where its file is missing, or is not the one of the manifest.
    """
    path = folder / f"{problem.name}.npz"
    known = manifest(folder).truths.get(problem.name)
    if known is None or sha256_of(path) != known.sha256:
        raise UserError(
            f"{path} is not the truth that {MANIFEST} names: install merge-sumo again, or run "
            "tools/benchmark/make_truths.py"
        )
    try:
        arrays = read_arrays(io.BytesIO(path.read_bytes()))
    except RecordError as error:
        raise UserError(f"{path} cannot be read: {error}") from error
    levels = problem.levels
    return ProblemTruth(
        failures={level: arrays[f"failures_{level}"] / STEPS for level in levels},
        fmc=sum(known.fmc[str(level)] for level in levels),
        oracle=arrays["oracle"],
        probes={
            level: ProbeCases(arrays[f"probes_{level}"], arrays[f"probes_failed_{level}"])
            for level in levels
        },
    )


def changed_verdicts(problem: Problem, plan: SimulationPlan, truth: ProblemTruth) -> int:
    """Return how many probe cases of a truth have another verdict today; none is as it should be.

    They run in this process.
    """
    changed = 0
    for level, probes in truth.probes.items():
        margin = _margins_at(problem, plan, level, probes.points)
        changed += int(((margin < 0.0) != probes.failed).sum())
    return changed


def check_truth(problem: Problem, plan: SimulationPlan, truth: ProblemTruth) -> None:
    """Raise `UserError` where a probe case has another verdict: a share would mean nothing."""
    changed = changed_verdicts(problem, plan, truth)
    if changed:
        raise UserError(
            f"the problem {problem.name} is not the one of its truth any more: {changed} of "
            f"{sum(len(probes.failed) for probes in truth.probes.values())} probe cases have "
            "another verdict; use the version of merge-sumo that made it, or run "
            "tools/benchmark/make_truths.py and compare with no earlier number"
        )


def _margins_at(
    problem: Problem, plan: SimulationPlan, level: int, points: FloatArray
) -> FloatArray:
    """Return the margin of the cases at points, (n, d), of a level, (n,); NaN without a verdict."""
    cases = Pool(levels=problem.levels, scenario=plan.scenario).cases(points, level)
    margins: list[float | None] = []
    for first in range(0, len(cases), CHUNK):
        episodes = simulate(plan, cases[first : first + CHUNK])
        margins += [episode.outcome.margin for episode in episodes]
    return np.array(margins, dtype=np.float64)  # None becomes NaN


def make_truth(problem: Problem, folder: Path, cases: int | None = None) -> KnownTruth:
    """Run the uniform cases of a problem, write its truth into a folder, and return its entry.

    Args:
        problem: the problem.
        folder: where the file goes; one of the same name is replaced.
        cases: cases of a level, by default those of the problem.
    """
    plan, count = problem.plan(), cases or problem.cases
    arrays: dict[str, NDArray[Any]] = {}
    kept: dict[int, Truth] = {}
    for level in problem.levels:
        found = ground_truth(plan.at_level(level), level, count)
        failing = np.round(found.failures[:MOST_FAILURES] * STEPS).astype(np.uint16)
        arrays[f"failures_{level}"] = failing
        kept[level] = Truth(failing / STEPS, np.full(len(failing), -np.inf))
        probes = probes_of(found)
        arrays[f"probes_{level}"] = probes.points
        arrays[f"probes_failed_{level}"] = probes.failed
    best = oracle(kept, ORACLE_CASES, 1)
    arrays["oracle"] = np.array([best[n] for n in range(ORACLE_CASES + 1)])
    content = io.BytesIO()
    np.savez(content, **arrays)  # type: ignore[arg-type]
    (folder / f"{problem.name}.npz").write_bytes(content.getvalue())
    return KnownTruth(
        sha256=hashlib.sha256(content.getvalue()).hexdigest(),
        engine=str(plan.engine),
        cases=count,
        failures={str(level): len(truth.points) for level, truth in kept.items()},
        fmc={str(level): fmc(truth.points) for level, truth in kept.items()},
        growth={str(level): round(growth_bound(t.points), 3) for level, t in kept.items()},
        versions=dict(plan.versions),
    )


def probes_of(truth: Truth) -> ProbeCases:
    """Return probe cases of a truth: failures, and cases that pass near one that fails."""
    fails = truth.margin < 0.0
    failing = truth.points[fails]
    passing = truth.points[~fails & ~np.isnan(truth.margin)]
    distance, _ = cKDTree(failing).query(passing)
    near = passing[distance <= radius_for(passing.shape[1])]
    # Evenly over all, which are in random order.
    chosen = [points[:: max(1, len(points) // PROBES)][:PROBES] for points in (failing, near)]
    failed = np.repeat([True, False], [len(points) for points in chosen])
    return ProbeCases(np.concatenate(chosen), failed)
