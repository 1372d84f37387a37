"""Functions for all benchmarks: a clock, medians with their spread, and `--record FILE`.

A record is one JSON line with the figures, the versions and the machine. You can compare ratios on
one machine from version to version. You cannot compare absolute times on different machines.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import Any

PACKAGES = ("merge-sumo", "libsumo", "numpy")


def benchmark_parser(about: str | None) -> argparse.ArgumentParser:
    """Return a parser with `--record FILE`.

    Args:
        about: docstring of the benchmark, which is the help.
    """
    parser = argparse.ArgumentParser(
        description=about, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--record", type=Path, metavar="FILE", help="append the figures to FILE, as one JSON line"
    )
    return parser


def seconds(work: Callable[[], object]) -> float:
    """Return the wall-clock seconds of a function.

    Args:
        work: the function.
    """
    start_s = time.perf_counter()
    work()
    return time.perf_counter() - start_s


def spread(values: Iterable[float], digits: int = 2) -> str:
    """Return numbers as "median [least, most]".

    Args:
        values: the numbers.
        digits: decimals.
    """
    known = sorted(values)
    return f"{median(known):.{digits}f} [{known[0]:.{digits}f}, {known[-1]:.{digits}f}]"


def append_record(file: Path | None, benchmark: str, figures: Mapping[Any, Any]) -> None:
    """Append the figures of a benchmark to a file; do nothing without one.

    Args:
        file: file after `--record`, created where it does not exist.
        benchmark: name of the benchmark.
        figures: its results, as JSON can hold them.
    """
    if file is None:
        return
    line = {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "benchmark": benchmark,
        "commit": _commit(),
        "python": platform.python_version(),
        **{package: version(package) for package in PACKAGES},
        "cpu": _cpu_model(),
        "cpus": os.cpu_count(),
        "figures": figures,
    }
    with file.open("a", encoding="utf-8") as lines:
        lines.write(json.dumps(line) + "\n")


def _commit() -> str | None:
    """Return the commit of this checkout, with a plus where files have changed since."""
    git = shutil.which("git")
    if git is None:
        return None
    command = [git, "describe", "--always", "--dirty=+", "--exclude=*"]
    folder = Path(__file__).parent
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    return done.stdout.strip() or None


def _cpu_model() -> str:
    """Return the name of the processor; on Linux as the kernel knows it."""
    cpus = Path("/proc/cpuinfo")
    if cpus.exists():
        for line in cpus.read_text(encoding="utf-8").splitlines():
            if "model name" in line:
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
