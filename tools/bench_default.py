"""Time README's campaign in units of fixed work: `python tools/bench_default.py`.

The whole command runs in a process of its own. Before and after each run, another process measures
the unit: six rounds of an SVD of a 600 x 600 normal matrix and of 1.5 million steps in pure Python.
The script prints the median of the runs in seconds and in units, with minimum and maximum.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from functools import partial
from statistics import median

from measuring import append_record, benchmark_parser, seconds, spread

UNIT = """
import numpy as np
normal = np.random.default_rng(0).normal(size=(600, 600))
for _ in range(6):
    np.linalg.svd(normal)
    s = 0
    for i in range(1_500_000):
        s += i * i % 7
"""


def main() -> None:
    """Print the figures."""
    parser = benchmark_parser(__doc__)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--program", default="merge-sumo", help="program of another installation")
    options = parser.parse_args()
    took, units = [], []
    with tempfile.TemporaryDirectory() as folder:
        run = partial(subprocess.run, check=True, capture_output=True, cwd=folder)
        unit = partial(run, (sys.executable, "-c", UNIT))
        unit_s = [seconds(unit)]
        for number in range(options.runs):
            command = (options.program, "campaign", "--vut", "design2", "--out", f"run-{number}")
            took.append(seconds(partial(run, command)))
            unit_s.append(seconds(unit))
            units.append(took[-1] / (0.5 * (unit_s[-1] + unit_s[-2])))
    print(f"{spread(took, 1)} s, {spread(units, 1)} units; a unit takes {median(unit_s):.2f} s")
    append_record(options.record, "default", {"seconds": median(took), "units": median(units)})


if __name__ == "__main__":
    main()
