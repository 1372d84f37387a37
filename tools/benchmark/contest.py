"""The benchmark of samplers: searches of frozen problems, and one number for each sampler.

The number is the mean over N of 50, 100 and 400 cases, and over the problems, of the median over
the seeds of min(1, FMC of the failures among the first N cases / FMC of the dense truth).
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np
from entrants import (
    Entrant,
    SamplerFaultError,
    Watch,
    WatchedSampler,
    entrants,
    lost_entrant,
    sampler_class,
)
from problems import (
    PROBLEMS,
    Problem,
    ProblemTruth,
    check_truth,
    manifest,
    shipped_truth,
)

from merge_sumo.campaigns.campaign import controller_model_of
from merge_sumo.campaigns.loop import Groups, SearchLoop
from merge_sumo.errors import UserError
from merge_sumo.files import check_own, make_folder, regular, replace_own
from merge_sumo.metrics.fmc import fmc
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.printable import counted
from merge_sumo.records import decode
from merge_sumo.result import Result
from merge_sumo.scenario.case import FloatArray, to_unit
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.workers import Workers

COUNTED: Final = (50, 100, 400)
"""Numbers of cases N after which the share counts."""
CURVE: Final = (5, 10, 20, 30, 40, 50, 75, 100, 150, 200, 250, 300, 350, 400)
"""Numbers of cases at which curves have points."""
MOST: Final = 0.9
"""Share of the dense FMC, for "cases to .9"."""
FIRST_SEED: Final = 100
"""Seed of the first search; samplers of this package were chosen and tuned with others."""
QUICK_PROBLEMS: Final = ("planner", "table")
QUICK_CASES: Final = 50
SEARCHES: Final = "searches"
RECORD: Final = "benchmark.json"
PAGE: Final = "benchmark.html"
FORMULA: Final = (
    "mean over N of {counted} and over the problems of the median over the seeds of "
    "min(1, FMC of the failures in the first N cases / FMC of the dense truth)"
)


@dataclass(frozen=True, kw_only=True, slots=True)
class BenchmarkSettings:
    """What is run. Raises `UserError` for numbers that are none of it.

    Attributes:
        seeds: searches of each sampler on each problem, with the seeds 100, 101 and so on.
        cases: cases of a search.
        problems: the problems.
        limit_s: seconds that a sampler may take in a search, without simulation.
    """

    seeds: int
    cases: int
    problems: tuple[Problem, ...]
    limit_s: float

    def __post_init__(self) -> None:
        """Check the numbers."""
        for name, number, most in (("seeds", self.seeds, 1000), ("cases", self.cases, 400)):
            if not 1 <= number <= most:
                raise UserError(f"--{name} is {number}: choose 1 to {most}")
        if not (math.isfinite(self.limit_s) and self.limit_s > 0.0):
            raise UserError(f"--limit is {self.limit_s}: give seconds, more than 0")

    @property
    def counted(self) -> tuple[int, ...]:
        """The numbers of cases after which the share counts."""
        return tuple(n for n in COUNTED if n <= self.cases) or (self.cases,)

    @property
    def curve(self) -> tuple[int, ...]:
        """The numbers of cases at which curves have points."""
        return curve_of(self.cases)


def curve_of(cases: int) -> tuple[int, ...]:
    """Return the numbers of cases at which the curve of a search of so many has points."""
    return (*(n for n in CURVE if n < cases), cases)


@dataclass(frozen=True, kw_only=True)
class Task:
    """A search that is to be run; all but `limit_s` decides what it finds.

    Attributes:
        problem: name of the problem.
        sampler: spec of the sampler.
        seed: seed of the sampler.
        cases: cases of the search.
        sampler_sha256: of the file that defines the sampler.
        truth_sha256: of the truth of the problem.
        merge_sumo: version of this package.
        limit_s: seconds that the sampler may take.
    """

    problem: str
    sampler: str
    seed: int
    cases: int
    sampler_sha256: str | None
    truth_sha256: str
    merge_sumo: str
    limit_s: float

    @property
    def file(self) -> str:
        """The name of its file in the folder of the searches."""
        label = re.sub(r"[^\w.-]+", "-", self.sampler.rpartition(":")[2], flags=re.ASCII)[:60]
        code = zlib.crc32(self.sampler.encode("utf-8", "surrogateescape"))
        return f"{self.problem}-{label}-{code:08x}-{self.seed}.json"


@dataclass(frozen=True, kw_only=True)
class Found:
    """What a search found; a file of the folder of the searches.

    Attributes:
        task: the search.
        ran: cases that ran; fewer than asked for after a fault.
        failures: [index, level, coordinates in the unit cube...] of each failing case.
        fmc: FMC of the failures at the points of the curve, [n, FMC], summed over the levels.
        cases_to_most: cases until .9 of the truth's FMC; None where it was not reached.
        sampler_s: seconds of CPU spent in the sampler.
        fault: what the sampler did wrong, after which the search ended; None without.
    """

    task: Task
    ran: int
    failures: list[list[float]]
    fmc: list[tuple[int, float]]
    cases_to_most: int | None
    sampler_s: float
    fault: str | None = None

    def fmc_after(self, n: int) -> float:
        """Return the FMC after n cases, one of the points of the curve."""
        return dict(self.fmc)[n]


# Searches


@cache
def _problem(name: str) -> tuple[Problem, SimulationPlan]:
    """Return a problem and its plan: what a worker keeps from one search to the next."""
    problem = next(one for one in PROBLEMS if one.name == name)
    return problem, problem.plan()


def run_searches(tasks: Sequence[Task]) -> list[Found]:
    """Run searches in this process, which their samplers may end."""
    return [_run_search(task) for task in tasks]


def _run_search(task: Task) -> Found:
    problem, plan = _problem(task.problem)
    truth = shipped_truth(problem)
    watch, failures, ran, fault = Watch(task.limit_s), list[list[float]](), 0, None

    def note(groups: Groups) -> None:
        nonlocal ran
        for group in groups:
            ran += len(group)
            failures.extend(_row(one.outcome) for one in group if one.outcome.failed)

    try:
        with watch.deadline:
            _search(task, problem, plan, watch, note)
    except SamplerFaultError as error:
        fault = str(error)
    return Found(
        task=task,
        ran=ran,
        failures=failures,
        fmc=[(n, fmc_of(failures, n)) for n in curve_of(task.cases)],
        cases_to_most=cases_to(MOST * truth.fmc, failures),
        sampler_s=round(watch.cpu_s, 3),
        fault=fault,
    )


def _search(
    task: Task,
    problem: Problem,
    plan: SimulationPlan,
    watch: Watch,
    on_groups: Callable[[Groups], None],
) -> None:
    """Run a search."""
    pool, seed = problem.settings().pool, task.seed

    def make() -> Any:
        sampler, predictor = sampler_class(task.sampler), None
        if sampler.uses_predictions:
            predictor = controller_model_of(plan, pool, seed)
        return sampler(pool, seed, predictor)

    sampler = WatchedSampler(make, pool, seed, watch)
    SearchLoop(sampler, plan, task.cases).run(on_groups)


def _row(outcome: Outcome) -> list[float]:
    """Return [index, level, coordinates...] of a case."""
    case = outcome.case
    point = to_unit([case], case.level, case.scenario)[0].tolist()
    return [float(outcome.index), float(case.level), *point]


def _lost(task: Task) -> Found:
    """Return what is recorded of a search that ended its worker each time."""
    return Found(
        task=task,
        ran=0,
        failures=[],
        fmc=[(n, 0.0) for n in curve_of(task.cases)],
        cases_to_most=None,
        sampler_s=0.0,
        fault="it ended its process each time, or did not return from native code",
    )


def fmc_of(failures: Sequence[Sequence[float]], n: int) -> float:
    """Return the FMC of the failures among the first n cases, summed over the levels."""
    by_level: dict[float, list[Sequence[float]]] = {}
    for index, level, *point in failures:
        if index < n:
            by_level.setdefault(level, []).append(point)
    return float(sum(fmc(points) for points in by_level.values()))


def cases_to(target: float, failures: Sequence[Sequence[float]]) -> int | None:
    """Return the cases until the FMC of the failures is at a target; None where it never is."""
    indices = sorted(int(row[0]) for row in failures)
    low, high = 0, len(indices)  # FMC never falls
    while low < high:
        middle = (low + high) // 2
        if fmc_of(failures, indices[middle] + 1) >= target:
            high = middle
        else:
            low = middle + 1
    return None if low == len(indices) else indices[low] + 1


def write_found(folder: Path, found: Found) -> None:
    """Write a search into the folder of searches, with the hash of what it says."""
    record = {"sha256": _digest(found), **asdict(found)}
    replace_own(folder / found.task.file, f"{json.dumps(record)}\n".encode())


def read_found(folder: Path, task: Task) -> Found | None:
    """Return a search that is in a folder; None where it is not there, another, or damaged."""
    try:
        record = decode(regular(folder / task.file).read_bytes(), dict[str, Any])
        digest = record.pop("sha256", None)
        found = decode(json.dumps(record), Found)
    except (OSError, UserError):
        return None
    if not isinstance(found, Found) or digest != _digest(found):
        return None
    same = replace(found.task, limit_s=task.limit_s) == task
    return found if same else None


def _digest(found: Found) -> str:
    """Return the hash of a search; 0 and 0.0 are the same number."""
    found = decode(json.dumps(asdict(found)), Found)
    return hashlib.sha256(json.dumps(asdict(found), sort_keys=True).encode()).hexdigest()


# Numbers


@dataclass(frozen=True, kw_only=True, slots=True)
class ProblemScore:
    """What one sampler did on one problem.

    Attributes:
        shares: by N, the share of the dense FMC of each seed.
        curve: median share by number of cases.
        cases_to_most: median number of cases to .9 of the dense FMC; None where fewer than half
            of the seeds reach it.
        over_oracle: these as a ratio to the oracle's cases.
        sampler_s: median of the seconds of CPU spent in the sampler.
        faults: what the sampler did wrong, by seed.
    """

    shares: dict[int, list[float]]
    curve: dict[int, float]
    cases_to_most: float | None
    over_oracle: float | None
    sampler_s: float
    faults: dict[int, str]

    def median(self, n: int) -> float:
        """Return the median share after n cases."""
        return float(np.median(self.shares[n]))

    @property
    def number(self) -> float:
        """The mean over N of the median shares."""
        return float(np.mean([self.median(n) for n in self.shares]))

    @classmethod
    def of(
        cls, found: Sequence[Found], truth: ProblemTruth, counted_at: Sequence[int]
    ) -> ProblemScore:
        """Compare searches, one a seed, with the truth."""
        needed = [math.inf if one.cases_to_most is None else one.cases_to_most for one in found]
        median = float(np.quantile(needed, 0.5, method="higher"))
        cases = median if math.isfinite(median) else None
        best = truth.oracle_cases_to(MOST)
        return cls(
            shares={n: [truth.share(one.fmc_after(n)) for one in found] for n in counted_at},
            curve={
                n: float(np.median([truth.share(one.fmc_after(n)) for one in found]))
                for n, _ in found[0].fmc
            },
            cases_to_most=cases,
            over_oracle=cases / best if cases and best else None,
            sampler_s=float(np.median([one.sampler_s for one in found])),
            faults={one.task.seed: one.fault for one in found if one.fault is not None},
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class SamplerScore:
    """What one sampler did on all problems.

    Attributes:
        entrant: the sampler.
        problems: its scores by problem.
    """

    entrant: Entrant
    problems: dict[str, ProblemScore]

    @property
    def by_cases(self) -> dict[int, float]:
        """The mean over the problems of the median share, by N."""
        scores = list(self.problems.values())
        return {n: float(np.mean([one.median(n) for one in scores])) for n in scores[0].shares}

    @property
    def number(self) -> float:
        """The one number: the mean of `by_cases`."""
        return float(np.mean(list(self.by_cases.values())))

    @property
    def by_seed(self) -> list[float]:
        """The same for each seed by itself, without medians: how far it is by chance."""
        shares = [list(one.shares.values()) for one in self.problems.values()]
        means: FloatArray = np.mean(shares, axis=(0, 1))
        return [float(mean) for mean in means]

    @property
    def reached(self) -> list[float]:
        """The ratios to the oracle's cases to .9 of the problems on which it is reached."""
        ratios = (one.over_oracle for one in self.problems.values())
        return [ratio for ratio in ratios if ratio is not None]

    @property
    def over_oracle(self) -> float | None:
        """The median of the ratios over all problems; None where half of them are not reached."""
        ratios = self.reached + [math.inf] * (len(self.problems) - len(self.reached))
        median = float(np.quantile(ratios, 0.5, method="higher"))
        return median if math.isfinite(median) else None

    @property
    def faults(self) -> int:
        """Searches that a fault ended."""
        return sum(len(one.faults) for one in self.problems.values())

    def to_record(self) -> dict[str, Any]:
        """Return what `benchmark.json` says of it."""
        return {
            "number": self.number,
            "by_seed": self.by_seed,
            "by_cases": {str(n): share for n, share in self.by_cases.items()},
            "cases_to_90_over_oracle": self.over_oracle,
            "problems_with_90": len(self.reached),
            "faults": self.faults,
            "about": self.entrant.about,
            "sha256": self.entrant.sha256,
            "predicts": self.entrant.predicts,
            "problems": {
                name: {
                    "number": one.number,
                    "shares": {str(n): shares for n, shares in one.shares.items()},
                    "curve": {str(n): share for n, share in one.curve.items()},
                    "cases_to_90": one.cases_to_most,
                    "cases_to_90_over_oracle": one.over_oracle,
                    "sampler_s": one.sampler_s,
                    "faults": {str(seed): fault for seed, fault in one.faults.items()},
                }
                for name, one in self.problems.items()
            },
        }


