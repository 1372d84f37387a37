"""The port at which TraCI clients connect: the controller's are served, and no others.

On Linux the kernel says to which user and process the other end of a connection on this machine
belongs. Elsewhere that cannot be known, and whoever comes first is served.
"""

from __future__ import annotations

import os
import socket
import struct
import sys
from collections.abc import Callable
from contextlib import suppress
from ipaddress import ip_address
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

    @property
    def port(self) -> int:
        """Number of the port."""
        return int(self._listener.getsockname()[1])

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
            if refusal:
                self._note(f"{refusal} connected to the port of the controller and was not served")
        return None

    def close(self) -> None:
        """Close it."""
        self._listener.close()


def _refusal(connection: socket.socket, peer: int | None) -> str | None:
    """Return whose a connection is that is not served; "" if unknown, None if it is served."""
    if not KNOWN_HERE:
        return None
    owner = owner_of(connection)
    if owner is None:
        return ""  # it is gone already
    user, inode = owner
    if user != os.geteuid():
        return f"a process of the user {user}"
    if peer is not None and not descends(inode, peer):
        return "a process that the command did not start"
    return None


def owner_of(connection: socket.socket) -> tuple[int, int] | None:
    """Return user and inode of the other end of a local connection; None where it is unknown."""
    ends = connection.getpeername()[:2], connection.getsockname()[:2]
    hosts = tuple(ip_address(host) for host, _ in ends)
    ports = tuple(f":{port:04X}" for _, port in ends)
    for table in ("tcp", "tcp6"):
        with suppress(OSError), Path("/proc/self/net", table).open() as lines:
            next(lines, "")
            for line in lines:
                _, local, remote, _, _, _, _, user, _, inode, *_ = line.split()
                # Ports first: the table may be long.
                if (local[-5:], remote[-5:]) != ports or inode == "0":
                    continue
                if (_host(local), _host(remote)) == hosts:
                    return int(user), int(inode)
    return None


def _host(text: str) -> object:
    """Return the host of an address in the kernel's tables: words in the order of the machine."""
    host = text.partition(":")[0]
    words = (int(host[at : at + 8], 16) for at in range(0, len(host), 8))
    address = ip_address(b"".join(struct.pack("=I", word) for word in words))
    return getattr(address, "ipv4_mapped", None) or address


def descends(inode: int, program: int) -> bool:
    """Return whether a program has a socket, or a process below it or of its session has it."""
    known: dict[int, tuple[int, int]] = {}  # parent and session
    for entry in os.listdir("/proc"):  # noqa: PTH208 (names alone, of many)
        if entry.isdecimal():
            with suppress(OSError, ValueError):
                stat = Path("/proc", entry, "stat").read_text(encoding="utf-8", errors="replace")
                _, parent, _, session, *_ = stat.rpartition(")")[2].split()
                known[int(entry)] = int(parent), int(session)

    def is_of_program(process: int) -> bool:
        for _ in known:  # a number that was given anew could make a circle
            if process == program:
                return True
            if process not in known:
                return False
            parent, session = known[process]
            process = program if session == program else parent
        return False

    return any(_has(process, inode) for process in known if is_of_program(process))


def _has(process: int, inode: int) -> bool:
    wanted = f"socket:[{inode}]"
    with suppress(OSError):
        for descriptor in Path(f"/proc/{process}/fd").iterdir():
            with suppress(OSError):
                if str(descriptor.readlink()) == wanted:
                    return True
    return False
