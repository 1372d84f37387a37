"""Make the dense truths of the benchmark of samplers, and their manifest.

    python tools/make_truths.py
    python tools/make_truths.py --problems rules,table

It takes some minutes of CPU, and no network. After a change that gives a case another verdict, the
numbers of samplers are not comparable with earlier ones.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import sys
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from oracle import oracle
from problems import (
    MANIFEST,
    ORACLE_CASES,
    PROBLEMS,
    STEPS,
    TRUTHS,
    KnownTruth,
    Problem,
    manifest,
    named_problems,
)
from scipy.spatial import cKDTree

from merge_sumo.analysis.truth import Truth, ground_truth
from merge_sumo.errors import UserError
from merge_sumo.metrics.fmc import fmc, growth_bound, radius_for

MOST_FAILURES = 20_000
"""Failures of a level that a truth keeps at most: the first ones, which are as uniform as all."""
PROBES = 48
"""Probe cases of a level that fail, and number of those that pass near one that fails."""


def make_truth(problem: Problem, folder: Path) -> KnownTruth:
    """Run the uniform cases of a problem, and write its truth.

    Args:
        problem: the problem.
        folder: folder of the truths.

    Returns:
        The entry of the manifest.
    """
    plan = problem.plan()
    arrays: dict[str, Any] = {}
    failures = {}
    for level in problem.levels:
        found = ground_truth(plan.at_level(level), level, problem.cases)
        kept = np.round(found.failures[:MOST_FAILURES] * STEPS).astype(np.uint16)
        arrays[f"failures_{level}"], failures[level] = kept, kept / STEPS
        failing, passing = probes_of(found)
        arrays[f"probes_{level}"] = np.concatenate([failing, passing])
        arrays[f"probes_failed_{level}"] = np.repeat([True, False], [len(failing), len(passing)])
    arrays["oracle"] = oracle(failures, ORACLE_CASES)
    content = io.BytesIO()
    np.savez(content, **arrays)
    (folder / f"{problem.name}.npz").write_bytes(content.getvalue())
    return KnownTruth(
        sha256=hashlib.sha256(content.getvalue()).hexdigest(),
        engine=str(plan.engine),
        cases=problem.cases,
        failures={str(level): len(points) for level, points in failures.items()},
        fmc={str(level): fmc(points) for level, points in failures.items()},
        growth={str(level): round(growth_bound(one), 3) for level, one in failures.items()},
        versions=dict(plan.versions),
    )


def probes_of(truth: Truth) -> tuple[Any, Any]:
    """Return failures of a truth, and passing cases near failures, (n, d) each.

    Args:
        truth: the truth of a level.
    """
    failing, passing = truth.failures, truth.points[truth.margin >= 0.0]
    distance, _ = cKDTree(failing).query(passing)
    near = passing[distance <= radius_for(passing.shape[1])]
    # Evenly over all, which are in random order.
    chosen = [points[:: max(1, len(points) // PROBES)][:PROBES] for points in (failing, near)]
    return chosen[0], chosen[1]


def main() -> None:
    """Make the truths that the command line names, and write the manifest after each."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--problems", help="names, separated by commas; all by default")
    parser.add_argument("--out", type=Path, default=TRUTHS, help="output folder")
    options = parser.parse_args()
    chosen = PROBLEMS if options.problems is None else named_problems(options.problems.split(","))
    options.out.mkdir(exist_ok=True)
    known = dict(manifest(options.out).truths)
    for problem in chosen:
        start_s = time.process_time()
        made = known[problem.name] = make_truth(problem, options.out)
        print(
            f"{problem.name}: FMC {sum(made.fmc.values()):.4f}, failures {made.failures} of "
            f"{made.cases}, growth {made.growth}, {time.process_time() - start_s:.0f} s of CPU",
            flush=True,
        )
        truths = {}
        for one in PROBLEMS:
            if one.name in known:
                truths[one.name] = msgspec.structs.asdict(known[one.name])
        text = json.dumps({"truths": truths}, indent=1)
        (options.out / MANIFEST).write_text(f"{text}\n", encoding="utf-8")


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        sys.exit(str(error))
