"""Show where `--stop-when-converged` ends a search: `python tools/bench_stopping.py`.

For each VUT it runs 1,600 cases, and prints the number of them at which the coverage of all levels
together first has .97 of that of the whole search, the number at which the rule stops, and the
share found by then. `--vut SPEC` names others, `--seed` another search.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

from bench_record import add_record_option, append_record

import merge_sumo as ms
from merge_sumo.campaigns.stopping import coverage_by_level, has_converged
from merge_sumo.verdict.score import Outcome

VUTS = (
    *("design1", "design2", "gap", "level0", "sumo:IDM"),
    *(f"tools/trial_vuts.py:{name}" for name in ("Idm", "Rss", "Courteous", "Delayed")),
    *(f"tools/held_out_vuts.py:{name}" for name in ("Islands", "Shell", "Slots")),
)
CASES = 1600
NEARLY = 0.97


def ends_of_batches(outcomes: Sequence[Outcome]) -> list[int]:
    """Return the numbers of cases after each batch."""
    last = {outcome.batch: outcome.index + 1 for outcome in outcomes}
    return sorted(last.values())


def row(vut: str, seed: int, folder: Path) -> str:
    """Return the line of a VUT."""
    run = ms.campaign(vut, cases=CASES, seed=seed, out=folder, progress=False, workers=None)
    outcomes = run.run.outcomes
    whole = sum(coverage_by_level(outcomes).values())
    name = vut.rpartition(":")[2]
    if not whole:
        return f"{name:12s} no failure"
    ends = ends_of_batches(outcomes)
    share = {n: sum(coverage_by_level(outcomes[:n]).values()) / whole for n in ends}
    nearly = next(n for n in ends if share[n] >= NEARLY)
    stop = next((n for n in ends if has_converged(outcomes[:n])), CASES)
    return f"{name:12s} {nearly:6d} {stop:6d} {share[stop]:8.3f}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--vut", action="append", help="a VUT; may be given several times")
    parser.add_argument("--seed", type=int, default=11)
    add_record_option(parser)
    options = parser.parse_args()
    rows = {}
    print(f"{'VUT':12s} {NEARLY:6.2f} {'stop':>6s} {'share':>8s}")
    for vut in options.vut or VUTS:
        with tempfile.TemporaryDirectory() as folder:
            rows[vut] = row(vut, options.seed, Path(folder) / "run")
            print(rows[vut], flush=True)
    append_record(options.record, "stopping", rows)


if __name__ == "__main__":
    main()
