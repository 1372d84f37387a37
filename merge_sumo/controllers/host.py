"""The process that hosts a user's controller: what the controller breaks is this process alone.

`hosting.ControllerProcess` starts it and sends it requests.
"""

from __future__ import annotations

import os
import signal
import site
import sys
import sysconfig
from collections.abc import Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from time import perf_counter
from typing import Any, Final

from merge_sumo.controllers.controller import ControllerDriver
from merge_sumo.controllers.deadline import heartbeat, text_of
from merge_sumo.controllers.messages import HostReply, HostRequest, decode_request, encode, unpacked
from merge_sumo.controllers.process import connected
from merge_sumo.controllers.spec import ControllerKind, ControllerOptions
from merge_sumo.drivers.base import VutLostError
from merge_sumo.errors import UserError
from merge_sumo.spawning import named

ALIVE_S: Final = 0.25
"""Least time between two messages that a request proceeds."""


def main(settings: Mapping[str, Any]) -> None:
    """Host a controller until the connection ends."""
    sys.argv[1:] = []
    # What is printed shortly before a crash must not be lost in a buffer.
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    _default_signals()
    connection = connected(settings, RLIMIT_DATA=int(settings["memory_gib"] * 2**30))
    with suppress(EOFError):
        _Host(connection).serve()


class _Host:
    """A loaded controller, its driver, and the connection by which both are used."""

    def __init__(self, connection: Connection) -> None:
        self._connection, self._alive_s = connection, perf_counter()
        self._imported = set(sys.modules)
        self._kind: ControllerKind | None = None
        self._driver: ControllerDriver | None = None

    def serve(self) -> None:
        """Answer request by request."""
        heartbeat.append(self._beat)
        process, action = os.getpid(), ""
        while action != "close":
            request = decode_request(self._connection.recv_bytes())
            action = request.action
            try:
                answer = self._answer(request)
            except (UserError, VutLostError) as error:
                # Names of files may not be valid text.
                answer = HostReply(failed=str(error).encode(errors="backslashreplace").decode())
            except Exception as error:
                answer = HostReply(failed=f"{type(error).__name__}: {text_of(error)}")
            if os.getpid() != process:
                os._exit(0)  # the controller forked, and this is the copy
            self._connection.send_bytes(encode(answer))

    def _answer(self, request: HostRequest) -> HostReply:
        if request.action == "load" and request.spec is not None:
            options = ControllerOptions(deadline_s=request.deadline_s, in_process=True)
            self._kind = kind = named(request.kind)(request.spec, options)
            return HostReply(
                max_corridors=kind.max_corridors,
                max_workers=kind.max_workers,
                files=self._files(),
            )
        if request.action == "make" and self._kind is not None:
            driver = self._kind.driver(request.corridors, None)
            if not isinstance(driver, ControllerDriver):
                raise TypeError("a kind that is `hosted` has a ControllerDriver")
            self._driver = driver
            return HostReply(parameters=dict(driver.parameters()))
        if request.action == "act" and self._driver is not None:
            for corridor, start in request.starts:
                self._driver.reset(corridor, start)
            return HostReply.of(self._driver, unpacked(request.scene))
        if request.action == "close" and self._driver is not None:
            self._driver.close()
        return HostReply(files=self._files())

    def _beat(self, now_s: float) -> None:
        """Tell the other process, now and then, that one controller after the other is called."""
        if now_s - self._alive_s > ALIVE_S:
            self._alive_s = now_s
            self._connection.send_bytes(encode(None))

    def _files(self) -> list[bytes]:
        """Return the files of code that were loaded and belong to the user."""
        files = set(self._kind.code) if self._kind is not None else set[Path]()
        for name, module in list(sys.modules.items()):
            file = getattr(module, "__file__", None) if name not in self._imported else None
            if file and not str(Path(file).resolve()).startswith(_INSTALLED):
                files.add(Path(file))
        return sorted(os.fsencode(file.resolve()) for file in files if file.is_file())


def _installed() -> tuple[str, ...]:
    """Return the folders of the interpreter, of installed packages and of this package."""
    folders = [sys.prefix, sys.base_prefix, *site.getsitepackages(), site.getusersitepackages()]
    folders += [*sysconfig.get_paths().values(), str(Path(__file__).parents[1])]
    return tuple(f"{Path(folder).resolve()}{os.sep}" for folder in folders)


_INSTALLED: Final = _installed()


def _default_signals() -> None:
    """Handle signals as a program does that a user starts; workers do not, and pass that on."""
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # Python itself ignores these two.
    for number in signal.valid_signals() - {signal.SIGPIPE, signal.SIGXFSZ}:
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
