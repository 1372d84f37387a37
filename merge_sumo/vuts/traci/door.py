"""The port at which TraCI clients connect: the controller's are served, and no others.

On Linux the kernel says to which user and process the other end of a connection on this machine
belongs. Elsewhere that cannot be known, and a token decides alone where one is asked for.
"""

from __future__ import annotations

import hmac
import os
import selectors
import socket
import struct
import sys
from collections.abc import Callable
from contextlib import suppress
from ipaddress import ip_address
from itertools import chain
from pathlib import Path
from time import monotonic
from typing import Final, NamedTuple

from merge_sumo.errors import UserError
from merge_sumo.vuts.process import TOKEN_VARIABLE
from merge_sumo.vuts.traci import protocol as tp
from merge_sumo.vuts.traci.protocol import ProtocolError, Reader

HOST: Final = "127.0.0.1"
BACKLOG: Final = 128
KNOWN_HERE: Final = sys.platform == "linux"
"""Whether the system says whose a connection is."""
TOKEN_KEY: Final = "merge-sumo.token"  # noqa: S105 (its name)
"""`traci.simulation.setParameter("", "merge-sumo.token", TOKEN)` gives it."""
MOST_BYTES: Final = 4096
"""What a connection may send before it has given the token."""
MOST_STRANGERS: Final = 16
"""Connections that may still give a token; the oldest goes where more come."""
STRANGER_S: Final = 10.0
"""Time in which a connection has to give it."""


class Peer(NamedTuple):
    """The process whose connections are served."""

    program: int | None
    """Its id; None for all processes of this user."""
    token: str | None
    """What shows that another connection is to be served, too; without a program, what every one
    has to give."""


class Door:
    """A listening socket on the loopback interface, and connections that may give a token."""

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
                f"cannot listen on {HOST}:{port} ({error.strerror}): choose another port by "
                "--vut traci:PORT"
            ) from error
        self._note = note
        self._strangers: dict[Stranger, float] = {}
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self.refused = ""
        """Whose connections were refused last."""

    @property
    def port(self) -> int:
        """Number of the port."""
        return int(self._listener.getsockname()[1])

    def accept(self, peer: Peer, patience_s: float) -> socket.socket | None:
        """Return a connection that is to be served; None where none came within `patience_s`."""
        until = monotonic() + patience_s
        while True:
            for key, _ in self._selector.select(max(until - monotonic(), 0.0)):
                is_new = key.fileobj is self._listener
                connection = self._next(peer) if is_new else self._proved(key.data)
                if connection is not None:
                    return connection
            self._drop(lambda since_s: monotonic() - since_s > STRANGER_S)
            if monotonic() >= until:
                return None

    def another_waits(self, peer: Peer) -> bool:
        """Return whether a client that would be served has connected besides the one that is."""
        with suppress(OSError):
            self._listener.settimeout(0.0)
            while True:
                connection = self._listener.accept()[0]
                with connection:
                    if _refusal(connection, peer) is None:
                        return True
        return False

    def close(self) -> None:
        """Close it, and the connections that wait at it."""
        self._drop(lambda _: True)
        self._selector.close()
        self._listener.close()

    def _next(self, peer: Peer) -> socket.socket | None:
        """Take the next connection; return it where it is to be served as it is."""
        try:
            self._listener.settimeout(0.0)
            connection = self._listener.accept()[0]
        except OSError:
            return None
        connection.settimeout(None)
        refusal = _refusal(connection, peer)
        if refusal is None:
            return connection
        if refusal:
            self.refused = f"{refusal} did"
            self._note(
                f"{refusal} connected to the port of the controller and was not served; a client "
                f"in another place gives the token in {TOKEN_VARIABLE}"
            )
        if peer.token is None:
            connection.close()
            return None
        if len(self._strangers) >= MOST_STRANGERS:
            oldest = min(self._strangers.values())
            self._drop(lambda since_s: since_s == oldest)
        stranger = Stranger(connection, peer.token)
        self._strangers[stranger] = monotonic()
        self._selector.register(connection, selectors.EVENT_READ, stranger)
        return None

    def _proved(self, stranger: Stranger) -> socket.socket | None:
        """Read what a connection sends; return it where it has given the token."""
        proved = stranger.gives_token() if stranger in self._strangers else None
        if proved is None:
            return None
        del self._strangers[stranger]
        self._selector.unregister(stranger.connection)
        if proved:
            return stranger.connection
        stranger.connection.close()
        return None

    def _drop(self, due: Callable[[float], bool]) -> None:
        """Close the connections without token whose time of coming is due."""
        for stranger, since_s in list(self._strangers.items()):
            if due(since_s):
                del self._strangers[stranger]
                self._selector.unregister(stranger.connection)
                stranger.connection.close()


