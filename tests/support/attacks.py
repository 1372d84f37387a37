"""What the tests of attacks share: our command in a world of its own, and what it leaves there."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

MARK = "MERGE_SUMO_ATTACK"
"""Environment variable by which the processes of a world are found."""
PATIENCE_S = 600.0


@dataclass
class World:
    """A working folder, a cache and a folder for temporary files, and the processes that use them.

    `prefix` is the program that starts it.
    """

    root: Path
    prefix: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        self.mark = uuid.uuid4().hex
        for folder in (self.root, self.temporary):
            folder.mkdir(exist_ok=True)

    @property
    def temporary(self) -> Path:
        return self.root / "tmp"

    @property
    def cache(self) -> Path:
        return self.root / "cache"

    def start(self, *arguments: object, script: str | None = None) -> subprocess.Popen[str]:
        """Start our command, or a script, as a session of its own."""
        what = ("-m", "merge_sumo.cli") if script is None else ("-c", script)
        environment = {
            **os.environ,
            "TMPDIR": str(self.temporary),
            "MERGE_SUMO_CACHE": str(self.cache),
            MARK: self.mark,
        }
        return subprocess.Popen(
            [*self.prefix, sys.executable, *what, *map(str, arguments)],
            cwd=self.root,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            # Where the tests run in the background, a shell has them ignore it.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
        )

    def run(self, *arguments: object, script: str | None = None) -> tuple[int, str, str]:
        """Run our command to its end; return its exit code, its output and its errors."""
        process = self.start(*arguments, script=script)
        out, err = process.communicate(timeout=PATIENCE_S)
        return process.returncode, out, err

    def processes(self) -> list[int]:
        """Return the processes that belong to this world and are no zombies."""
        found = []
        for place in Path("/proc").iterdir():
            try:
                if place.name.isdigit() and self.mark.encode() in (place / "environ").read_bytes():
                    found.append(int(place.name))
            except OSError:
                continue
        return found

    def has_ended(self) -> bool:
        """Return whether no process of this world is left."""
        return not self.processes()

    def files(self) -> dict[str, bytes]:
        """Return the files below the root by name; the temporary and the cache's are left out."""
        apart = (self.temporary, self.cache)
        return {
            str(path.relative_to(self.root)): path.read_bytes()
            for path in sorted(self.root.rglob("*"))
            if path.is_file() and not any(path.is_relative_to(folder) for folder in apart)
        }

    def left_in_temporary(self) -> list[str]:
        """Return the names of what is in the folder for temporary files."""
        return sorted(path.name for path in self.temporary.iterdir())


SIGNALS: dict[str, Sequence[int]] = {
    "SIGKILL": (signal.SIGKILL,),
    "SIGTERM": (signal.SIGTERM,),
    "Ctrl-C": (signal.SIGINT,),
    "Ctrl-C twice": (signal.SIGINT, signal.SIGINT),
}


def stop(process: subprocess.Popen[str], how: str, *, keyboard: bool = True) -> tuple[int, str]:
    """Stop a process as it is named in `SIGNALS`; return how it ended and what it said.

    A keyboard's Ctrl-C goes to the whole foreground group.
    """
    for number in SIGNALS[how]:
        if process.poll() is None:
            if keyboard and number == signal.SIGINT:
                os.killpg(process.pid, number)
            else:
                process.send_signal(number)
        time.sleep(0.2)
    _, err = process.communicate(timeout=PATIENCE_S)
    return process.returncode, err
