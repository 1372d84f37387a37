"""Whose a connection is: a TraCI client is served where it is the controller's, and no other.

On Linux the kernel says to which user and process the other end of a connection on this machine
belongs. Elsewhere that cannot be known, and the token decides alone where one is asked for.
"""

from __future__ import annotations

import hmac
import os
import socket
import struct
import sys
from contextlib import suppress
from ipaddress import ip_address
from pathlib import Path
from typing import Final

from merge_sumo.vuts.traci import protocol as tp
from merge_sumo.vuts.traci.protocol import ProtocolError, Reader
from merge_sumo.vuts.traci.session import GET_VERSION, PARAMETER, SET_ORDER, version_answer

TOKEN_KEY: Final = "merge-sumo.token"  # noqa: S105 (its name)
"""`traci.simulation.setParameter("", "merge-sumo.token", TOKEN)` gives it."""
SET_SIMULATION: Final = 0xCB
MOST_BYTES: Final = 4096
"""What a connection may say before it has given the token."""
KNOWN_HERE: Final = sys.platform == "linux"
"""Whether the system says whose a connection is."""


def owner_of(connection: socket.socket) -> tuple[int, int] | None:
    """Return user and inode of the other end of a connection within this machine.

    None where it is gone, or where the system does not say.
    """
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
    found = ip_address(b"".join(struct.pack("=I", word) for word in words))
    return getattr(found, "ipv4_mapped", None) or found


def descends(inode: int, program: int) -> bool:
    """Return whether a process that a program started, or itself, has a socket.

    That is a process whose ancestor, or the leader of whose session, the program is.
    """
    parents, mine = _processes(program)
    for process in mine:
        if _has(process, inode):
            return True
    return any(
        _has(process, inode) for process in parents if _has_ancestor(process, program, parents)
    )


def _processes(session: int) -> tuple[dict[int, int], list[int]]:
    """Return the parents of all processes, and those of a session."""
    parents, mine = {}, []
    for entry in os.listdir("/proc"):  # noqa: PTH208 (names alone, of many)
        if not entry.isdecimal():
            continue
        with suppress(OSError, ValueError):
            stat = Path("/proc", entry, "stat").read_text(encoding="utf-8", errors="replace")
            _, parent, _, session_of, *_ = stat.rpartition(")")[2].split()
            parents[int(entry)] = int(parent)
            if int(session_of) == session:
                mine.append(int(entry))
    return parents, mine


def _has_ancestor(process: int, ancestor: int, parents: dict[int, int]) -> bool:
    seen: set[int] = set()
    while process in parents and process not in seen:
        if process == ancestor:
            return True
        seen.add(process)
        process = parents[process]
    return False


def _has(process: int, inode: int) -> bool:
    wanted = f"socket:[{inode}]"
    with suppress(OSError):
        for descriptor in Path(f"/proc/{process}/fd").iterdir():
            with suppress(OSError):
                if str(descriptor.readlink()) == wanted:
                    return True
    return False


class Stranger:
    """A connection that may still give the token; what it says is read as far as it came."""

    def __init__(self, connection: socket.socket, token: str) -> None:
        """Take a connection, and what it has to give."""
        connection.setblocking(False)
        self.connection, self._token = connection, token
        self._read, self._said = bytearray(), 0

    def gives_token(self) -> bool | None:
        """Return whether it gave the token; None while it may still do so.

        The question for the version and `setOrder` are answered before; all else is not.
        """
        try:
            part = self.connection.recv(MOST_BYTES)
        except BlockingIOError:
            return None
        except OSError:
            return False
        self._read += part
        self._said += len(part)
        if not part or self._said > MOST_BYTES:
            return False
        try:
            return self._look()
        except (ProtocolError, OSError):
            return False

    def _look(self) -> bool | None:
        while len(self._read) >= 4:
            length = tp.message_length(bytes(self._read[:4]))
            if len(self._read) < 4 + length:
                return None
            (command, *more) = tp.commands_of(bytes(self._read[4 : 4 + length]))
            del self._read[: 4 + length]
            answer = tp.status(command.identifier)
            if more:
                return False
            if command.identifier == GET_VERSION:
                answer += version_answer()
            elif command.identifier == SET_SIMULATION:
                if self._read or not self._is_token(Reader(command.payload)):
                    return False
                self.connection.send(tp.message(answer))
                self.connection.setblocking(True)
                return True
            elif command.identifier != SET_ORDER:
                return False
            self.connection.send(tp.message(answer))
        return None

    def _is_token(self, reader: Reader) -> bool:
        variable, _ = reader.ubyte(), reader.string()
        if variable != PARAMETER:
            return False
        values = reader.arguments()
        if len(values) != 2 or values[0] != TOKEN_KEY or not isinstance(values[1], str):
            return False
        return hmac.compare_digest(values[1].encode(), self._token.encode())
