"""Every command that writes under a given name, and the things that may have that name."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from pathlib import Path

CAMPAIGN = "campaign --vut design1 --level 0 --sampler uniform --cases 60 --seed 1 --quiet"
BENCHMARK = (
    "benchmark --vut design1 --level 0 --samplers uniform --seeds 1 --cases 40 --truth-cases 300 "
    "--workers 1"
)
WRITERS = {
    "campaign": (f"{CAMPAIGN} --out", ""),
    "junit of a campaign": (f"{CAMPAIGN} --out new --junit", ".xml"),
    "run": ("run --vut design1 --level 0 --x -200 --v 30 --out", ""),
    "probability": ("probability run --cases 40 --out", ".json"),
    "compare": ("compare run run --out", ".html"),
    "junit of compare": ("compare run run --junit", ".xml"),
    "benchmark": (f"{BENCHMARK} --figure", ".png"),
    "reproduce": ("reproduce --quick --seeds 1 --workers 1 --out", ""),
    "export": ("export run 0 1 --out", ""),
    "export csv": ("export run 0 --format csv --out", ""),
    "export cases": ("export run 0 --format cases --out", ".toml"),
    "rerun": ("rerun run 0 --out", ".html"),
    "junit of rerun": ("rerun run 0 --junit", ".xml"),
    "export openscenario": ("export run 0 --format openscenario --out", ""),
    "train": ("train --only pov1 --out", ""),
    "scenario new": (
        "scenario new --net us23.net.xml --mainline 'main_in main_out' --ramp 'ramp main_out' --",
        ".toml",
    ),
}
"""Command up to the name of what it writes, and how that name ends."""
INTO_FOLDERS = {"export", "export csv", "export openscenario"}
"""These add to a folder that is there."""


def folder_of_another_user(path: Path) -> None:
    path.mkdir()
    (path / "notes").write_text("theirs")


PLACES: dict[str, Callable[[Path], object]] = {
    "a file": lambda path: path.write_text("theirs"),
    "a folder": folder_of_another_user,
    "an empty folder": Path.mkdir,
    "a link to a folder": lambda path: path.symlink_to("theirs"),
    "a link to a file": lambda path: path.symlink_to("theirs/thesis"),
    "a dangling link": lambda path: path.symlink_to("theirs/nowhere"),
    "a link to itself": lambda path: path.symlink_to(path.name),
    "a pipe": os.mkfifo,
}
"""Things of another user at a place, and what makes them."""


def tree(root: Path) -> dict[str, tuple[int, ...]]:
    """Return everything below a folder by kind, and files and links by size and time of change."""
    found: dict[str, tuple[int, ...]] = {}
    for path in root.rglob("*"):
        status = path.lstat()
        found[str(path)] = (status.st_mode,)
        if not stat.S_ISDIR(status.st_mode):
            found[str(path)] += (status.st_size, status.st_mtime_ns)
    return found
