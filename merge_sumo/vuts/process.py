"""A controller that is a program of its own: started, watched and stopped."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import Final

from merge_sumo.errors import UserError
from merge_sumo.vuts.output import Output

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


class Program:
    """A running program in a process group of its own; what it prints goes to a log."""

    def __init__(self, arguments: list[str], port: int, log: Path | None = None) -> None:
        """Start it, told the port as `{port}` in its arguments and by the environment."""
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
        self._output = Output(self._process.stdout, log)

    @property
    def process(self) -> int:
        """Id of its process, which is that of its session."""
        return self._process.pid

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
            self._signal(signal.SIGKILL if hasattr(signal, "SIGKILL") else signal.SIGTERM)
            self._process.wait()
            self._output.close()

    def _signal(self, number: int) -> None:
        with suppress(ProcessLookupError, PermissionError):  # none may be left
            if hasattr(os, "killpg"):
                os.killpg(self._process.pid, number)
            else:
                self._process.send_signal(number)
