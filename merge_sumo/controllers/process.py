"""Processes of controllers: started, watched and stopped, with their output in a log."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import IO, Any

from merge_sumo.errors import ControllerError, UserError
from merge_sumo.files import ScratchFolder
from merge_sumo.limits import lower_limits
from merge_sumo.printable import printable
from merge_sumo.scenario.trajectory import as_reason
from merge_sumo.spawning import end_with, python_command

LOG = "controller.log"
"""Name of the log of a campaign, in its folder."""
MOST_BYTES = 4 << 20
"""A log that is longer begins again, as a controller may print for ever."""
LINES = 40
"""Number of last lines of a log in a report."""
ENDING_S = 2.0
"""Time for a process to end by itself."""


class Output:
    """Reads the output of a process until it ends, so that a full pipe never holds it up.

    Attributes:
        log: file to which the text is added; None shows it on standard error. A log that is set
            later also gets the text that was printed before.
        tail: the last bytes that were printed.
    """

    def __init__(self, pipe: IO[bytes], log: Path | None) -> None:
        """Read a pipe in a thread.

        Args:
            pipe: standard output and standard error of a process.
            log: file to which the text is added; None shows it.
        """
        self.log, self.tail = log, b""
        self._pipe, self._pending = pipe, b""
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def lines(self) -> list[str]:
        """Return the last lines that were printed, after a short wait for the end."""
        self.close()
        return self.tail.decode("utf-8", errors="replace").strip().splitlines()

    def last_line(self) -> str:
        """Return the last line that was printed; "" for none."""
        lines = self.lines()
        return as_reason(lines[-1]) if lines else ""

    def close(self) -> None:
        """Wait a second for the rest; what its child processes print later is lost."""
        self._thread.join(1.0)

    def _read(self) -> None:
        with self._pipe as pipe:
            while part := os.read(pipe.fileno(), 1 << 16):
                self.tail = (self.tail + part)[-2000:]
                self._pending = (self._pending + part)[-(1 << 16) :]
                if self.log is None:
                    sys.stderr.write(part.decode("utf-8", errors="replace"))
                self._keep()
        self._keep()

    def _keep(self) -> None:
        if self.log is not None and self._pending and self.log.parent.is_dir():
            with suppress(OSError):  # a full disk costs the text, not the campaign
                append(self.log, self._pending)
            self._pending = b""


def _is_writable_log(log: Path) -> bool:
    """Return whether a log is a file and no link, or does not exist yet."""
    return not log.is_symlink() and (log.is_file() or not log.exists())


def end_of(log: Path) -> str:
    """Return the last lines of a log, printable; "" without such a file.

    Args:
        log: the file.
    """
    text = b""
    with suppress(OSError):
        if _is_writable_log(log):
            with log.open("rb") as file:
                file.seek(max(log.stat().st_size - 8000, 0))
                text = file.read(8000)
    lines = text.decode("utf-8", errors="replace").splitlines()
    return "\n".join(map(printable, lines[-LINES:]))


def append(log: Path, content: bytes) -> None:
    """Add to a log, which begins again when it is long.

    Args:
        log: the file; a link, a pipe or a folder in its place is left alone.
        content: bytes to add.

    Raises:
        OSError: if it cannot be written.
    """
    if _is_writable_log(log):
        with log.open("ab", buffering=0) as file:
            if file.tell() > MOST_BYTES:
                file.truncate(0)
            file.write(content)


class LoggedProcess:
    """A process in a group of its own, with its output in a log.

    Attributes:
        output: its standard output and standard error.
    """

    def __init__(self, name: str, command: Sequence[str], log: Path | None, **more: Any) -> None:
        """Start a process.

        Args:
            name: its description, for an error message.
            command: its arguments.
            log: file to which its output is added; None shows it.
            **more: further arguments of `subprocess.Popen`.

        Raises:
            UserError: if it cannot be started.
        """
        try:
            # Ctrl-C in a terminal is for this process, which then ends the other.
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                **more,
            )
        except OSError as error:
            raise UserError(f"{name} cannot be started: {error.strerror}") from error
        assert self._process.stdout is not None  # noqa: S101 (piped)
        self.output = Output(self._process.stdout, log)

    def kill_group(self) -> None:
        """Kill the process and the processes that it started, and wait for its end."""
        self.signal(signal.SIGKILL)
        self._process.wait()
        self.output.close()

    def signal(self, number: int) -> None:
        """Send a signal to the process and to the processes that it started, if any is left.

        Args:
            number: the signal.
        """
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, number)


BROKEN = "broke the connection to its process"
"""The reason of a process that closes its connection, or sends an invalid reply."""


class ProcessDiedError(ControllerError):
    """The child process of a controller has ended.

    Its text is a phrase, as "took longer than 30 s".
    """


class ChildProcess(LoggedProcess):
    """A Python process that answers messages, and ends with this process.

    Attributes:
        alive: whether messages can be sent.
        folder: its folder for temporary files, which is removed when it ends; also in its settings.
    """

    alive = False

    def __init__(
        self,
        main: str,
        settings: Mapping[str, Any],
        environment: Mapping[str, str],
        log: Path | None,
    ) -> None:
        """Start a process.

        Args:
            main: "MODULE:FUNCTION" of this package; `parent_connection` gives it its connection.
            settings: argument of the function.
            environment: environment variables of the process.
            log: file to which its output is added; None shows it.

        Raises:
            UserError: if no process can be started.
        """
        self.folder = ScratchFolder()
        self._socket, theirs = socket.socketpair()
        their_lifeline, self._lifeline = os.pipe()
        inherited = {"lifeline": their_lifeline, "connection": theirs.fileno()}
        try:
            super().__init__(
                "a process for the VUT",
                python_command(main, {**settings, **inherited, "folder": self.folder.name}),
                log,
                pass_fds=tuple(inherited.values()),
                env={**environment, "TMPDIR": self.folder.name},
            )
        finally:
            theirs.close()
            os.close(their_lifeline)
        self.alive = True
        self._connection = Connection(os.dup(self._socket.fileno()))

    def send(self, content: bytes) -> None:
        """Send a message.

        Args:
            content: the message.

        Raises:
            ProcessDiedError: if the process ended.
        """
        try:
            self._connection.send_bytes(content)
        except OSError:
            raise self._died() from None

    def receive(self, patience_s: float, late: str) -> bytes:
        """Return the next message.

        Args:
            patience_s: time for it to come, and for each of its parts.
            late: the reason of the error if it does not come in time.

        Raises:
            ProcessDiedError: if it does not come in time or the process ended; it is then killed.
        """
        # Less than a microsecond would be for ever.
        seconds, rest_s = divmod(min(max(patience_s, 0.01), 1e9), 1.0)
        time = struct.pack("ll", int(seconds), int(1e6 * rest_s))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, time)
        try:
            return self._connection.recv_bytes(1 << 24)
        except BlockingIOError:
            if self._process.poll() is not None:
                raise self._died() from None
            self.kill()
            raise ProcessDiedError(late) from None
        except (EOFError, OSError):
            raise self._died() from None
        except BaseException:  # Ctrl-C, too: the answer is awaited no longer
            self.kill()
            raise

    def exit_code(self) -> int | None:
        """Return the exit code of the process after a short wait; None where it still runs."""
        with suppress(subprocess.TimeoutExpired):
            return self._process.wait(ENDING_S)
        return None

    def kill(self) -> None:
        """End the process, and the processes that it started."""
        if not self.alive:
            return  # its descriptors may belong to others by now
        self.alive = False
        self._connection.close()
        self._socket.close()
        os.close(self._lifeline)
        self.kill_group()
        self.folder.cleanup()

    def __del__(self) -> None:
        """End a process that nothing refers to."""
        self.kill()

    def _died(self) -> ProcessDiedError:
        """End the process; return how it ended."""
        code = self.exit_code()
        self.kill()
        if code is None:  # it closed the connection and still runs
            return ProcessDiedError(BROKEN)
        if code >= 0:
            return ProcessDiedError(f"its process ended with exit code {code}")
        try:
            name = signal.Signals(-code).name
        except ValueError:  # a real-time signal
            name = "unknown"
        return ProcessDiedError(f"its process was ended by signal {-code} ({name})")


def parent_connection(settings: Mapping[str, Any], **limits: int) -> Connection:
    """Return the connection of a process that a `ChildProcess` started, in that process.

    Args:
        settings: argument of its main function.
        **limits: limits of the system for this process, as RLIMIT_DATA.
    """
    lower_limits(**limits, RLIMIT_CORE=0)
    end_with(settings["lifeline"])
    inherited = settings["connection"]
    connection = Connection(os.dup(inherited))  # child processes do not inherit it
    os.close(inherited)
    return connection


def split_command(command: str) -> list[str]:
    """Return the arguments of a command line.

    Args:
        command: a command as in a terminal.

    Raises:
        UserError: if it cannot be read, or its program does not exist.
    """
    try:
        arguments = shlex.split(command)
    except ValueError as error:
        raise UserError(f"the command {command!r} cannot be read: {error}") from error
    program = arguments[0] if arguments else ""
    if shutil.which(program) is None:
        raise UserError(
            f"the command {command!r}: cannot find the program {program!r}; write the command as "
            "in a terminal"
        )
    return arguments


def code_of(arguments: Sequence[str]) -> tuple[Path, ...]:
    """Return the file of code that a command runs, or nothing where it is not known.

    It is the first file that is not a program of this machine, as an interpreter is. Other files
    may be data, which the command reads and writes.

    Args:
        arguments: the command.
    """
    for word in arguments:
        if word in ("-c", "-e", "-m"):  # the code follows by name or as a text
            break
        path = Path(word)
        if os.path.isfile(path) and shutil.which(path.name) is None:  # noqa: PTH113 (any text)
            return (path,)
    return ()


class Program(LoggedProcess):
    """A running program of the user's."""

    def __init__(self, arguments: list[str], port: int, log: Path | None) -> None:
        """Start it.

        Args:
            arguments: its command, in which `{port}` stands for the port.
            port: where it is to connect, also in MERGE_SUMO_PORT.
            log: file to which its output is added; None shows it.

        Raises:
            UserError: if it cannot be started.
        """
        command = [argument.replace("{port}", str(port)) for argument in arguments]
        environment = {**os.environ, "MERGE_SUMO_PORT": str(port)}
        super().__init__(f"the command {arguments[0]!r}", command, log, env=environment)

    def ended(self, patience_s: float) -> str:
        """Return how it ended and the last line that it printed; "" when it still runs.

        Args:
            patience_s: time to wait for its end.
        """
        try:
            code = self._process.wait(patience_s)
        except subprocess.TimeoutExpired:
            return ""
        how = f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}"
        line = self.output.last_line()
        return f"the controller {how}" + (f": {line}" if line else "")

    def stop(self, grace_s: float) -> None:
        """End the program and its child processes.

        Args:
            grace_s: time to end by itself first.
        """
        try:
            self._process.wait(grace_s)
        except subprocess.TimeoutExpired:
            self.signal(signal.SIGTERM)
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(ENDING_S)
        finally:
            self.kill_group()
