"""Measure how cost and memory grow with the number of cases: `python tools/bench_scale.py`.

    truth     uniform cases of the rule-based VUT against the level-0 POV through the workers that
              `truth` uses: cases per second and the largest memory of a worker process
    workers   the same cases on one worker process and on two, in turns, beside a loop that only
              computes, on one process and on two: what the machine itself can give
    engines   verdicts on uniform cases of design2 at level 2 by SUMO and by the kinematic engine,
              which runs one case of a hundred in SUMO as well: CPU time per case, in turns
    in-flight the whole command of a campaign whose VUT sleeps --case-s for a case, with --in-flight
              on sixteen workers and in batches on one, and cases to .9 of the truth of design2 with
              both. One worker is computed from a run with a VUT that sleeps hardly at all, and the
              computation is compared with a measurement on few cases
    campaign  the whole command of a uniform campaign of design2, from its start to the report, on
              one worker and on two, in turns
    default   the whole command of the default campaign of design2, 800 cases by `coverage` at three
              levels, on one worker and on two, in turns
    parent    cases per second that the process takes that asks, tells and keeps, where workers are
              no limit, and how many workers like the one above that feeds
    samplers  seconds that each sampler takes for a batch, after a history of that many cases
    files     reading `outcomes.jsonl`, FMC and regions of its failures, the report

Everything is measured in one run; `--most 1000000` goes on to a million uniform cases. `--only
workers campaign parent` leaves out the others.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from bench_record import add_record_option, append_record
from threadpoolctl import threadpool_limits

from merge_sumo.analysis.truth import _margin_of, ground_truth
from merge_sumo.campaigns.campaign import run_campaign
from merge_sumo.campaigns.journal import Journal, to_line
from merge_sumo.campaigns.loop import SearchLoop
from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.run import OUTCOMES, Run, failures, read_outcomes
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.metrics.fmc import fmc, regions
from merge_sumo.metrics.outcome import Episode, Outcome
from merge_sumo.reports.report import write_report
from merge_sumo.samplers.registry import SAMPLERS, make_sampler
from merge_sumo.scenario.case import Pool, from_unit, to_unit
from merge_sumo.scenario.scenario import US23
from merge_sumo.simulation.evaluate import evaluate, simulate
from merge_sumo.simulation.kinematic_simulator import CHUNK
from merge_sumo.workers import Job, LocalProcesses, Workers

VUT = "design1"
ROUNDS = 5
CAMPAIGN_ROUNDS = 5
PAIR_CASES = 2000
BATCH = 20
DEFAULT_ROUNDS = 3
FLIGHT, FLIGHT_WORKERS = 48, 16
FLIGHT_SEEDS, SEARCHED = 5, 150
HARDLY_S = 0.02
SLEEPY = """
import time
class Sleepy:
    def reset(self, seen):
        time.sleep({case_s})
    def act(self, seen):
        near = abs(seen.x_pov_m - seen.x_vut_m) < 9
        return 1.0 if seen.x_vut_m < -40 else -1.5 if near else 0.0
"""
PARTS = (
    *("truth", "workers", "engines", "in-flight", "campaign", "default", "parent", "samplers"),
    "files",
)


def memory_mb() -> float:
    """Return the largest resident memory that this process has had, in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def margin_and_memory(episode: Episode) -> tuple[float, int, float]:
    """Return what `truth` keeps of a case, which process ran it, and how large it is."""
    margin, _, _ = _margin_of(episode)
    return margin, os.getpid(), memory_mb()


def compute(seconds: Sequence[float]) -> list[int]:
    """Compute for some seconds; return how often for each."""
    counts = []
    for limit in seconds:
        count, end = 0, time.perf_counter() + limit
        while time.perf_counter() < end:
            sum(range(1000))
            count += 1
        counts.append(count)
    return counts


def never(item: Any) -> Any:
    """Stop: no worker may die in a benchmark."""
    raise RuntimeError(f"a worker died at {item}")


def local(count: int) -> Workers:
    """Return worker processes that are never replaced, so that a leak would show."""
    return Workers(LocalProcesses, count)


def truth(most: int) -> Iterator[dict[str, float]]:
    """Yield cost and memory for 100, 1,000, ... cases, all in the same worker process."""
    plan = resolve(CampaignSettings(vut=VUT, levels=(0,), scenario=US23))
    rng = np.random.default_rng(0)
    with local(1) as workers:
        pool = Pool(levels=(0,), scenario=US23)
        warm = pool.cases(rng.random((32, 2)), 0)
        list(evaluate(plan, warm, workers, margin_and_memory))
        cases = 100
        while cases <= most:
            points: Any = rng.random((cases, 2))
            start, memory = time.perf_counter(), 0.0
            for _, _, now in evaluate(plan, pool.cases(points, 0), workers, margin_and_memory):
                memory = max(memory, now)
            spent = time.perf_counter() - start
            yield {
                "cases": cases,
                "cases_per_s": cases / spent,
                "worker_mb": memory,
                "this_process_mb": memory_mb(),
            }
            cases *= 10


