"""Ways to run the command line, and how it refuses."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

from typer.testing import CliRunner, Result

from merge_sumo import cli


class Said(NamedTuple):
    """Exit code and output of a command."""

    code: int
    out: str
    err: str


def invoke(*words: object) -> Result:
    """Run a command in this process by typer's runner: an error is an exception of the result."""
    return CliRunner().invoke(cli.app, [str(word) for word in words])


def run_in_a_process(folder: Path, *arguments: object) -> Said:
    """Run a command in a process of its own, from a folder."""
    done = subprocess.run(
        [sys.executable, "-m", "merge_sumo.cli", *map(str, arguments)],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    return Said(done.returncode, done.stdout, done.stderr)


def assert_refused(said: tuple[int, str, str], *parts: str) -> None:
    """One sentence on standard error, nothing on standard output, exit code 2."""
    code, out, err = said
    assert (code, out) == (2, ""), said
    assert err.startswith("merge-sumo: ")
    assert err.endswith("\n")
    assert err.count("\n") == 1
    for part in parts:
        assert part in err


def contents(folder: Path) -> dict[Path, bytes | None]:
    """Return everything below a folder: files with their bytes, folders with None."""
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}