@dataclass(frozen=True, repr=False)
class SamplerBenchmark(Result):
    """The result of the benchmark.

    Attributes:
        settings: what was run.
        truths: the truth of each problem by its name.
        samplers: the scores by spec, in the order of the numbers.
        folder: folder that was written; None for none.
    """

    settings: BenchmarkSettings
    truths: dict[str, ProblemTruth]
    samplers: dict[str, SamplerScore]
    folder: Path | None = None

    @classmethod
    def of(
        cls,
        settings: BenchmarkSettings,
        truths: dict[str, ProblemTruth],
        entered: Sequence[Entrant],
        found: Mapping[str, Mapping[str, Sequence[Found]]],
    ) -> SamplerBenchmark:
        """Compare searches by sampler and problem, one a seed."""
        scores = [
            SamplerScore(
                entrant=one,
                problems={
                    name: ProblemScore.of(searches, truths[name], settings.counted)
                    for name, searches in found[one.spec].items()
                },
            )
            for one in entered
        ]
        ranked = sorted(scores, key=lambda score: -score.number)
        samplers = {score.entrant.spec: score for score in ranked}
        return cls(settings, truths, samplers)

    def oracle(self, n: int) -> float:
        """Return the mean over the problems of the oracle's share after n cases."""
        shares = [truth.share(float(truth.oracle[n])) for truth in self.truths.values()]
        return float(np.mean(shares))

    @property
    def oracle_number(self) -> float:
        """The number of the oracle, which knows the truth: what no sampler is to expect."""
        return float(np.mean([self.oracle(n) for n in self.settings.counted]))

    @property
    def formula(self) -> str:
        """What the number is."""
        *others, last = map(str, self.settings.counted)
        return FORMULA.format(counted=f"{', '.join(others)} and {last}" if others else last)

    def to_record(self) -> dict[str, Any]:
        """Return what `benchmark.json` and `--json` hold."""
        settings = self.settings
        known = manifest().truths
        return {
            "number_is": self.formula,
            "merge_sumo": version("merge-sumo"),
            "cases": settings.cases,
            "seeds": [FIRST_SEED + k for k in range(settings.seeds)],
            "oracle": {
                "number": self.oracle_number,
                "by_cases": {str(n): self.oracle(n) for n in settings.counted},
            },
            "samplers": {name: score.to_record() for name, score in self.samplers.items()},
            "problems": {
                problem.name: {
                    **asdict(problem),
                    "fmc": self.truths[problem.name].fmc,
                    "engine": known[problem.name].engine,
                    "truth_sha256": known[problem.name].sha256,
                    "oracle": {
                        str(n): truth_share(self.truths[problem.name], n) for n in settings.curve
                    },
                    "oracle_cases_to_90": self.truths[problem.name].oracle_cases_to(MOST),
                }
                for problem in settings.problems
            },
        }

    def lines(self) -> list[str]:
        """Return a table: samplers in the order of their numbers, then what the number is."""
        settings, counts = self.settings, self.settings.counted
        width = max([len("sampler"), *(len(one.entrant.label) for one in self.samplers.values())])
        heads = "  ".join(f"{f'N={n}':>5s}" for n in counts)
        rows = [f"{'sampler':{width}s}  number  {heads}  {'.9 / oracle':>12s}  {'sampler s':>9s}"]
        for score in self.samplers.values():
            shares = "  ".join(f"{share:5.3f}" for share in score.by_cases.values())
            seconds = sum(one.sampler_s for one in score.problems.values())
            rows.append(
                f"{score.entrant.label:{width}s}  {score.number:6.3f}  {shares}  "
                f"{ratio_text(score):>12s}  {seconds:9.1f}"
            )
        shares = "  ".join(f"{self.oracle(n):5.3f}" for n in counts)
        rows.append(f"{'oracle':{width}s}  {self.oracle_number:6.3f}  {shares}  {'1':>12s}")
        faults = []
        for score in self.samplers.values():
            by_problem = [one.faults for one in score.problems.values() if one.faults]
            if by_problem:
                first = next(iter(by_problem[0].values()))
                faults.append(
                    f"{score.entrant.label}: faults ended {score.faults} of its searches, the "
                    f"first: {first}"
                )
        return [
            *rows,
            f"number: {self.formula}",
            f"{counted(len(settings.problems), 'problem')}, {counted(settings.seeds, 'seed')}, "
            f"{settings.cases} cases; .9 / oracle: cases to .9 of the dense FMC as a ratio to "
            "those of the oracle, median over the problems (problems on which it is reached)",
            *faults,
            *([] if self.folder is None else [f"page: {self.folder / PAGE}"]),
        ]