def _refusal(connection: socket.socket, peer: Peer) -> str | None:
    """Return whose a connection is that is not served as it is; "" if unknown, None if served."""
    if peer.program is None and peer.token is not None:
        return ""  # the token decides
    if not KNOWN_HERE:
        return None
    owner = owner_of(connection)
    if owner is None:
        return ""  # it is gone already
    user, inode = owner
    if user != os.geteuid():
        return f"a process of the user {user}"
    if peer.program is not None and not descends(inode, peer.program):
        return "a process that --vut-command did not start"
    return None


class Stranger:
    """A connection that may still give the token; what it sends is read as far as it came."""

    def __init__(self, connection: socket.socket, token: str) -> None:
        connection.setblocking(False)
        self.connection, self._token = connection, token
        self._unread, self._received_bytes = bytearray(), 0

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
        self._unread += part
        self._received_bytes += len(part)
        if not part or self._received_bytes > MOST_BYTES:
            return False
        try:
            return self._read_messages()
        except (ProtocolError, OSError):
            return False

    def _read_messages(self) -> bool | None:
        while len(self._unread) >= 4:
            end = 4 + tp.message_length(bytes(self._unread[:4]))
            if len(self._unread) < end:
                return None
            (command, *more) = tp.commands_of(bytes(self._unread[4:end]))
            del self._unread[:end]
            proves = command.identifier == tp.SET_SIMULATION
            if more or (proves and (self._unread or not self._is_token(Reader(command.payload)))):
                return False
            if not proves and command.identifier not in (tp.GET_VERSION, tp.SET_ORDER):
                return False
            answer = tp.status(command.identifier)
            if command.identifier == tp.GET_VERSION:
                answer += tp.version_answer()
            self.connection.send(tp.message(answer))
            if proves:
                self.connection.setblocking(True)
                return True
        return None

    def _is_token(self, reader: Reader) -> bool:
        variable, _ = reader.ubyte(), reader.string()
        if variable != tp.PARAMETER:
            return False
        values = reader.arguments()
        if len(values) != 2 or values[0] != TOKEN_KEY or not isinstance(values[1], str):
            return False
        return hmac.compare_digest(values[1].encode(), self._token.encode())


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
    parents, of_session = _processes(program)
    descendants = (process for process in parents if _has_ancestor(process, program, parents))
    # The session first: its processes are few.
    return any(_has(process, inode) for process in chain(of_session, descendants))


def _processes(session: int) -> tuple[dict[int, int], list[int]]:
    """Return the parents of all processes, and those of a session."""
    parents, of_session = {}, []
    for entry in os.listdir("/proc"):  # noqa: PTH208 (names alone, of many)
        if not entry.isdecimal():
            continue
        with suppress(OSError, ValueError):
            stat = Path("/proc", entry, "stat").read_text(encoding="utf-8", errors="replace")
            _, parent, _, its_session, *_ = stat.rpartition(")")[2].split()
            parents[int(entry)] = int(parent)
            if int(its_session) == session:
                of_session.append(int(entry))
    return parents, of_session


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