def two_workers() -> dict[str, list[float]]:
    """Return the rates on two workers over those on one, round by round."""
    plan = resolve(CampaignSettings(vut=VUT, levels=(0,), scenario=US23))
    points: Any = np.random.default_rng(1).random((PAIR_CASES, 2))
    found: dict[str, list[float]] = {"cases": [], "computing": [], "cases_per_s_on_one": []}
    with local(1) as one, local(2) as two:

        def seconds(workers: Workers) -> float:
            start = time.perf_counter()
            for first in range(0, PAIR_CASES, 500):  # chunks of 250 on two workers
                some = Pool(levels=(0,), scenario=US23).cases(points[first : first + 500], 0)
                list(evaluate(plan, some, workers, margin_and_memory))
            return time.perf_counter() - start

        def rate(workers: Workers, count: int) -> float:
            return float(sum(workers.run(compute, [1.0] * count, never, chunk=1)))

        seconds(one), seconds(two)
        for _ in range(ROUNDS):
            alone = seconds(one)
            found["cases"].append(alone / seconds(two))
            found["cases_per_s_on_one"].append(PAIR_CASES / alone)
            found["computing"].append(rate(two, 2) / rate(one, 1))
    return found


def engines(cases: int, rounds: int) -> dict[str, list[float]]:
    """Return the CPU time of a case by each engine, in us, and its ratio, round by round."""
    plan = resolve(CampaignSettings(vut="design2", levels=(2,), scenario=US23))
    plans = {"sumo": plan, "kinematic": plan.with_engine("kinematic")}
    pool, rng = Pool(levels=(2,), scenario=US23), np.random.default_rng(2)
    found: dict[str, list[float]] = {"sumo_us": [], "kinematic_us": [], "ratio": []}

    def us(name: str, points: Any) -> tuple[float, list[bool]]:
        simulate(plans[name], pool.cases(points[:200], 2))  # SUMO starts
        start = time.process_time()
        episodes = simulate(plans[name], pool.cases(points, 2))
        spent_us = (time.process_time() - start) / len(points) * 1e6
        return spent_us, [episode.outcome.failed for episode in episodes]

    with threadpool_limits(1):
        for _ in range(rounds):
            points = rng.random((cases, 3))
            by_name = {name: us(name, points) for name in plans}
            (sumo, expected), (kinematic, failed) = by_name["sumo"], by_name["kinematic"]
            if failed != expected:
                raise RuntimeError("the engines disagree about a verdict")
            found["sumo_us"].append(sumo)
            found["kinematic_us"].append(kinematic)
            found["ratio"].append(sumo / kinematic)
    return found


def whole_campaigns(rounds: int, *options: str) -> dict[str, list[float]]:
    """Return the seconds of whole commands on one worker and on two, and their ratio, by round."""
    found: dict[str, list[float]] = {"s_on_one": [], "s_on_two": [], "gain": []}
    command = [sys.executable, "-m", "merge_sumo.cli", "campaign", "--vut", "design2"]
    command += [*options, "--quiet"]
    with tempfile.TemporaryDirectory() as scratch:
        for number in range(rounds):
            spent = []
            for workers in (1, 2):
                out = ["--workers", str(workers), "--out", f"{scratch}/{number}-{workers}"]
                start = time.perf_counter()
                subprocess.run([*command, *out], check=True, stdout=subprocess.DEVNULL)
                spent.append(time.perf_counter() - start)
            found["s_on_one"].append(spent[0])
            found["s_on_two"].append(spent[1])
            found["gain"].append(spent[0] / spent[1])
    return found


def slow_campaign(folder: Path, case_s: float, cases: int, *options: str) -> tuple[float, int]:
    """Return the seconds of a whole command whose VUT sleeps, and the number of cases that ran."""
    folder.mkdir()
    (folder / "sleepy.py").write_text(SLEEPY.format(case_s=case_s))
    command = [sys.executable, "-m", "merge_sumo.cli", "campaign", "--vut", "sleepy.py:Sleepy"]
    command += ["--cases", str(cases), "--quiet", "--out", "run", *options]
    start = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=folder)
    spent = time.perf_counter() - start
    twice = folder / "run" / "repeats.jsonl"  # some cases run a second time
    return spent, cases + (len(twice.read_bytes().splitlines()) if twice.exists() else 0)


