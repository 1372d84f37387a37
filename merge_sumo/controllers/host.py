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

import msgspec

from merge_sumo.controllers.base import ControllerKind, VutOptions, VutSpec
from merge_sumo.controllers.controller import ControllerDriver
from merge_sumo.controllers.deadline import heartbeat, text_of
from merge_sumo.controllers.messages import (
    Act,
    Acted,
    Alive,
    Close,
    Failed,
    Loaded,
    Made,
    Make,
    Message,
    Ready,
    decode_request,
    encode,
    unpacked,
)
from merge_sumo.controllers.registry import KINDS
from merge_sumo.drivers.base import VutLostError
from merge_sumo.errors import UserError
from merge_sumo.limits import lower_limits
from merge_sumo.spawning import end_with

ALIVE_S: Final = 0.25
"""Least time between two `Alive`."""


def main(settings: Mapping[str, Any]) -> None:
    """Host a controller until the connection ends."""
    sys.argv[1:] = []
    # What is printed shortly before a crash must not be lost in a buffer.
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    _default_signals()
    lower_limits(RLIMIT_DATA=int(settings["memory_gib"] * 2**30), RLIMIT_CORE=0)
    end_with(settings["lifeline"])
    inherited = settings["connection"]
    connection = Connection(os.dup(inherited))  # not inherited by what the controller starts
    os.close(inherited)
    with suppress(EOFError):
        _Host(connection, settings).serve()


class _Host:
    """A loaded controller, its driver, and the connection by which both are used."""

    def __init__(self, connection: Connection, settings: Mapping[str, Any]) -> None:
        self._connection, self._settings = connection, settings
        self._process, self._alive_s = os.getpid(), perf_counter()
        self._imported = set(sys.modules)
        self._kind: ControllerKind | None = None
        self._driver: ControllerDriver | None = None
        heartbeat.append(self._beat)

    def serve(self) -> None:
        """Load the controller, then answer request by request."""
        request: Message | None = None
        while not isinstance(request, Close):
            try:
                answer = self._answer(request)
            except (UserError, VutLostError) as error:
                answer = Failed(str(error))
            except Exception as error:
                answer = Failed(f"{type(error).__name__}: {text_of(error)}")
            if os.getpid() != self._process:
                os._exit(0)  # the controller forked, and this is the copy
            self._connection.send_bytes(encode(_valid(answer)))
            request = decode_request(self._connection.recv_bytes())
        if self._driver is not None:
            self._driver.close()
        self._connection.send_bytes(encode(Loaded([])))

    def _answer(self, request: Message | None) -> Message:
        if request is None:
            spec = msgspec.convert(self._settings["spec"], VutSpec)
            options = VutOptions(deadline_s=self._settings["deadline_s"], in_process=True)
            self._kind = kind = KINDS[spec.kind](spec, options)
            return Ready(kind.max_corridors, kind.max_workers, self._files())
        if isinstance(request, Make) and self._kind is not None:
            driver = self._kind.driver(request.corridors, None)
            if not isinstance(driver, ControllerDriver):
                raise TypeError("a kind that is `hosted` has a ControllerDriver")
            self._driver = driver
            return Made(dict(driver.parameters()))
        if isinstance(request, Act) and self._driver is not None:
            for corridor, start in request.starts:
                self._driver.reset(corridor, start)
            return Acted.of(self._driver, unpacked(request.scene))
        return Loaded(self._files())

    def _beat(self, now_s: float) -> None:
        """Tell the other process, now and then, that one controller after the other is called."""
        if now_s - self._alive_s > ALIVE_S:
            self._alive_s = now_s
            self._connection.send_bytes(encode(Alive()))

    def _files(self) -> list[bytes]:
        """Return the files of code that were loaded and belong to the user."""
        files = set(self._kind.files) if self._kind is not None else set[Path]()
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


def _valid(answer: Message) -> Message:
    """Return an answer whose reason can be sent: names of files may not be valid text."""
    if isinstance(answer, Failed):
        return Failed(answer.reason.encode(errors="backslashreplace").decode())
    return answer


def _default_signals() -> None:
    """Handle signals as a program does that a user starts; workers do not, and pass that on."""
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # Python itself ignores these two.
    for number in signal.valid_signals() - {signal.SIGPIPE, signal.SIGXFSZ}:
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
