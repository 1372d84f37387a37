"""Measure how cost and memory grow with the number of cases.

    python tools/bench_scale.py [PART...]

    truth      uniform cases of the rule-based VUT against the level-0 POV on a worker process:
               cases per second, and the maximum memory of a process
    workers    the same cases on one worker process and on two, in turns, next to a loop that only
               computes and shows what the machine can give. Then the cases per second of the
               process that asks, tells and stores, where workers are no limit, and how many workers
               it can supply
    engines    verdicts on uniform cases of design2 at level 2 by SUMO and by the kinematic engine,
               which also runs one case in a hundred in SUMO: CPU time per case, in turns
    in-flight  the whole command of a campaign whose VUT sleeps for a case, with --in-flight on
               sixteen workers and in batches on one, and cases to .9 of the truth of design2 with
               both. One worker is computed from a run with a VUT that hardly sleeps, and the
               computation is compared with a measurement on few cases
    campaign   the whole command of a uniform campaign of design2, from its start to the report, on
               one worker and on two, in turns
    files      reading `outcomes.jsonl`, FMC and regions of its failures, the report

Figures are medians with minimum and maximum. `--most 1000000` runs a million cases.
"""

from __future__ import annotations

import pickle
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from measuring import append_record, benchmark_parser, seconds, spread
from threadpoolctl import threadpool_limits

from merge_sumo.analysis.truth import TRUTH_CASES, ground_truth
from merge_sumo.campaigns.campaign import run_campaign
from merge_sumo.campaigns.journal import Journal, to_line
from merge_sumo.campaigns.loop import SearchLoop
from merge_sumo.campaigns.recorded import OUTCOMES, RecordedCampaign, failures, read_outcomes
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.metrics.fmc import fmc, regions
from merge_sumo.metrics.outcome import Episode
from merge_sumo.reports.report import write_report
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.scenario.case import FloatArray, Pool, from_unit, to_unit
from merge_sumo.scenario.scenario import US23
from merge_sumo.simulation.evaluate import evaluate, simulate
from merge_sumo.simulation.kinematic_simulator import CHUNK
from merge_sumo.workers import Job, LocalProcesses, Workers

UNIFORM = CampaignSettings(
    vut="design1", levels=(0,), sampler="uniform", cases=400, batch=400, scenario=US23
)
ROUNDS = 5
PAIR_CASES = 2000
BATCH = 20
CAMPAIGN_CASES = 20_000
CASE_S, HARDLY_S = 1.0, 0.02
FLIGHT_CASES, FEW_CASES = 800, 24
FLIGHT, FLIGHT_WORKERS = 48, 16
FLIGHT_SEEDS, SEARCHED = 5, 150
SLEEPY = """
import time
class Sleepy:
    def reset(self, seen):
        time.sleep({case_s})
    def act(self, seen):
        near = abs(seen.x_pov_m - seen.x_vut_m) < 9
        return 1.0 if seen.x_vut_m < -40 else -1.5 if near else 0.0
"""
Figures = dict[str, list[float]]


