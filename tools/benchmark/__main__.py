"""A contest of samplers: twelve frozen problems whose failures are known, one number a sampler.

    python tools/benchmark coverage gpr --quick
    python tools/benchmark my_sampler.py:Mine uniform --workers 2 --out mine

The same command goes on with a run that was stopped: searches in its folder do not run again.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import contest
from contest_page import contest_page
from entrants import LIMIT_S, check_spec
from problems import named_problems

from merge_sumo.errors import UserError
from merge_sumo.files import GENERATOR, check_ours, replace_own
from merge_sumo.reports.progress import Bars
from merge_sumo.workers import LocalProcesses, Workers, workers_or_cores


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the contest that the command line names, and write and print what it finds."""
    parser = argparse.ArgumentParser(prog="python tools/benchmark", description=__doc__)
    parser.add_argument("samplers", nargs="+", metavar="SAMPLER", help="name, or FILE.py:CLASS")
    parser.add_argument("--problems", help="names, separated by commas; all by default")
    parser.add_argument("--quick", action="store_true", help="two problems, one seed, 50 cases")
    parser.add_argument("--seeds", type=int, help="searches a problem, seeds 100, 101, ...: 3")
    parser.add_argument("--cases", type=int, help="cases of a search, 400 at most: 400")
    parser.add_argument("--limit", type=float, default=LIMIT_S, help="s of a sampler in a search")
    parser.add_argument("--workers", type=int, help="processes that search; one a core")
    parser.add_argument("--out", type=Path, default=Path("benchmark"), help="folder to write")
    given = parser.parse_args(arguments)
    for spec in given.samplers:
        check_spec(spec)
    chosen = contest.QUICK_PROBLEMS if given.quick else None
    settings = contest.BenchmarkSettings(
        seeds=given.seeds or (1 if given.quick else 3),
        cases=given.cases or (contest.QUICK_CASES if given.quick else max(contest.COUNTED)),
        problems=named_problems(tuple(given.problems.split(",")) if given.problems else chosen),
        limit_s=given.limit,
    )
    folder = given.out
    if folder.exists() and not (folder / contest.SEARCHES).is_dir():
        raise UserError(f"{folder} is no folder of searches: name a new one")
    check_ours(folder / contest.PAGE)
    with Workers(LocalProcesses, workers_or_cores(given.workers)) as workers, Bars() as bars:
        result = contest.benchmark(given.samplers, settings, folder, workers, on_step=bars.counted)
    record = json.dumps(result.to_record(), indent=1, allow_nan=False)
    replace_own(folder / contest.RECORD, f"{record}\n".encode())
    page = contest_page(result).encode(errors="backslashreplace")
    replace_own(folder / contest.PAGE, page, GENERATOR)
    print(result)


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        sys.exit(str(error))
