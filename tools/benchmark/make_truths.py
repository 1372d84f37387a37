"""Make the dense truths of the benchmark of samplers, and their manifest.

    python tools/benchmark/make_truths.py
    python tools/benchmark/make_truths.py --problems rules,table

It takes some minutes of CPU, and no network. After a change that
gives a case another verdict, the numbers of samplers are not comparable with earlier ones.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import msgspec
from problems import (
    MANIFEST,
    PROBLEMS,
    TRUTHS,
    Manifest,
    make_truth,
    named_problems,
)

from merge_sumo.errors import UserError
from merge_sumo.records import read_record


def main() -> None:
    """Make the truths that the command line names, and write the manifest after each."""
    parser = argparse.ArgumentParser(description="Make the dense truths of the benchmark.")
    parser.add_argument("--problems", help="names, separated by commas; all by default")
    parser.add_argument("--out", type=Path, default=TRUTHS, help="folder to write")
    options = parser.parse_args()
    names = None if options.problems is None else tuple(options.problems.split(","))
    options.out.mkdir(exist_ok=True)
    before = read_record(options.out / MANIFEST, Manifest)
    known = {} if before is None else dict(before.truths)
    for problem in named_problems(names):
        start_s = time.process_time()
        made = known[problem.name] = make_truth(problem, options.out)
        cpu_s = time.process_time() - start_s
        print(
            f"{problem.name}: FMC {sum(made.fmc.values()):.4f}, failures {made.failures} of "
            f"{made.cases}, growth {made.growth}, {cpu_s:.0f} s of CPU",
            flush=True,
        )
        kept = {one.name: known[one.name] for one in PROBLEMS if one.name in known}
        record = {"truths": {name: msgspec.structs.asdict(one) for name, one in kept.items()}}
        text = json.dumps(record, indent=1)
        (options.out / MANIFEST).write_text(f"{text}\n", encoding="utf-8")


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        sys.exit(str(error))
