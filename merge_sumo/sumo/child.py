"""A SUMO in a process of its own, which this process alone reaches: it has no port.

The two exchange JSON over a pair of sockets of their own. A message to the child may hand over a
connection; messages of the child are read as data. On Windows no descriptor passes to another
process, and there is no such SUMO.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import struct
import subprocess
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from merge_sumo.errors import UserError
from merge_sumo.sumo.binding import sumo_environment
from merge_sumo.system.spawning import end_with, python_command

MESSAGES: Final = "messages"
"""In the folder of a child: what it, and SUMO, write to standard error."""
MOST_BYTES: Final = 1 << 24
_LENGTH: Final = struct.Struct("!I")


class ChildDiedError(Exception):
    """The process is gone; the text says how it ended, and `killed` whether by SIGKILL."""

    def __init__(self, how: str, *, killed: bool = False) -> None:
        super().__init__(how)
        self.killed = killed


class Channel:
    """Messages in JSON over one end of a pair of sockets."""

    def __init__(self, end: socket.socket) -> None:
        self.end = end

    def send(self, message: Mapping[str, Any]) -> None:
        """Send a message; OSError where the other is gone."""
        content = json.dumps(message).encode()
        self.end.sendall(_LENGTH.pack(len(content)) + content)

    def receive(self, patience_s: float | None = None) -> dict[str, Any]:
        """Return the next message; raises TimeoutError, EOFError, OSError, ValueError."""
        self.end.settimeout(patience_s)
        try:
            (length,) = _LENGTH.unpack(self._exactly(_LENGTH.size))
            if length > MOST_BYTES:
                raise ValueError("too long for a message")
            message = json.loads(self._exactly(length))
        finally:
            self.end.settimeout(None)
        if not isinstance(message, dict):
            raise ValueError("no message")
        return message

    def _exactly(self, count: int) -> bytes:
        content = self.end.recv(count)
        while len(content) < count:
            part = self.end.recv(count - len(content))
            if not part:
                raise EOFError
            content += part
        return content

    def give(self, connection: socket.socket) -> None:
        """Hand a connection over to the process at the other end, which waits for it."""
        socket.send_fds(self.end, [b"!"], [connection.fileno()])

    def take(self) -> socket.socket:
        """Return the connection that is handed over."""
        _, (descriptor, *_), _, _ = socket.recv_fds(self.end, 1, 1)
        return socket.socket(fileno=descriptor)


class SumoChild:
    """A process of this package with a SUMO, in a folder of its own.

    `main`, "MODULE:FUNCTION", is called there with settings that JSON can hold, and begins by
    `channel_of(settings)`. Raises `UserError` where it cannot be started.
    """

    def __init__(self, main: str, folder: Path, settings: Mapping[str, Any]) -> None:
        if os.name != "posix":
            raise UserError("a controller by TraCI and the live view need Linux or macOS")
        ours, theirs = socket.socketpair()
        self.channel = Channel(ours)
        self._folder = folder
        lifeline, self._lifeline = os.pipe()
        descriptors = (theirs.fileno(), lifeline)
        settings = {**settings, "descriptors": descriptors, "folder": str(folder)}
        try:
            with (folder / MESSAGES).open("wb") as messages:
                self.process = subprocess.Popen(  # noqa: S603 (our own code)
                    python_command(main, settings),
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=messages,
                    pass_fds=descriptors,
                    cwd=folder,
                    env=sumo_environment(),
                    # Ctrl-C in a terminal is heard by this process, which then ends the child.
                    start_new_session=True,
                )
        except OSError as error:
            ours.close()
            os.close(self._lifeline)
            raise UserError(f"cannot start a process for SUMO: {error.strerror}") from error
        finally:
            os.close(lifeline)
            theirs.close()

    def ask(
        self,
        message: Mapping[str, Any],
        patience_s: float | None = None,
        connection: socket.socket | None = None,
    ) -> dict[str, Any]:
        """Return the answer to a message, behind which a connection may be handed over.

        Raises `ChildDiedError` when the process is gone, and TimeoutError when it does not answer
        within `patience_s`.
        """
        try:
            self.channel.send(message)
            if connection is not None:
                self.channel.give(connection)
        except OSError as error:
            raise self._death() from error
        return self.receive(patience_s)

    def receive(self, patience_s: float | None) -> dict[str, Any]:
        """Return the next message of the child; raises as `ask` does."""
        try:
            return self.channel.receive(patience_s)
        except TimeoutError:
            raise
        except (OSError, EOFError, ValueError) as error:
            raise self._death() from error

    def kill(self) -> None:
        """End it, whatever it does."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self.channel.end.close()
        os.close(self._lifeline)

    def said(self) -> str:
        """Return the first line that it, or SUMO, wrote to standard error."""
        with suppress(OSError), (self._folder / MESSAGES).open("rb") as file:
            line = file.read(2000).decode("utf-8", errors="replace").strip().partition("\n")[0]
            return line.removeprefix("Error: ")
        return ""

    def _death(self) -> ChildDiedError:
        """Return its end as an error."""
        with suppress(subprocess.TimeoutExpired):
            code = self.process.wait(2.0)
            if code < 0:
                return ChildDiedError(
                    f"was ended by signal {-code}", killed=code == -signal.SIGKILL
                )
            return ChildDiedError(f"ended with exit code {code}")
        return ChildDiedError("broke the channel")


def channel_of(settings: Mapping[str, Any]) -> Channel:
    """Return the child's end of the channel; from now on the child ends with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    descriptor, lifeline = settings["descriptors"]
    end_with(lifeline)
    end = socket.socket(fileno=descriptor)
    return Channel(end)