def slow_controllers(case_s: float, cases: int) -> dict[str, list[float]]:
    """Return seconds of whole commands with a slow controller, and the gain of many workers.

    With the cases to .9 of the truth, which the gain may cost.
    """
    few, one = 24, ("--workers", "1")
    many = ("--workers", str(FLIGHT_WORKERS), "--in-flight", str(FLIGHT))
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        quick_s, ran = slow_campaign(folder / "quick", HARDLY_S, cases, *one)
        few_quick_s, few_ran = slow_campaign(folder / "few-quick", HARDLY_S, few, *one)
        few_s, _ = slow_campaign(folder / "few", case_s, few, *one)
        many_s, _ = slow_campaign(folder / "many", case_s, cases, *many)
    one_s = quick_s + ran * (case_s - HARDLY_S)
    return cases_in_flight() | {
        "s_on_one": [one_s],
        "s_on_one_computed_over_measured": [(few_quick_s + few_ran * (case_s - HARDLY_S)) / few_s],
        "s_on_many": [many_s],
        "gain": [one_s / many_s],
    }


def cases_to_most(in_flight: int | None, seed: int, levels: tuple[int, ...]) -> float:
    """Return the cases until `coverage` has .9 of the truth of design2; infinite for not yet."""
    settings = CampaignSettings(
        vut="design2",
        levels=levels,
        scenario=US23,
        cases=SEARCHED,
        seed=seed,
        in_flight=in_flight,
    )
    plan = resolve(settings)
    target = 0.9 * sum(fmc(ground_truth(plan, level).failures) for level in levels)
    with tempfile.TemporaryDirectory() as scratch:
        found = run_campaign(settings, plan, Path(scratch) / "run").outcomes
    for count in range(5, SEARCHED + 1, 5):
        failing = [o.case for o in found[:count] if o.failed]
        at = {level: [case for case in failing if case.level == level] for level in levels}
        if sum(fmc(to_unit(at[level], level, scenario=US23)) for level in levels) >= target:
            return float(count)
    return float("inf")


def cases_in_flight() -> dict[str, list[float]]:
    """Return the cases to .9 of the truth by seed, in batches and in flight."""
    return {
        f"cases_to_0.9_at_{name}_{how}": [
            cases_to_most(in_flight, seed, levels) for seed in range(FLIGHT_SEEDS)
        ]
        for name, levels in (("all_levels", (0, 1, 2)), ("level_1", (1,)))
        for how, in_flight in (("in_batches", None), ("in_flight", FLIGHT))
    }


class Served(Workers):
    """Gives episodes as they come from a worker process, with no work done for them."""

    def __init__(self, ran: Sequence[Episode]) -> None:
        """Serve the episodes of `MAX_CHUNK` cases."""
        super().__init__(None, 1)
        self._sent = pickle.dumps(list(ran))

    def collect(self, job: Job[Any, Any]) -> list[Any]:
        """Return episodes for the chunks of a job."""
        episodes = []
        for chunk in job.chunks:
            episodes += pickle.loads(self._sent)[: len(chunk)]  # noqa: S301 (our own)
        return episodes


def parent(cases: int) -> float:
    """Return how many cases per second a campaign takes that workers have run."""
    plan = resolve(CampaignSettings(vut=VUT, levels=(0,), scenario=US23))
    pool = Pool(levels=(0,), scenario=US23)
    served = Served(simulate(plan, pool.cases(np.random.default_rng(3).random((500, 2)), 0)))
    sampler = make_sampler("uniform", pool, 0)
    search = SearchLoop(sampler, plan, cases, workers=served, batch=BATCH)
    with (
        tempfile.TemporaryDirectory() as scratch,
        Journal.create(Path(scratch) / "run", {}) as journal,
    ):
        start = time.perf_counter()
        search.run(lambda groups: journal.append(*groups))
        return cases / (time.perf_counter() - start)


