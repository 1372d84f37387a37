"""A record of benchmarks: `--record FILE` appends one JSON line, with the versions and the machine.

Lines of one machine show how a ratio changes from version to version; absolute times of different
machines do not compare.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import subprocess
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

PACKAGES: Final = ("merge-sumo", "libsumo", "numpy")


def add_record_option(parser: argparse.ArgumentParser) -> None:
    """Add `--record FILE` to the options of a benchmark."""
    parser.add_argument(
        "--record", type=Path, metavar="FILE", help="append the figures to FILE, as one JSON line"
    )


def append_record(file: Path | None, benchmark: str, figures: Mapping[str, Any]) -> None:
    """Append the figures of a benchmark to a file; do nothing without one.

    Args:
        file: what `--record` names, begun where it does not exist.
        benchmark: name of the benchmark.
        figures: what it measured, as JSON can hold it; medians over rounds.
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
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        text = ""
    names = [line.partition(":")[2].strip() for line in text.splitlines() if "model name" in line]
    return names[0] if names else platform.processor() or platform.machine()
