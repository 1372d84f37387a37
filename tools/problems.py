"""The problems of the benchmark of samplers, and their dense truths.

A problem is a frozen VUT, a scenario and POV levels. `make_truths.py` writes its truth, failures
among uniform cases, into `truths/`, and the SHA-256 of the file into `manifest.json`. The file also
contains probe cases and their verdicts. The benchmark runs only if the code still gives these
verdicts.
"""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import frozen_vuts  # noqa: F401 (registers the VUTs)
import numpy as np
from numpy.typing import NDArray

from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.errors import UserError
from merge_sumo.files import sha256_of
from merge_sumo.records import Record, read_arrays, read_record
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.case import FloatArray, Pool
from merge_sumo.scenario.imperfection import Actuation, Sensing
from merge_sumo.simulation.evaluate import simulate
from merge_sumo.simulation.kinematic_simulator import CHUNK
from merge_sumo.simulation.plan import SimulationPlan

TRUTHS = Path(__file__).parent / "truths"
MANIFEST = "manifest.json"
ORACLE_CASES = 400
"""Cases up to which the oracle's coverage is kept."""
STEPS = 65_535
"""Steps of an axis in which a coordinate of a failure is kept."""


@dataclass(frozen=True, slots=True)
class Problem:
    """A problem that a sampler is to solve: find the failures of a VUT.

    Attributes:
        name: its name, also of its file.
        vut: spec of the VUT.
        levels: POV levels; a search shares its cases out over them.
        cases: uniform cases of the truth at each level.
        scenario: name of the scenario.
        sense: imperfect sensors, as after `--sense`.
        act: imperfect actuators, as after `--act`.
    """

    name: str
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
        return self.settings().load_plan().with_engine(None)


SENSE = "delay_s=1,noise_x_m=5,noise_v_mps=1"
PROBLEMS = (
    Problem("rules", "design1", (2,), 1_000_000),
    Problem("reactive", "design2", (1,), 100_000),
    Problem("stateful", "frozen:hysteresis", (0,), 50_000),
    Problem("table", "frozen:table", (1,), 100_000),
    Problem("planner", "frozen:planner", (0,), 50_000),
    Problem("noisy", "level1", (0,), 40_000, sense=SENSE),
    Problem("learned", "level2", (0,), 100_000),
    Problem("islands", "frozen:islands", (0, 1), 50_000),
    Problem("ring", "roundabout", (1,), 100_000, "roundabout"),
    Problem("late-ring", "level1", (1,), 40_000, "roundabout", "delay_s=0.7", "lag_s=0.2"),
    Problem("queue", "design2", (1,), 200_000, "us23-traffic"),
    Problem("sumo", "sumo:IDM", (0,), 30_000),
)
"""The problems. `sumo` runs in SUMO; SUMO checks a share of the cases of the others."""


class KnownTruth(Record, frozen=True):
    """The entry of a truth in the manifest.

    Attributes:
        sha256: of its file.
        engine: what moved the vehicles.
        cases: uniform cases of each level.
        failures: failures that the file has, by level.
        fmc: FMC of these, by level.
        growth: largest share that the same number of further cases could add to it, by level.
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
    """Cases of a level whose verdicts show whether the truth still fits the code.

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
        oracle: FMC of an oracle after 0 to `ORACLE_CASES` cases, (401,): see `oracle.py`.
        probes: probe cases by level.
    """

    failures: dict[int, FloatArray]
    fmc: float
    oracle: FloatArray
    probes: dict[int, ProbeCases]

    def share(self, found_fmc: float) -> float:
        """Return the share of the FMC that was found, at most 1.

        A search may fail where no case of the truth does: that gives no more than the truth.

        Args:
            found_fmc: FMC of the failures that were found, summed over the levels.
        """
        return min(1.0, found_fmc / self.fmc)

    def oracle_cases_to(self, share: float) -> int | None:
        """Return the cases that the oracle needs to a share of the FMC; None for more than 400.

        Args:
            share: the share, from 0 to 1.
        """
        reached = np.flatnonzero(self.oracle >= share * self.fmc)
        return int(reached[0]) if len(reached) else None


def named_problems(names: Iterable[str]) -> tuple[Problem, ...]:
    """Return problems.

    Args:
        names: their names.

    Raises:
        UserError: a name is unknown.
    """
    known = {problem.name: problem for problem in PROBLEMS}
    once = dict.fromkeys(names)
    for name in once:
        if name not in known:
            raise UserError(f"--problems: unknown problem {name!r}: choose from {', '.join(known)}")
    return tuple(known[name] for name in once)


@cache
def manifest(folder: Path = TRUTHS) -> Manifest:
    """Return the manifest of a folder of truths, empty where it has none.

    Args:
        folder: the folder.
    """
    return read_record(folder / MANIFEST, Manifest) or Manifest({})


def shipped_truth(problem: Problem, folder: Path = TRUTHS) -> ProblemTruth:
    """Return the truth of a problem.

    Args:
        problem: the problem.
        folder: folder of the truths.

    Raises:
        UserError: its file is missing, or is not the one of the manifest.
    """
    path = folder / f"{problem.name}.npz"
    known = manifest(folder).truths.get(problem.name)
    if known is None or sha256_of(path) != known.sha256:
        raise UserError(
            f"{path} is not the truth that {MANIFEST} names: restore it, or run "
            "tools/make_truths.py"
        )
    arrays = read_arrays(io.BytesIO(path.read_bytes()))
    failures, probes, whole = {}, {}, 0.0
    for level in problem.levels:
        failures[level] = arrays[f"failures_{level}"] / STEPS
        probes[level] = ProbeCases(arrays[f"probes_{level}"], arrays[f"probes_failed_{level}"])
        whole += known.fmc[str(level)]
    return ProblemTruth(failures, whole, arrays["oracle"], probes)


def check_truth(problem: Problem, plan: SimulationPlan, truth: ProblemTruth) -> None:
    """Raise `UserError` where a probe case has another verdict: a share would mean nothing.

    Args:
        problem: the problem.
        plan: how its cases run, in this process.
        truth: its truth.
    """
    changed, probes = 0, 0
    for level, known in truth.probes.items():
        cases = Pool(levels=problem.levels, scenario=plan.scenario).cases(known.points, level)
        failed: list[bool] = []
        for first in range(0, len(cases), CHUNK):
            for episode in simulate(plan, cases[first : first + CHUNK]):
                failed.append(episode.outcome.failed)
        changed += int((np.array(failed) != known.failed).sum())
        probes += len(failed)
    if changed:
        raise UserError(
            f"the truth of the problem {problem.name} is out of date: {changed} of {probes} probe "
            "cases have another verdict; use the version of merge-sumo that made it, or run "
            "tools/make_truths.py and do not compare with earlier numbers"
        )