def history_of(count: int, seen: Sequence[Outcome]) -> list[Outcome]:
    """Return a history of that many outcomes: new places for what was measured once."""
    rng = np.random.default_rng(2)
    cases = from_unit(rng.random((count, 2)), 0, scenario=US23)
    outcomes = []
    for index, case in enumerate(cases):
        outcome = replace(seen[index % len(seen)], index=index, batch=index // BATCH, case=case)
        outcomes.append(outcome)
    return outcomes


def sampler_s(name: str, history: Sequence[Outcome]) -> float:
    """Return the seconds for one batch after a history."""
    sampler = make_sampler(name, Pool(levels=(0,), scenario=US23), 0)
    sampler.tell(history)
    return timed(partial(sampler.ask, BATCH))


def timed(function: Callable[[], object]) -> float:
    """Return the seconds that a function takes."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def files(count: int, seen: Sequence[Outcome], folder: Path) -> dict[str, float]:
    """Return the seconds for what is done with a finished campaign of that many cases."""
    outcomes = history_of(count, seen)
    text = "".join(map(to_line, outcomes)).encode()
    run = Run(folder)
    run.outcomes = outcomes
    points = to_unit((outcome.case for outcome in failures(outcomes)), 0, scenario=US23)
    found = {
        "cases": float(count),
        "failures": float(len(points)),
        "file_mb": len(text) / 1e6,
        "read_s": timed(lambda: read_outcomes(text, OUTCOMES, scenario=US23)),
        "fmc_s": timed(lambda: fmc(points)),
        "regions_s": timed(lambda: regions(points)),
        "report_s": timed(lambda: write_report(run)),
    }
    found["report_mb"] = (folder / "report.html").stat().st_size / 1e6
    return found


def of_campaigns(chosen: argparse.Namespace, tell: Callable[[str], None]) -> dict[str, Any]:
    """Return what samplers and files take after more and more outcomes."""
    result: dict[str, Any] = {"samplers": {}, "files": []}
    with tempfile.TemporaryDirectory() as scratch:
        settings = CampaignSettings(
            vut=VUT, levels=(0,), sampler="uniform", cases=400, batch=400, scenario=US23
        )
        run = run_campaign(settings, resolve(settings), Path(scratch) / "run")
        count = 100
        while count <= chosen.history and "samplers" in chosen.only:
            history = history_of(count, run.outcomes)
            spent = {name: sampler_s(name, history) for name in SAMPLERS}
            result["samplers"][count] = spent
            shown = ", ".join(f"{name} {seconds:.3f}" for name, seconds in spent.items())
            tell(f"samplers: seconds for a batch of {BATCH} after {count:,} cases: {shown}")
            count *= 10
        count = 10_000
        while count <= chosen.outcomes and "files" in chosen.only:
            row = files(count, run.outcomes, run.folder)
            result["files"].append(row)
            tell("files: " + ", ".join(f"{name} {value:.3g}" for name, value in row.items()))
            count *= 10
    return result


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--most", type=int, default=100_000, help="uniform cases of the largest run"
    )
    parser.add_argument("--campaign", type=int, default=20_000, help="cases of whole campaigns")
    parser.add_argument("--case-s", type=float, default=1.0, help="seconds of a slow case")
    parser.add_argument("--flight-cases", type=int, default=800, help="cases of a slow campaign")
    parser.add_argument("--history", type=int, default=10_000, help="longest history of a sampler")
    parser.add_argument("--outcomes", type=int, default=1_000_000, help="outcomes of a report")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="what to measure")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    add_record_option(parser)
    chosen = parser.parse_args()

    def tell(text: str) -> None:
        if not chosen.json:
            print(text, flush=True)

    def tell_spread(part: str, found: dict[str, list[float]]) -> None:
        for name, values in found.items():
            median = statistics.median(values)
            tell(f"{part}: {name}: {median:.2f} [{min(values):.2f}, {max(values):.2f}]")

    result: dict[str, Any] = {"truth": []}
    for row in truth(chosen.most) if "truth" in chosen.only else ():
        result["truth"].append(row)
        tell(
            f"truth: {row['cases']:9,.0f} cases at {row['cases_per_s']:6.0f} cases/s, worker at "
            f"most {row['worker_mb']:.0f} MB, this process {row['this_process_mb']:.0f} MB"
        )
    if {"workers", "parent"} & set(chosen.only):
        result["workers"] = two_workers()
        tell_spread("workers", result["workers"])
    uniform = ("--sampler", "uniform", "--cases", str(chosen.campaign))
    parts: dict[str, Callable[[], dict[str, list[float]]]] = {
        "engines": partial(engines, CHUNK, ROUNDS),
        "in-flight": partial(slow_controllers, chosen.case_s, chosen.flight_cases),
        "campaign": partial(whole_campaigns, CAMPAIGN_ROUNDS, *uniform),
        "default": partial(whole_campaigns, DEFAULT_ROUNDS),
    }
    for part, measure in parts.items():
        if part in chosen.only:
            result[part] = measure()
            tell_spread(part, result[part])
    if "parent" in chosen.only:
        taken = [parent(chosen.campaign) for _ in range(ROUNDS)]
        one = statistics.median(result["workers"]["cases_per_s_on_one"])
        feeds = [rate / one for rate in taken]
        result["parent"] = {"cases_per_s": taken, "feeds_workers": feeds}
        tell_spread("parent", result["parent"])
    if {"samplers", "files"} & set(chosen.only):
        result |= of_campaigns(chosen, tell)
    append_record(chosen.record, "scale", result)
    if chosen.json:
        print(json.dumps(result))


if __name__ == "__main__":
    # Workers find functions by the names of their modules, and do not know this one as __main__.
    import_module("bench_scale").main()
