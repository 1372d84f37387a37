"""A controller that is a program: started, watched and stopped; what it prints is kept in a log."""

from __future__ import annotations

import itertools
import os
import shlex
import shutil
import signal
import stat
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Final

from merge_sumo.errors import UserError
from merge_sumo.printable import counted, printable
from merge_sumo.scenario.trajectory import as_reason

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


class Echo:
    """What the starts of a program print, on standard error: once what they print alike."""

    def __init__(self) -> None:
        self._last, self._again = b"", 0
        self._text = self._held = b""

    def close(self) -> None:
        """Say how often the last was printed again."""
        if self._again:
            sys.stderr.write(f"(printed {counted(self._again, 'more time')})\n")
        self._again = 0

    def show(self, part: bytes) -> None:
        """Show what a start prints, from where it differs from the start before."""
        self._text, self._held = (self._text + part)[:PENDING_BYTES], self._held + part
        if len(self._text) == PENDING_BYTES or not self._last.startswith(self._text):
            self._write()

    def end(self) -> None:
        """Take note that a start has printed all."""
        if self._held and self._held == self._last:
            self._again += 1
        else:
            self._write()
            self._last = self._text or self._last
        self._text = self._held = b""

    def _write(self) -> None:
        if self._held:
            self.close()
            sys.stderr.write(self._held.decode("utf-8", errors="replace"))
        self._held = b""


class Output:
    """Reads what a program prints until it ends, so that a full pipe never holds it up.

    Attributes:
        log: file to which it is added; None shows it on standard error. A log that is set later
            has what was printed before, too.
    """

    def __init__(self, pipe: IO[bytes], log: Path | None, echo: Echo) -> None:
        """Read a pipe; what comes goes to `log`, or to `echo` where that is None."""
        self.log = log
        self._pipe, self._echo = pipe, echo
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
                self._pending = (self._pending + part)[-PENDING_BYTES:]
                if self.log is None:
                    self._echo.show(part)
                else:
                    self._keep(self.log)
        self._echo.end()
        if self.log is not None:
            self._keep(self.log)

    def _keep(self, log: Path) -> None:
        if self._pending and log.parent.is_dir():
            with suppress(OSError):  # a full disk costs what was printed, not the campaign
                append(log, self._pending)
            self._pending = b""


LINES: Final = 40
"""Of the end of a log that is shown."""


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


PORT_FIELD: Final = "{port}"
PORT_VARIABLE: Final = "MERGE_SUMO_PORT"
GRACE_S: Final = 2.0
"""Time that a program has to end by itself before it is killed."""


def split_command(command: str) -> list[str]:
    """Return the arguments of a command line; `UserError` when its program is not there."""
    try:
        arguments = shlex.split(command)
    except ValueError as error:
        raise UserError(f"the command {command!r} cannot be read: {error}") from error
    if not arguments or shutil.which(arguments[0]) is None:
        raise UserError(
            f"the command {command!r}: there is no program {(arguments or [''])[0]!r}; write it as "
            "you would in a terminal"
        )
    return arguments


CODE_FOLLOWS: Final = ("-c", "-e", "-m")
"""Behind these an interpreter is given its code by name or as a text."""


def code_of(arguments: Sequence[str]) -> tuple[Path, ...]:
    """Return the files of a command that are code: others are what it reads and writes.

    These are its program and, where that is one that this machine has for all, as an interpreter,
    the first file behind it.
    """
    program, *others = arguments
    words = [program]
    if shutil.which(Path(program).name) is not None:
        options = itertools.takewhile(lambda word: word not in CODE_FOLLOWS, others)
        words += itertools.islice(filter(os.path.isfile, options), 1)
    return tuple(filter(Path.is_file, map(Path, words)))


class Program:
    """A running program in a process group of its own; what it prints goes to a log."""

    def __init__(self, arguments: list[str], port: int, log: Path | None, echo: Echo) -> None:
        """Start it, told the port as `{port}` in its arguments and by the environment.

        What it prints goes to `log`, or to `echo` where that is None.
        """
        try:
            self._process = subprocess.Popen(
                [argument.replace(PORT_FIELD, str(port)) for argument in arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                env={**os.environ, PORT_VARIABLE: str(port)},
                start_new_session=True,
            )
        except OSError as error:
            raise UserError(
                f"the command {arguments[0]!r} cannot be started: {error.strerror}"
            ) from error
        assert self._process.stdout is not None, "piped"  # noqa: S101
        self._output = Output(self._process.stdout, log, echo)
        self.process = self._process.pid
        """Id of its process, which is that of its session."""

    def ended(self, patience_s: float) -> str:
        """Return how it ended and the last line that it printed; "" when it still runs."""
        try:
            code = self._process.wait(patience_s)
        except subprocess.TimeoutExpired:
            return ""
        how = f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}"
        line = self._output.last_line()
        return f"the controller {how}" + (f": {line}" if line else "")

    def stop(self, grace_s: float) -> None:
        """End the program and what it started; it may end by itself for a while first."""
        try:
            self._process.wait(grace_s)
        except subprocess.TimeoutExpired:
            self._signal(signal.SIGTERM)
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(GRACE_S)
        finally:
            # The group, because a program may have started others that are left.
            self._signal(signal.SIGKILL)
            self._process.wait()
            self._output.close()

    def _signal(self, number: int) -> None:
        with suppress(ProcessLookupError, PermissionError):  # none may be left
            os.killpg(self._process.pid, number)