def truth_share(truth: ProblemTruth, n: int) -> float:
    """Return the oracle's share of a problem after n cases."""
    return truth.share(float(truth.oracle[n]))


def ratio_text(score: SamplerScore) -> str:
    """Return the ratio to the oracle's cases to .9, and on how many problems it is reached."""
    ratio = score.over_oracle
    ratio_words = "-" if ratio is None else f"{ratio:.1f}"
    return f"{ratio_words} ({len(score.reached)}/{len(score.problems)})"


# The benchmark

OnStep = Callable[[str, int, int, str], None]
"""Told how far it is: title, things done, things in all, what a thing is."""


def benchmark(
    samplers: Sequence[str],
    settings: BenchmarkSettings,
    folder: Path,
    workers: Workers,
    on_step: OnStep = lambda *_: None,
) -> SamplerBenchmark:
    """Let samplers search the problems, and return what they found.

    Searches that are in the folder already are not run again. Raises `UserError` where a truth
    is not the one of the manifest or the code has other verdicts, and for a sampler that breaks
    its contract.

    Args:
        samplers: names of the registry, or FILE.py:CLASS.
        settings: what is run.
        folder: where each search is written as it ends.
        workers: processes, in which the samplers run: one that ends its process ends no other.
        on_step: told how far it is.
    """
    entered = _entered(samplers, settings.limit_s, workers)
    truths = _checked_truths(settings, on_step)
    tasks = _tasks(entered, settings)
    place = folder / SEARCHES
    check_own(folder, place)
    make_folder(place, exist_ok=True)
    found = {task: known for task in tasks if (known := read_found(place, task)) is not None}
    missing = [task for task in tasks if task not in found]
    title = "searches" + (f" ({len(found)} there already)" if found else "")
    searches = workers.run(run_searches, missing, _lost, chunk=1)
    for ended, one in enumerate(searches, start=1):
        write_found(place, one)
        found[missing[ended - 1]] = one
        on_step(title, ended, len(missing), "searches")
    by_sampler: dict[str, dict[str, list[Found]]] = {one.spec: {} for one in entered}
    for task in tasks:
        by_sampler[task.sampler].setdefault(task.problem, []).append(found[task])
    result = SamplerBenchmark.of(settings, truths, entered, by_sampler)
    return replace(result, folder=folder)


