"""Time README's campaign in units of fixed work: `python tools/bench_default.py`.

The whole command runs in a process of its own, the unit before and after each run in another one:
six rounds of an SVD of a 600 x 600 normal matrix and of 1.5 million steps in pure Python. Prints
the median of the runs in seconds and in units, with the least and the largest.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from statistics import median

from bench_record import add_record_option, append_record

UNIT = """
import numpy as np
normal = np.random.default_rng(0).normal(size=(600, 600))
for _ in range(6):
    np.linalg.svd(normal)
    s = 0
    for i in range(1_500_000):
        s += i * i % 7
"""


def seconds(*command: str, folder: str) -> float:
    """Return how long a command takes."""
    start_s = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True, cwd=folder)
    return time.perf_counter() - start_s


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--program", default="merge-sumo", help="another installation's program")
    add_record_option(parser)
    options = parser.parse_args()
    took, units = [], []
    with tempfile.TemporaryDirectory() as folder:
        unit_s = [seconds(sys.executable, "-c", UNIT, folder=folder)]
        for number in range(options.runs):
            command = (options.program, "campaign", "--vut", "design2", "--out", f"run-{number}")
            took.append(seconds(*command, folder=folder))
            unit_s.append(seconds(sys.executable, "-c", UNIT, folder=folder))
            units.append(took[-1] / (0.5 * (unit_s[-1] + unit_s[-2])))
    line = f"{median(took):.1f} s [{min(took):.1f}, {max(took):.1f}], {median(units):.1f} units "
    line += f"[{min(units):.1f}, {max(units):.1f}]; a unit takes {median(unit_s):.2f} s"
    print(line)
    append_record(options.record, "default", {"seconds": median(took), "units": median(units)})


if __name__ == "__main__":
    main()
