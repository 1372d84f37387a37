"""Every command that writes under a name that a person gives, and what may be at that place."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Final

CAMPAIGN: Final = "campaign --vut design1 --level 0 --sampler uniform --cases 60 --seed 1 --quiet"
BENCHMARK: Final = (
    "benchmark --vut design1 --level 0 --samplers uniform --seeds 1 --cases 40 --truth-cases 300 "
    "--workers 1"
)
WRITERS: Final = {
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
INTO_FOLDERS: Final = {"export", "export csv", "export openscenario"}
"""These add to a folder that is there."""


def folder_of_somebody(path: Path) -> None:
    path.mkdir()
    (path / "notes").write_text("theirs")


PLACES: Final[dict[str, Callable[[Path], object]]] = {
    "a file": lambda path: path.write_text("theirs"),
    "a folder": folder_of_somebody,
    "an empty folder": Path.mkdir,
    "a link to a folder": lambda path: path.symlink_to("theirs"),
    "a link to a file": lambda path: path.symlink_to("theirs/thesis"),
    "a dangling link": lambda path: path.symlink_to("theirs/nowhere"),
    "a link to itself": lambda path: path.symlink_to(path.name),
    "a pipe": os.mkfifo,
}
"""What makes what is there already, of somebody else."""
