"""Ways to run the command line, and how it refuses."""

from __future__ import annotations

import io
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import NamedTuple
from unicodedata import category

from cyclopts import App

from merge_sumo import cli
from merge_sumo.errors import UserError


class Said(NamedTuple):
    """Exit code and output of a command."""

    code: int
    out: str
    err: str


def commands() -> dict[str, App]:
    """Return all commands by their words."""
    found: dict[str, App] = {}
    waiting: list[tuple[str, App]] = [("", cli.app)]
    while waiting:
        front, group = waiting.pop()
        for name, command in group.resolved_commands().items():
            if command.default_command is None:
                waiting.append((f"{name} ", command))
            elif not name.startswith("-"):
                found[front + name] = command
    return found


class Result(NamedTuple):
    """What a command printed in this process, and the `UserError` that it raised."""

    exit_code: int
    stdout: str
    stderr: str
    exception: UserError | None

    @property
    def output(self) -> str:
        return self.stdout + self.stderr


def invoke(*words: object) -> Result:
    """Run a command in this process: bad use is an exception of the result."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        try:
            code, raised = cli.execute([str(word) for word in words]), None
        except UserError as error:
            code, raised = 2, error
    return Result(code, out.getvalue(), err.getvalue(), raised)


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
    assert not any(category(letter)[0] == "C" for letter in err[:-1]), err
    for part in parts:
        assert part in err


def contents(folder: Path) -> dict[Path, bytes | None]:
    """Return everything below a folder: files with their bytes, folders with None."""
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}
