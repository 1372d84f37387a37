"""What a controller prints: taken from it while it runs, kept in a file, its end at hand."""

from __future__ import annotations

import os
import stat
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import IO, Final

from merge_sumo.scenario.trajectory import as_reason
from merge_sumo.system.printable import printable

LOG: Final = "controller.log"
"""In the folder of a campaign."""
TAIL_BYTES: Final = 2000
MOST_BYTES: Final = 4 << 20
"""A longer log loses its older part: a controller may print for ever."""
KEPT_BYTES: Final = 1 << 20
PENDING_BYTES: Final = 1 << 16
"""What is kept of what is printed before the folder of the log is there."""
LINE_BYTES: Final = 200
PATIENCE_S: Final = 1.0
"""Time that the end of what is printed has to come."""
_CAREFUL: Final = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
"""Whatever stands in the place of a log is neither followed nor waited for."""


class Output:
    """Reads what a program prints until it ends, so that a full pipe never holds it up."""

    def __init__(self, pipe: IO[bytes], log: Path | None) -> None:
        """Read a pipe; add what comes to the file `log`, or show it on standard error."""
        self._pipe, self._log = pipe, log
        self._tail = self._pending = b""
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def last_line(self) -> str:
        """Return the last line that was printed, after a little wait for the end; "" for none."""
        self.close()
        lines = self._tail.decode("utf-8", errors="replace").strip().splitlines()
        return as_reason(lines[-1]) if lines else ""

    def close(self) -> None:
        """Take what is left; what a process that was left behind prints later is lost."""
        self._thread.join(PATIENCE_S)

    def _read(self) -> None:
        with self._pipe as pipe:
            while part := os.read(pipe.fileno(), 1 << 16):
                self._tail = (self._tail + part)[-TAIL_BYTES:]
                if self._log is None:
                    sys.stderr.write(part.decode("utf-8", errors="replace"))
                else:
                    self._pending = (self._pending + part)[-PENDING_BYTES:]
                    if self._log.parent.is_dir():
                        # A full disk costs what was printed, not the campaign.
                        with suppress(OSError):
                            append(self._log, self._pending)
                        self._pending = b""


LINES: Final = 40
"""Of the end of a log that a person is shown."""


def end_of(log: Path) -> str:
    """Return the last lines of a log, printable; "" where there is no such file."""
    try:
        descriptor = os.open(log, os.O_RDONLY | _CAREFUL)
        with os.fdopen(descriptor, "rb") as file:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                return ""
            file.seek(max(file.seek(0, os.SEEK_END) - LINES * LINE_BYTES, 0))
            text = file.read(LINES * LINE_BYTES).decode("utf-8", errors="replace")
    except OSError:
        return ""
    return "\n".join(printable(line) for line in text.splitlines()[-LINES:])


def append(log: Path, content: bytes) -> None:
    """Add to a log, from whichever of several processes; OSError when that cannot be done."""
    flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | _CAREFUL
    descriptor = os.open(log, flags, 0o644)
    with os.fdopen(descriptor, "r+b", buffering=0) as file:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            return
        if sys.platform != "win32":  # several processes may write
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX)
        file.write(content)
        size = file.seek(0, os.SEEK_END)
        if size > MOST_BYTES:
            file.seek(size - KEPT_BYTES)
            end = file.read(KEPT_BYTES)
            file.truncate(0)
            file.write(b"[what was printed before is gone]\n" + end)