def _entered(samplers: Sequence[str], limit_s: float, workers: Workers) -> list[Entrant]:
    """Return the samplers, each once; `UserError` for one that breaks the contract."""
    specs = list(dict.fromkeys(samplers))
    entered = list(workers.run(partial(entrants, limit_s=limit_s), specs, lost_entrant, chunk=1))
    for one in entered:
        if one.fault is not None:
            raise UserError(one.fault)
    return entered


def _checked_truths(settings: BenchmarkSettings, on_step: OnStep) -> dict[str, ProblemTruth]:
    """Return the truths by problem; `UserError` where one is not to be used."""
    shipped = {problem.name: shipped_truth(problem) for problem in settings.problems}
    for number, problem in enumerate(settings.problems, start=1):
        check_truth(problem, problem.plan(), shipped[problem.name])
        on_step("truths checked", number, len(settings.problems), "problems")
    return shipped


def _tasks(entered: Sequence[Entrant], settings: BenchmarkSettings) -> list[Task]:
    """Return all searches, those of one problem side by side: a worker keeps its simulator."""
    known, present = manifest().truths, version("merge-sumo")
    return [
        Task(
            problem=problem.name,
            sampler=one.spec,
            seed=FIRST_SEED + k,
            cases=settings.cases,
            sampler_sha256=one.sha256,
            truth_sha256=known[problem.name].sha256,
            merge_sumo=present,
            limit_s=settings.limit_s,
        )
        for problem in settings.problems
        for one in entered
        for k in range(settings.seeds)
    ]
