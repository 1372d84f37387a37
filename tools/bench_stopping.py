"""Show where a search that has converged ends: `python tools/bench_stopping.py`.

For each VUT it runs 800 cases on each of some seeds, and prints medians: the number of cases at
which the coverage of all levels together first has .97 of that of the whole search, the number at
which the rule stops, and the share found by then, with the least and the largest. `--vut SPEC`
names others, `--first` and `--seeds` other searches, `--cases` longer ones.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from bench_record import add_record_option, append_record

import merge_sumo as ms
from merge_sumo.campaigns.run import coverage_by_level, has_converged
from merge_sumo.metrics.outcome import Outcome

VUTS = (
    *("design1", "design2", "gap", "level0", "sumo:IDM"),
    *(f"tools/trial_vuts.py:{name}" for name in ("Idm", "Rss", "Courteous", "Delayed")),
    *(f"tools/held_out_vuts.py:{name}" for name in ("Islands", "Shell", "Slots")),
)
NEARLY = 0.97


def ends_of_batches(outcomes: Sequence[Outcome]) -> list[int]:
    """Return the numbers of cases after each batch."""
    last = {outcome.batch: outcome.index + 1 for outcome in outcomes}
    return sorted(last.values())


def search(vut: str, seed: int, cases: int, folder: Path) -> tuple[int, int, float]:
    """Return when a search was nearly over, when the rule stops it, and its share by then."""
    run = ms.campaign(vut, cases=cases, seed=seed, out=folder, progress=False, workers=None)
    outcomes = run.run.outcomes
    whole = sum(coverage_by_level(outcomes).values())
    ends = ends_of_batches(outcomes)
    share = {n: sum(coverage_by_level(outcomes[:n]).values()) / whole for n in ends}
    nearly = next(n for n in ends if share[n] >= NEARLY)
    stop = next((n for n in ends if has_converged(outcomes[:n])), cases)
    return nearly, stop, share[stop]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--vut", action="append", help="a VUT; may be given several times")
    parser.add_argument("--first", type=int, default=11)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--cases", type=int, default=800)
    add_record_option(parser)
    options = parser.parse_args()
    rows = {}
    print(f"{'VUT':12s} {NEARLY:6.2f} {'stop':>6s} {'share':>6s}")
    for vut in options.vut or VUTS:
        found = []
        for seed in range(options.first, options.first + options.seeds):
            with tempfile.TemporaryDirectory() as folder:
                found.append(search(vut, seed, options.cases, Path(folder) / "run"))
        nearly, stop, share = zip(*found, strict=True)
        rows[vut] = (
            f"{vut.rpartition(':')[2]:12s} {median(nearly):6.0f} {median(stop):6.0f} "
            f"{median(share):6.3f} [{min(share):.3f}, {max(share):.3f}]"
        )
        print(rows[vut], flush=True)
    append_record(options.record, "stopping", rows)


if __name__ == "__main__":
    main()
