"""The port at which TraCI clients come in: who is the controller's is served, nobody else."""

from __future__ import annotations

import os
import selectors
import socket
from collections.abc import Callable
from contextlib import suppress
from time import monotonic
from typing import Final, NamedTuple

from merge_sumo.errors import UserError
from merge_sumo.vuts.process import TOKEN_VARIABLE
from merge_sumo.vuts.traci.peer import (
    KNOWN_HERE,
    Stranger,
    descends,
    owner_of,
)

HOST: Final = "127.0.0.1"
MOST_STRANGERS: Final = 16
"""Connections that may still give a token; the oldest goes where there are more."""
STRANGER_S: Final = 10.0
"""Time in which a connection has to give it."""
BACKLOG: Final = 128


class Peer(NamedTuple):
    """Who is served.

    Attributes:
        program: id of the process whose connections are served; None for all of this user.
        token: what shows that another connection is to be served, too; without a program, what
            every one has to give. None for no token.
    """

    program: int | None
    token: str | None


class Door:
    """A listening socket on the loopback interface, and those who have not said who they are."""

    def __init__(self, port: int, note: Callable[[str], None]) -> None:
        """Listen; `UserError` where that cannot be. `note` is told what is refused."""
        self._listener = _listen(port)
        self._note = note
        self._strangers: dict[Stranger, float] = {}
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self.refused = ""
        """Whose connections were refused last."""

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._listener.getsockname()[1])

    def accept(self, peer: Peer, patience_s: float) -> socket.socket | None:
        """Return a connection that is to be served; None where none came in a while."""
        until = monotonic() + patience_s
        while True:
            for key, _ in self._selector.select(max(until - monotonic(), 0.0)):
                found = self._come(peer) if key.fileobj is self._listener else self._heard(key.data)
                if found is not None:
                    return found
            self._forget(lambda since_s: monotonic() - since_s > STRANGER_S)
            if monotonic() >= until:
                return None

    def another_waits(self, peer: Peer) -> bool:
        """Return whether a client that would be served has connected besides the one that is."""
        with suppress(OSError):
            self._listener.settimeout(0.0)
            while True:
                connection = self._listener.accept()[0]
                with connection:
                    if _is_served(connection, peer) is None:
                        return True
        return False

    def close(self) -> None:
        """Close it, and who waits at it."""
        self._forget(lambda _: True)
        self._selector.close()
        self._listener.close()

    def _come(self, peer: Peer) -> socket.socket | None:
        """Take the next connection; return it where it is to be served as it is."""
        try:
            self._listener.settimeout(0.0)
            connection = self._listener.accept()[0]
        except OSError:
            return None
        connection.settimeout(None)
        why = _is_served(connection, peer)
        if why is None:
            return connection
        if why:
            self._refuse(why)
        if peer.token is None:
            connection.close()
            return None
        if len(self._strangers) >= MOST_STRANGERS:
            oldest = min(self._strangers.values())
            self._forget(lambda since_s: since_s == oldest)
        stranger = Stranger(connection, peer.token)
        self._strangers[stranger] = monotonic()
        self._selector.register(connection, selectors.EVENT_READ, stranger)
        return None

    def _heard(self, stranger: Stranger) -> socket.socket | None:
        """Hear what a connection says; return it where it is to be served after all."""
        if stranger not in self._strangers:
            return None
        proved = stranger.gives_token()
        if proved is None:
            return None
        del self._strangers[stranger]
        self._selector.unregister(stranger.connection)
        if proved:
            return stranger.connection
        stranger.connection.close()
        return None

    def _refuse(self, why: str) -> None:
        self.refused = f"{why} did"
        self._note(
            f"{why} connected to the port of the controller and was not served; a client in "
            f"another place gives the token in {TOKEN_VARIABLE}"
        )

    def _forget(self, due: Callable[[float], bool]) -> None:
        for stranger, since_s in list(self._strangers.items()):
            if due(since_s):
                del self._strangers[stranger]
                self._selector.unregister(stranger.connection)
                stranger.connection.close()


def _is_served(connection: socket.socket, peer: Peer) -> str | None:
    """Return None for a connection that is served as it is, else why it is not; "" for no word."""
    if peer.program is None and peer.token is not None:
        return ""  # who gives the token is served
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


def _listen(port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((HOST, port))
        listener.listen(BACKLOG)
    except OSError as error:
        listener.close()
        raise UserError(
            f"cannot listen on {HOST}:{port} ({error.strerror}): choose another port by "
            "--vut traci:PORT"
        ) from error
    return listener
