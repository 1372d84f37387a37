"""A command in a folder of its own, and what it leaves there."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Sequence
from pathlib import Path

from support.processes import marked

PATIENCE_S = 600.0


class Workspace:
    """A working folder, a cache and a folder for temporary files, and the processes in them.

    `prefix` is the program that starts merge-sumo.
    """

    def __init__(self, root: Path, prefix: Sequence[str] = ()) -> None:
        self.root, self.prefix, self.mark = root, prefix, uuid.uuid4().hex
        self.temporary, self.cache = root / "tmp", root / "cache"
        for folder in (self.root, self.temporary):
            folder.mkdir(exist_ok=True)

    def start(self, *arguments: object, script: str | None = None) -> subprocess.Popen[str]:
        """Start merge-sumo, or a script, as a session of its own."""
        what = ("-m", "merge_sumo.cli") if script is None else ("-c", script)
        own = {"TMPDIR": str(self.temporary), "MERGE_SUMO_CACHE": str(self.cache)}
        return subprocess.Popen(
            [*self.prefix, sys.executable, *what, *map(str, arguments)],
            cwd=self.root,
            env={**os.environ, **own, "MERGE_SUMO_ATTACK": self.mark},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            # Where the tests run in the background, a shell has them ignore it.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
        )

    def run(self, *arguments: object, script: str | None = None) -> tuple[int, str, str]:
        """Run merge-sumo to its end; return its exit code, its output and its errors."""
        process = self.start(*arguments, script=script)
        out, err = process.communicate(timeout=PATIENCE_S)
        return process.returncode, out, err

    def has_ended(self) -> bool:
        """Return whether no process of this workspace is left."""
        return not marked(self.mark)

    def files(self) -> dict[str, bytes]:
        """Return the files below the root by name; the temporary and the cache's are left out."""
        found = {}
        for path in sorted(self.root.rglob("*")):
            name = path.relative_to(self.root)
            if path.is_file() and name.parts[0] not in ("tmp", "cache"):
                found[str(name)] = path.read_bytes()
        return found

    def left_in_temporary(self) -> list[str]:
        """Return the names in the folder for temporary files."""
        return sorted(path.name for path in self.temporary.iterdir())


SIGNALS: dict[str, Sequence[int]] = {
    "SIGKILL": (signal.SIGKILL,),
    "SIGTERM": (signal.SIGTERM,),
    "Ctrl-C": (signal.SIGINT,),
    "Ctrl-C twice": (signal.SIGINT, signal.SIGINT),
}


def stop(process: subprocess.Popen[str], how: str) -> tuple[int, str]:
    """Stop a process as it is named in `SIGNALS`; return its exit code and its errors.

    A keyboard's Ctrl-C goes to the whole foreground group.
    """
    for number in SIGNALS[how]:
        if process.poll() is None:
            if number == signal.SIGINT:
                os.killpg(process.pid, number)
            else:
                process.send_signal(number)
        time.sleep(0.2)
    _, err = process.communicate(timeout=PATIENCE_S)
    return process.returncode, err