def memory_mb() -> float:
    """Return the largest resident memory that this process has had, in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def failed_and_memory(episode: Episode) -> tuple[bool, float]:
    """Return the verdict on a case, and the memory in MB of the process that ran it.

    Args:
        episode: episode of the case.
    """
    return episode.outcome.failed, memory_mb()


def never(item: Any) -> Any:
    """Stop: no worker may die in a benchmark.

    Args:
        item: the item of the worker that died.
    """
    raise RuntimeError(f"a worker died at {item}")


def run_uniform(workers: Workers, points: FloatArray) -> float:
    """Run cases, and return the largest memory of a worker in MB.

    Args:
        workers: where they run.
        points: cases of the unit square, (n, 2).
    """
    cases = Pool(levels=(0,), scenario=US23).cases(points, 0)
    largest_mb = 0.0
    for _, mb in evaluate(UNIFORM.load_plan(), cases, workers, failed_and_memory):
        largest_mb = max(largest_mb, mb)
    return largest_mb


def truth(most: int) -> Figures:
    """Return cost and memory for 100, 1,000, ... cases, all in the same worker process.

    Args:
        most: largest number of cases.
    """
    rng = np.random.default_rng(0)
    figures: Figures = {}
    with Workers(LocalProcesses, 1) as workers:
        run_uniform(workers, rng.random((32, 2)))
        cases = 100
        while cases <= most:
            start_s = time.perf_counter()
            worker_mb = run_uniform(workers, rng.random((cases, 2)))
            rate = cases / (time.perf_counter() - start_s)
            figures[f"{cases:,} cases: cases per s"] = [rate]
            figures[f"{cases:,} cases: MB of the worker"] = [worker_mb]
            figures[f"{cases:,} cases: MB of the main process"] = [memory_mb()]
            cases *= 10
    return figures


def compute(limits_s: Sequence[float]) -> list[int]:
    """Compute for some times.

    Args:
        limits_s: seconds of each computation.

    Returns:
        Number of rounds of each computation.
    """
    counts = []
    for limit_s in limits_s:
        count, end = 0, time.perf_counter() + limit_s
        while time.perf_counter() < end:
            sum(range(1000))
            count += 1
        counts.append(count)
    return counts


def workers(_: int) -> Figures:
    """Return the rates on two workers over those on one, and those of the main process."""
    points = np.random.default_rng(1).random((PAIR_CASES, 2))
    figures: Figures = {"cases on two over one": [], "computing on two over one": []}
    figures["cases per s on one"] = []
    with Workers(LocalProcesses, 1) as one, Workers(LocalProcesses, 2) as two:

        def run_all(workers: Workers) -> None:
            for first in range(0, PAIR_CASES, 500):  # chunks of 250 on two workers
                run_uniform(workers, points[first : first + 500])

        def rate(workers: Workers) -> int:
            counts = workers.run(compute, [1.0] * workers.count, never, chunk=1)
            return sum(counts)

        run_all(one)
        run_all(two)
        for _ in range(ROUNDS):
            alone_s = seconds(partial(run_all, one))
            figures["cases on two over one"].append(alone_s / seconds(partial(run_all, two)))
            figures["cases per s on one"].append(PAIR_CASES / alone_s)
            figures["computing on two over one"].append(rate(two) / rate(one))
    handled = [main_process_rate(CAMPAIGN_CASES) for _ in range(ROUNDS)]
    figures["cases per s of the main process"] = handled
    rate_on_one = median(figures["cases per s on one"])
    figures["workers that it feeds"] = [rate / rate_on_one for rate in handled]
    return figures


class Served(Workers):
    """Gives episodes as they come from a worker process, with no work done for them."""

    def __init__(self, ran: Sequence[Episode]) -> None:
        """Serve the episodes of `MAX_CHUNK` cases."""
        super().__init__()
        self._sent = pickle.dumps(list(ran))

    def submit(
        self, function: Any, items: Sequence[Any], lost: Any, chunk: int | None = None
    ) -> Job[Any, Any]:
        """Run nothing."""
        size = chunk or self.chunk_size(len(items))
        chunks = [items[first : first + size] for first in range(0, len(items), size)]
        return Job(function, chunks, lost)

    def collect(self, job: Job[Any, Any]) -> list[Any]:
        """Return episodes for the chunks of a job."""
        episodes = []
        for chunk in job.chunks:
            episodes += pickle.loads(self._sent)[: len(chunk)]  # noqa: S301 (our own)
        return episodes


def main_process_rate(cases: int) -> float:
    """Return the cases per second that the main process of a campaign can take from workers.

    Args:
        cases: number of cases.
    """
    plan, pool = UNIFORM.load_plan(), UNIFORM.pool
    served = Served(simulate(plan, pool.cases(np.random.default_rng(3).random((500, 2)), 0)))
    loop = SearchLoop(make_sampler("uniform", pool, 0), plan, cases, workers=served, batch=BATCH)
    with tempfile.TemporaryDirectory() as scratch:
        journal = Journal.create(Path(scratch) / "run", {})
        with journal:
            return cases / seconds(lambda: loop.run(lambda groups: journal.append(*groups)))


def engines(_: int) -> Figures:
    """Return the CPU time of a case by each engine, in us, and its ratio, round by round."""
    plan = CampaignSettings(vut="design2", levels=(2,), scenario=US23).load_plan()
    plans = {"sumo": plan, "kinematic": plan.with_engine("kinematic")}
    pool, rng = Pool(levels=(2,), scenario=US23), np.random.default_rng(2)
    figures: Figures = {"sumo, us": [], "kinematic, us": [], "ratio": []}
    with threadpool_limits(1):
        for _ in range(ROUNDS):
            cases = pool.cases(rng.random((CHUNK, 3)), 2)
            failed = []
            for name, one in plans.items():
                simulate(one, cases[:200])  # SUMO starts
                start_s = time.process_time()
                episodes = simulate(one, cases)
                figures[f"{name}, us"].append((time.process_time() - start_s) / CHUNK * 1e6)
                failed.append([episode.outcome.failed for episode in episodes])
            if failed[0] != failed[1]:
                raise RuntimeError("the engines disagree about a verdict")
            figures["ratio"].append(figures["sumo, us"][-1] / figures["kinematic, us"][-1])
    return figures


def campaign(folder: Path, *options: str) -> float:
    """Return the seconds of the whole command of a campaign.

    Args:
        folder: folder in which it runs.
        options: further options of the command.
    """
    command = [sys.executable, "-m", "merge_sumo.cli", "campaign", "--quiet", *options]
    quiet = partial(subprocess.run, check=True, stdout=subprocess.DEVNULL, cwd=folder)
    return seconds(partial(quiet, command))


def whole_campaigns(_: int) -> Figures:
    """Return the seconds of whole commands on one worker and on two, and their ratio."""
    options = ("--vut", "design2", "--sampler", "uniform", "--cases", str(CAMPAIGN_CASES))
    figures: Figures = {"s on one": [], "s on two": [], "gain": []}
    with tempfile.TemporaryDirectory() as scratch:
        for number in range(ROUNDS):
            for name, count in (("one", "1"), ("two", "2")):
                out = ("--workers", count, "--out", f"{number}-{name}")
                figures[f"s on {name}"].append(campaign(Path(scratch), *options, *out))
            figures["gain"].append(figures["s on one"][-1] / figures["s on two"][-1])
    return figures


def slow_campaign(case_s: float, cases: int, *options: str) -> tuple[float, int]:
    """Run the whole command of a campaign whose VUT sleeps.

    Args:
        case_s: seconds that the VUT sleeps in a case.
        cases: largest number of cases.
        options: further options of the command.

    Returns:
        Seconds of the command, and the number of cases that ran.
    """
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        (folder / "sleepy.py").write_text(SLEEPY.format(case_s=case_s))
        out = ("--cases", str(cases), "--out", "run")
        spent_s = campaign(folder, "--vut", "sleepy.py:Sleepy", *out, *options)
        twice = folder / "run" / "repeats.jsonl"  # some cases run a second time
        if twice.exists():
            cases += len(twice.read_bytes().splitlines())
    return spent_s, cases


def in_flight(_: int) -> Figures:
    """Return what many workers gain with a slow controller, and the cases that they may cost."""
    one = ("--workers", "1")
    many = ("--workers", str(FLIGHT_WORKERS), "--in-flight", str(FLIGHT))
    quick_s, ran = slow_campaign(HARDLY_S, FLIGHT_CASES, *one)
    few_quick_s, few_ran = slow_campaign(HARDLY_S, FEW_CASES, *one)
    few_s, _ = slow_campaign(CASE_S, FEW_CASES, *one)
    many_s, _ = slow_campaign(CASE_S, FLIGHT_CASES, *many)
    sleeps_s = CASE_S - HARDLY_S
    one_s = quick_s + ran * sleeps_s
    figures: Figures = {
        "s on one": [one_s],
        "s on one, computed over measured": [(few_quick_s + few_ran * sleeps_s) / few_s],
        "s on many": [many_s],
        "gain": [one_s / many_s],
    }
    for levels in ((0, 1, 2), (1,)):
        for how, flight in (("in batches", None), ("in flight", FLIGHT)):
            name = f"cases to .9 at levels {levels}, {how}"
            figures[name] = [cases_to_most(flight, seed, levels) for seed in range(FLIGHT_SEEDS)]
    return figures


def cases_to_most(flight: int | None, seed: int, levels: tuple[int, ...]) -> float:
    """Return the cases until `coverage` has .9 of the truth of design2; infinite for not yet.

    Args:
        flight: cases in flight; None for batches.
        seed: seed of the search.
        levels: levels of the POV.
    """
    settings = CampaignSettings(
        vut="design2", levels=levels, scenario=US23, cases=SEARCHED, seed=seed, in_flight=flight
    )
    plan = settings.load_plan()
    truths = [ground_truth(plan, level, TRUTH_CASES[level]) for level in levels]
    target = 0.9 * sum(fmc(truth.failures) for truth in truths)
    with tempfile.TemporaryDirectory() as scratch:
        outcomes = run_campaign(settings, plan, Path(scratch) / "run").outcomes
    for count in range(5, SEARCHED + 1, 5):
        coverage = 0.0
        for level in levels:
            failing = [o.case for o in outcomes[:count] if o.failed and o.case.level == level]
            coverage += fmc(to_unit(failing, level, scenario=US23))
        if coverage >= target:
            return float(count)
    return float("inf")


def files(most: int) -> Figures:
    """Return the seconds for a finished campaign of 10,000, 100,000, ... cases.

    Args:
        most: largest number of cases.
    """
    figures: Figures = {}
    with tempfile.TemporaryDirectory() as scratch:
        run = run_campaign(UNIFORM, UNIFORM.load_plan(), Path(scratch) / "run")
        known, count = run.outcomes, 10_000
        while count <= most:
            cases = from_unit(np.random.default_rng(2).random((count, 2)), 0, scenario=US23)
            outcomes = []
            for index, case in enumerate(cases):  # new starts for what was measured once
                outcome = known[index % len(known)]
                outcomes.append(replace(outcome, index=index, batch=index // BATCH, case=case))
            for name, value in of_files(run, outcomes).items():
                figures[f"{count:,} cases: {name}"] = [value]
            count *= 10
    return figures


def of_files(run: RecordedCampaign, outcomes: list[Any]) -> dict[str, float]:
    """Return sizes in MB, and seconds for reading, FMC, regions and report of outcomes.

    Args:
        run: the campaign.
        outcomes: its outcomes.
    """
    run.outcomes = outcomes
    text = "".join(map(to_line, outcomes)).encode()
    points = to_unit((outcome.case for outcome in failures(outcomes)), 0, scenario=US23)
    work: dict[str, Callable[[], object]] = {
        "read, s": lambda: read_outcomes(text, OUTCOMES, scenario=US23),
        "FMC, s": lambda: fmc(points),
        "regions, s": lambda: regions(points),
        "report, s": lambda: write_report(run),
    }
    figures = {name: seconds(one) for name, one in work.items()}
    report_mb = (run.folder / "report.html").stat().st_size / 1e6
    return {
        "failures": len(points),
        "file, MB": len(text) / 1e6,
        **figures,
        "report, MB": report_mb,
    }


PARTS: dict[str, Callable[[int], Figures]] = {
    "truth": truth,
    "workers": workers,
    "engines": engines,
    "in-flight": in_flight,
    "campaign": whole_campaigns,
    "files": files,
}


def main() -> None:
    """Measure and print the parts that the command line names."""
    parser = benchmark_parser(__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", default=[*PARTS], help=", ".join(PARTS))
    parser.add_argument("--most", type=int, default=1_000_000, help="most cases of truth and files")
    options = parser.parse_args()
    unknown = set(options.parts) - PARTS.keys()
    if unknown:
        parser.error(f"choose parts from {', '.join(PARTS)}")
    figures: dict[str, Figures] = {}
    for part in options.parts:
        figures[part] = PARTS[part](options.most)
        for name, values in figures[part].items():
            print(f"{part}: {name}: {spread(values)}", flush=True)
    append_record(options.record, "scale", figures)


if __name__ == "__main__":
    # Workers import functions by the names of their modules, which is not __main__ for them.
    import_module("bench_scale").main()
