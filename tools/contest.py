"""A benchmark of samplers: twelve problems whose failures are known, one number per sampler.

    python tools/contest.py coverage gpr --quick
    python tools/contest.py my_sampler.py:Mine uniform --workers 2 --out mine

The number is the mean over N = 50, 100 and 400 cases, and over the problems, of the median over the
seeds of min(1, FMC of the failures among the first N cases / FMC of the dense truth). The same
command continues a run that was stopped: searches in its folder do not run again.
docs/explanation/benchmark.md explains the problems and has results.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
import zlib
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from entrants import (
    LIMIT_S,
    Entrant,
    SamplerFaultError,
    Watch,
    WatchedSampler,
    check_spec,
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
    named_problems,
    shipped_truth,
)

from merge_sumo.campaigns.campaign import controller_model_of
from merge_sumo.campaigns.loop import Batches, SearchLoop
from merge_sumo.errors import UserError
from merge_sumo.files import check_own, make_folder, regular, replace_own
from merge_sumo.metrics.fmc import fmc
from merge_sumo.records import decode
from merge_sumo.reports.progress import Bars
from merge_sumo.scenario.case import to_unit
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.workers import LocalProcesses, Workers, number_of_workers

COUNTED = (50, 100, 400)
"""Numbers of cases N after which the share counts."""
MOST = 0.9
"""Share of the dense FMC, for "cases to .9"."""
FIRST_SEED = 100
"""Seed of the first search; samplers of this package were chosen and tuned with others."""
QUICK_PROBLEMS, QUICK_CASES = ("planner", "table"), 50
SEARCHES, RECORD = "searches", "benchmark.json"
LOST = "it ended its process each time"


@dataclass(frozen=True, kw_only=True)
class Search:
    """A search to run; its fields decide its result.

    Attributes:
        problem: name of the problem.
        sampler: spec of the sampler.
        seed: seed of the sampler.
        cases: number of cases.
        sampler_sha256: of the file that defines the sampler.
        truth_sha256: of the truth of the problem.
        merge_sumo: version of this package.
    """

    problem: str
    sampler: str
    seed: int
    cases: int
    sampler_sha256: str | None
    truth_sha256: str
    merge_sumo: str

    @property
    def file(self) -> str:
        """The name of its file in the folder of the searches."""
        label = re.sub(r"[^\w.-]+", "-", self.sampler.rpartition(":")[2], flags=re.ASCII)[:60]
        code = zlib.crc32(self.sampler.encode("utf-8", "surrogateescape"))
        return f"{self.problem}-{label}-{code:08x}-{self.seed}.json"


@dataclass(frozen=True, kw_only=True)
class Found:
    """The result of a search; a file of the folder of the searches.

    Attributes:
        search: the search.
        ran: number of cases that ran; smaller than `search.cases` after an error.
        failures: [index, level, coordinates in the unit cube...] of each failing case.
        sampler_s: seconds of CPU spent in the sampler.
        fault: the sampler's fault that ended the search; None without.
    """

    search: Search
    ran: int
    failures: list[list[float]]
    sampler_s: float
    fault: str | None = None

    def fmc_after(self, n: int) -> float:
        """Return the FMC of the failures among the first cases, summed over the levels.

        Args:
            n: number of cases.
        """
        by_level = defaultdict(list)
        for index, level, *point in self.failures:
            if index < n:
                by_level[level].append(point)
        return float(sum(fmc(points) for points in by_level.values()))

    def cases_to(self, target: float) -> float:
        """Return the number of cases until the FMC is at a target; infinite where it never is.

        Args:
            target: the target.
        """
        indices = sorted(int(row[0]) for row in self.failures)
        low, high = 0, len(indices)  # FMC never falls
        while low < high:
            middle = (low + high) // 2
            if self.fmc_after(indices[middle] + 1) >= target:
                high = middle
            else:
                low = middle + 1
        return math.inf if low == len(indices) else indices[low] + 1


# Searches


@cache
def _problem(name: str) -> tuple[Problem, SimulationPlan]:
    """Return a problem and its plan, which a worker keeps from one search to the next."""
    (problem,) = named_problems((name,))
    return problem, problem.plan()


def run_searches(searches: Sequence[Search], limit_s: float) -> list[Found]:
    """Run searches in this process, which their samplers may end.

    Args:
        searches: the searches.
        limit_s: seconds that a sampler may take in a search, without simulation.
    """
    return [_run_search(search, Watch(limit_s)) for search in searches]


def _run_search(search: Search, watch: Watch) -> Found:
    problem, plan = _problem(search.problem)
    pool, fault = problem.settings().pool, None
    groups: Batches = []

    def make() -> Any:
        sampler, model = sampler_class(search.sampler), None
        if sampler.uses_predictions:
            model = controller_model_of(plan, pool, search.seed)
        return sampler(pool, search.seed, model)

    try:
        with watch.deadline:
            sampler = WatchedSampler(make, pool, search.seed, watch)
            SearchLoop(sampler, plan, search.cases).run(groups.extend)
    except SamplerFaultError as error:
        fault = str(error)
    failures, ran = [], 0
    for group in groups:
        ran += len(group)
        for episode in group:
            outcome = episode.outcome
            if outcome.failed:
                level = outcome.case.level
                point = to_unit([outcome.case], level, outcome.case.scenario)[0].tolist()
                failures.append([float(outcome.index), float(level), *point])
    sampler_s = round(watch.cpu_s, 3)
    return Found(search=search, ran=ran, failures=failures, sampler_s=sampler_s, fault=fault)


def _lost(search: Search) -> Found:
    return Found(search=search, ran=0, failures=[], sampler_s=0.0, fault=LOST)


def read_found(path: Path) -> Found | None:
    """Read the result of a search.

    Args:
        path: its file.

    Returns:
        The result; None where the file does not exist, or is damaged.
    """
    try:
        found: Found = decode(regular(path).read_bytes(), Found)
    except (OSError, UserError):
        return None
    return found


# Numbers


@dataclass(frozen=True, kw_only=True)
class ProblemScore:
    """Scores of one sampler on one problem.

    Attributes:
        number: mean over N of the median shares.
        shares: share of the dense FMC of each seed, by N.
        cases_to_90: median number of cases to .9 of the dense FMC; None where fewer than half of
            the seeds reach it.
        cases_to_90_over_oracle: the same as a ratio to the oracle's cases.
        sampler_s: median of the seconds of CPU spent in the sampler.
        faults: faults of the sampler by seed.
    """

    number: float
    shares: dict[int, list[float]]
    cases_to_90: float | None
    cases_to_90_over_oracle: float | None
    sampler_s: float
    faults: dict[int, str]


def problem_score(found: Sequence[Found], truth: ProblemTruth) -> ProblemScore:
    """Compare the searches of a sampler with the truth of their problem.

    Args:
        found: one search for each seed.
        truth: truth of the problem.
    """
    shares = {}
    for n in counted(found[0].search.cases):
        shares[n] = [truth.share(one.fmc_after(n)) for one in found]
    needed = [one.cases_to(MOST * truth.fmc) for one in found]
    cases = finite(np.quantile(needed, 0.5, method="higher"))
    best = truth.oracle_cases_to(MOST)
    return ProblemScore(
        number=float(np.mean([np.median(of_seeds) for of_seeds in shares.values()])),
        shares=shares,
        cases_to_90=cases,
        cases_to_90_over_oracle=cases / best if cases and best else None,
        sampler_s=float(np.median([one.sampler_s for one in found])),
        faults={one.search.seed: one.fault for one in found if one.fault is not None},
    )


@dataclass(frozen=True, kw_only=True)
class SamplerScore:
    """Scores of one sampler.

    Attributes:
        number: the one number, the mean of `by_cases`.
        by_cases: mean over the problems of the median share, by N.
        by_seed: the number of each seed by itself, without medians.
        problems_with_90: problems on which the median search reaches .9 of the dense FMC.
        cases_to_90_over_oracle: median over the problems; None where half of them do not reach it.
        entrant: the sampler.
        problems: its scores by problem.
    """

    number: float
    by_cases: dict[int, float]
    by_seed: list[float]
    problems_with_90: int
    cases_to_90_over_oracle: float | None
    entrant: Entrant
    problems: dict[str, ProblemScore]


def sampler_score(entrant: Entrant, problems: dict[str, ProblemScore]) -> SamplerScore:
    """Return the scores of a sampler over all problems.

    Args:
        entrant: the sampler.
        problems: its scores by problem.
    """
    shares = [list(one.shares.values()) for one in problems.values()]  # (problems, N, seeds)
    by_n = np.median(shares, axis=2).mean(axis=0)
    counts = next(iter(problems.values())).shares
    ratios = []
    for one in problems.values():
        ratios.append(one.cases_to_90_over_oracle or math.inf)
    return SamplerScore(
        number=float(by_n.mean()),
        by_cases=dict(zip(counts, by_n.tolist(), strict=True)),
        by_seed=np.mean(shares, axis=(0, 1)).tolist(),
        problems_with_90=int(np.isfinite(ratios).sum()),
        cases_to_90_over_oracle=finite(np.quantile(ratios, 0.5, method="higher")),
        entrant=entrant,
        problems=problems,
    )


def counted(cases: int) -> tuple[int, ...]:
    """Return the numbers of cases after which the share of a search counts.

    Args:
        cases: number of cases of a search.
    """
    return tuple(n for n in COUNTED if n <= cases) or (cases,)


def finite(number: float) -> float | None:
    """Return a finite number, and None for an infinite one.

    Args:
        number: the number.
    """
    return float(number) if math.isfinite(number) else None


def oracle_by_cases(truths: dict[str, ProblemTruth], cases: int) -> dict[int, float]:
    """Return the mean share of the oracle over the problems, by number of cases.

    Args:
        truths: truths by problem.
        cases: number of cases of a search.
    """
    shares = {}
    for n in counted(cases):
        shares[n] = float(np.mean([one.share(float(one.oracle[n])) for one in truths.values()]))
    return shares


def table(scores: Sequence[SamplerScore], oracle: dict[int, float]) -> list[str]:
    """Return the lines of a table, and the faults of the samplers.

    Args:
        scores: the scores in the order of the numbers.
        oracle: mean share of the oracle by N.
    """
    width = max(len("sampler"), *(len(one.entrant.label) for one in scores))
    heads = "  ".join(f"{f'N={n}':>5s}" for n in oracle)
    rows = [f"{'sampler':{width}s}  number  {heads}  {'.9 / oracle':>12s}  {'sampler s':>9s}"]
    faults = []
    for one in scores:
        label, ratio = one.entrant.label, one.cases_to_90_over_oracle
        shares = "  ".join(f"{share:5.3f}" for share in one.by_cases.values())
        reached = "-" if ratio is None else f"{ratio:.1f}"
        reached += f" ({one.problems_with_90}/{len(one.problems)})"
        sampler_s = sum(problem.sampler_s for problem in one.problems.values())
        rows.append(
            f"{label:{width}s}  {one.number:6.3f}  {shares}  {reached:>12s} {sampler_s:9.1f}"
        )
        for name, problem in one.problems.items():
            for seed, fault in problem.faults.items():
                faults.append(f"{label}, {name}, seed {seed}: {fault}")
    shares = "  ".join(f"{share:5.3f}" for share in oracle.values())
    number = np.mean(list(oracle.values()))
    rows.append(f"{'oracle':{width}s}  {number:6.3f}  {shares}  {'1':>12s}")
    return rows + faults


# The command


def enter(specs: Sequence[str], limit_s: float, workers: Workers) -> list[Entrant]:
    """Return the samplers, each once; `UserError` for one that breaks the contract.

    Args:
        specs: names of the registry, or FILE.py:CLASS.
        limit_s: seconds that the contract may take.
        workers: processes in which the samplers run.
    """
    once = list(dict.fromkeys(specs))
    entered = list(workers.run(partial(entrants, limit_s=limit_s), once, lost_entrant, chunk=1))
    for one in entered:
        if one.fault is not None:
            raise UserError(one.fault)
    return entered


def searches_of(
    problems: Sequence[Problem], entered: Sequence[Entrant], cases: int, seeds: int
) -> list[Search]:
    """Return all searches, ordered by problem, so that a worker keeps its simulator.

    Args:
        problems: the problems.
        entered: the samplers.
        cases: cases of a search.
        seeds: searches of a sampler on a problem.
    """
    searches = []
    for problem in problems:
        for one in entered:
            for seed in range(FIRST_SEED, FIRST_SEED + seeds):
                search = Search(
                    problem=problem.name,
                    sampler=one.spec,
                    seed=seed,
                    cases=cases,
                    sampler_sha256=one.sha256,
                    truth_sha256=manifest().truths[problem.name].sha256,
                    merge_sumo=version("merge-sumo"),
                )
                searches.append(search)
    return searches


def parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line.

    Args:
        arguments: its arguments; None for the arguments of the process.

    Returns:
        The options.

    Raises:
        UserError: a number is out of range.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("samplers", nargs="+", metavar="SAMPLER", help="a name, or FILE.py:CLASS")
    parser.add_argument("--problems", help="names, separated by commas; all by default")
    parser.add_argument("--quick", action="store_true", help="two problems, one seed, 50 cases")
    parser.add_argument("--seeds", type=int, help="number of seeds, from 100 (default 3)")
    parser.add_argument("--cases", type=int, help="cases per search, at most 400 (default)")
    parser.add_argument("--limit", type=float, default=LIMIT_S, help="sampler seconds per search")
    parser.add_argument("--workers", type=int, help="processes; by default one per core")
    parser.add_argument("--out", type=Path, default=Path("benchmark"), help="output folder")
    options = parser.parse_args(arguments)
    for spec in options.samplers:
        check_spec(spec)
    names = QUICK_PROBLEMS if options.quick else [one.name for one in PROBLEMS]
    if options.problems is not None:
        names = options.problems.split(",")
    options.problems = named_problems(names)
    if options.seeds is None:
        options.seeds = 1 if options.quick else 3
    if options.cases is None:
        options.cases = QUICK_CASES if options.quick else max(COUNTED)
    for name, most in (("seeds", 1000), ("cases", max(COUNTED))):
        if not 1 <= getattr(options, name) <= most:
            raise UserError(f"--{name} is {getattr(options, name)}: choose 1 to {most}")
    if not options.limit > 0.0:
        raise UserError(f"--limit is {options.limit}: give seconds, more than 0")
    if options.out.exists() and not (options.out / SEARCHES).is_dir():
        raise UserError(f"{options.out} is not a folder of searches: name a new one")
    return options


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the contest that the command line names; write and print its numbers.

    Args:
        arguments: arguments of the command line; None for the arguments of the process.
    """
    options = parsed(arguments)
    folder, problems = options.out / SEARCHES, options.problems
    found: dict[Search, Found] = {}
    with Workers(LocalProcesses, number_of_workers(options.workers)) as workers, Bars() as bars:
        entered = enter(options.samplers, options.limit, workers)
        truths = {problem.name: shipped_truth(problem) for problem in problems}
        for number, problem in enumerate(problems, start=1):
            check_truth(problem, problem.plan(), truths[problem.name])
            bars.counted("truths checked", number, len(problems), "problems")
        searches = searches_of(problems, entered, options.cases, options.seeds)
        check_own(options.out, folder)
        make_folder(folder, exist_ok=True)
        missing = []
        for search in searches:
            known = read_found(folder / search.file)
            if known is not None and known.search == search:
                found[search] = known
            else:
                missing.append(search)
        run = partial(run_searches, limit_s=options.limit)
        ended = workers.run(run, missing, _lost, chunk=1)
        for number, one in enumerate(ended, start=1):
            replace_own(folder / one.search.file, f"{json.dumps(asdict(one))}\n".encode())
            found[one.search] = one
            bars.counted("searches", number, len(missing), "searches")
    scores = []
    for entrant in entered:
        by_problem = {}
        for name, truth in truths.items():
            mine = [found[s] for s in searches if (s.sampler, s.problem) == (entrant.spec, name)]
            by_problem[name] = problem_score(mine, truth)
        scores.append(sampler_score(entrant, by_problem))
    scores.sort(key=lambda score: -score.number)
    oracle = oracle_by_cases(truths, options.cases)
    record = {
        "merge_sumo": version("merge-sumo"),
        "cases": options.cases,
        "seeds": options.seeds,
        "problems": [asdict(problem) for problem in problems],
        "oracle": oracle,
        "samplers": {score.entrant.spec: asdict(score) for score in scores},
    }
    text = json.dumps(record, indent=1, allow_nan=False)
    replace_own(options.out / RECORD, f"{text}\n".encode())
    print("\n".join(table(scores, oracle)))


if __name__ == "__main__":
    # Workers import functions by the names of their modules, which is not __main__ for them.
    try:
        import_module("contest").main()
    except UserError as error:
        sys.exit(str(error))
