"""The port at which TraCI clients connect: the controller's are served, and no others.

On Linux the kernel says to which user and process the other end of a connection on this machine
belongs. Elsewhere that cannot be known, and whoever comes first is served.
"""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from time import monotonic
from typing import Final

from merge_sumo.errors import UserError

HOST: Final = "127.0.0.1"
BACKLOG: Final = 128
KNOWN_HERE: Final = sys.platform == "linux"
"""Whether the system says whose a connection is."""


class Door:
    """A listening socket on the loopback interface.

    The `peer` of its methods is the process that is served, with those that it has started; None
    is any process of this user.
    """

    def __init__(self, port: int, note: Callable[[str], None]) -> None:
        """Listen on a port, 0 for any; `note` is told in a sentence of each refused connection.

        Raises `UserError` where the port cannot be listened on.
        """
        self._listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._listener.bind((HOST, port))
            self._listener.listen(BACKLOG)
        except OSError as error:
            self._listener.close()
            raise UserError(
                f"cannot listen on {HOST}:{port} ({error.strerror}): choose another port, "
                "traci:PORT"
            ) from error
        self._note = note
        self.port = int(self._listener.getsockname()[1])

    def accept(self, peer: int | None, patience_s: float) -> socket.socket | None:
        """Return a connection that is to be served; None where none came within `patience_s`."""
        until = monotonic() + patience_s
        while (left_s := until - monotonic()) > 0.0:
            self._listener.settimeout(left_s)
            try:
                connection = self._listener.accept()[0]
            except OSError:
                continue
            refusal = _refusal(connection, peer)
            if refusal is None:
                connection.settimeout(None)
                return connection
            connection.close()
            self._note(f"{refusal} connected to the port of the controller and was not served")
        return None

    def close(self) -> None:
        """Close it."""
        self._listener.close()


def _refusal(connection: socket.socket, peer: int | None) -> str | None:
    """Return whose a connection is that is not served; None if it is served."""
    if not KNOWN_HERE:
        return None
    owner = owner_of(connection)
    if owner is None:
        return "a process that is gone"
    user, inode = owner
    if user != os.geteuid():
        return f"a process of the user {user}"
    if peer is not None and not descends(inode, peer):
        return "a process that the command did not start"
    return None


def owner_of(connection: socket.socket) -> tuple[int, int] | None:
    """Return user and inode of the other end of a local connection; None where it is unknown."""
    client, server = (
        (f"{int.from_bytes(socket.inet_aton(host), sys.byteorder):08X}", f":{port:04X}")
        for host, port in (connection.getpeername(), connection.getsockname())
    )
    for table, mapped in (("tcp", ""), ("tcp6", f"{0:016X}{socket.htonl(0xFFFF):08X}")):
        ends = tuple(f"{mapped}{host}{port}" for host, port in (client, server))
        with suppress(OSError), Path("/proc/self/net", table).open() as lines:
            next(lines, "")
            for line in lines:
                _, local, remote, _, _, _, _, user, _, inode, *_ = line.split()
                if (local, remote) == ends and inode != "0":
                    return int(user), int(inode)
    return None


def descends(inode: int, program: int) -> bool:
    """Return whether a program has a socket, or a process below it or of its session has it."""
    known: dict[int, tuple[int, int]] = {}  # parent and session
    owners: list[int] = []
    for pid in filter(str.isdecimal, os.listdir("/proc")):  # noqa: PTH208 (names alone, of many)
        with suppress(OSError, ValueError):
            stat = Path("/proc", pid, "stat").read_text(encoding="utf-8", errors="replace")
            _, parent, _, session, *_ = stat.rpartition(")")[2].split()
            known[int(pid)] = int(parent), int(session)
    for process in known:
        with suppress(OSError):
            for descriptor in Path(f"/proc/{process}/fd").iterdir():
                with suppress(OSError):
                    if str(descriptor.readlink()) == f"socket:[{inode}]":
                        owners.append(process)
    for owner in owners:
        above = owner
        for _ in known:  # a number that was given anew could make a circle
            if program in (above, known.get(above, (0, 0))[1]):
                return True
            above, _ = known.get(above, (0, 0))
    return False
