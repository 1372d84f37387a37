"""Measure what a repair does to failure mode coverage, by truths with a seed of their own.

`python tools/bench_repair.py`

For each seed: a campaign of a VUT, its repair, and the ground truths before and after. Prints the
values, and by POV level FMC before and after, the share that is gone, and what is new: the FMC
that the failures after add to those before. Neither the campaign nor the repair sees a case of the
truths.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from bench_record import add_record_option, append_record

from merge_sumo import api
from merge_sumo.coverage.fmc import fmc

TRUTH_SEED = 12_345


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vut", default="design2")
    parser.add_argument(
        "--param",
        action="append",
        metavar="NAME=LOW..HIGH",
        help="by default the thresholds x1_m, x2_m and gap_m of design2",
    )
    parser.add_argument("--cases", type=int, default=400, help="cases of the campaign")
    parser.add_argument("--trials", type=int, default=60)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--first", type=int, default=20, help="first seed")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--truth-cases", type=int, default=100_000, help="cases of a level")
    add_record_option(parser)
    asked = parser.parse_args()
    params = asked.param or ["x1_m=60..180", "x2_m=5..60", "gap_m=8..40"]
    figures: dict[str, Any] = {}
    for seed in range(asked.first, asked.first + asked.seeds):
        with tempfile.TemporaryDirectory() as folder:
            run = api.campaign(
                asked.vut, cases=asked.cases, seed=seed, out=Path(folder) / "run", progress=False
            )
            found = api.repair(
                run,
                params,
                trials=asked.trials,
                rounds=asked.rounds,
                seed=seed,
                out=Path(folder) / "repair",
                progress=False,
            )
        print(f"seed {seed}", *found.lines(), sep="\n  ")
        if found.repaired is not None:
            truths = [
                api.truth(spec, cases=asked.truth_cases, seed=TRUTH_SEED, workers=None).truths
                for spec in (asked.vut, found.repaired)
            ]
            figures[str(seed)] = {
                str(level): row(*(t[level] for t in truths)) for level in truths[0]
            }
            for level, of in figures[str(seed)].items():
                print(f"  level {level}:", *(f"{name} {value:.4f}" for name, value in of.items()))
    append_record(asked.record, "repair", figures)


def row(before: Any, after: Any) -> dict[str, float]:
    """Return the figures of a level from two truths."""
    was, now = fmc(before.failures), fmc(after.failures)
    new = fmc(np.concatenate((before.failures, after.failures))) - was
    gone = 1.0 - now / was if was else 0.0
    return {"before": was, "after": now, "gone": gone, "new": new}


if __name__ == "__main__":
    main()
