"""The process that hosts a user's controller: the controller can break this process alone.

`hosting.ControllerProcess` starts it and sends it requests. Each has one reply; while a request
takes long, a reply of None says that it proceeds. Nothing is pickled: a user's code runs here, so
the messages are data of known types.
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
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from merge_sumo.controllers.controller import ControllerDriver, Start
from merge_sumo.controllers.deadline import heartbeat, text_of
from merge_sumo.controllers.process import connected
from merge_sumo.controllers.spec import ControllerKind, ControllerOptions, ControllerSpec
from merge_sumo.drivers.base import MERGE, NO_WISH, STAY, Scene, VutLostError
from merge_sumo.errors import UserError
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.signals import Left
from merge_sumo.spawning import named

ALIVE_S = 0.25
"""Least time between two messages that a request proceeds."""


class HostRequest(msgspec.Struct, omit_defaults=True):
    """Load a controller, make its drivers, let them act, list its files, or close them.

    Attributes:
        action: what to do.
        kind: "MODULE:CLASS" of the kind of the controller to load.
        spec: the controller to load.
        deadline_s: time for one call of it.
        corridors: number of corridors to make drivers for.
        starts: episodes that begin before the drivers act, by corridor.
        scene: arrays of the scene in which they act.
    """

    action: Literal["load", "make", "act", "files", "close"]
    kind: str = ""
    spec: ControllerSpec | None = None
    deadline_s: float = 0.0
    corridors: int = 0
    starts: list[tuple[int, Start]] = []
    scene: tuple[bytes | None, ...] = ()


class HostReply(msgspec.Struct, omit_defaults=True):
    """The answer to a request.

    Attributes:
        failed: why the request failed; "" where it did not.
        max_corridors: corridors that one driver can serve.
        max_workers: processes that can have a driver.
        files: files of code that were loaded so far.
        parameters: those of the controllers that were made.
        accelerations_mps2: answers of the drivers.
        wishes: whether they wish to merge.
        reasons: the errors of answers, by corridor.
        signals: signals of the answers, by corridor.
    """

    failed: str = ""
    max_corridors: int | None = None
    max_workers: int | None = None
    files: list[bytes] = []
    parameters: dict[str, float] = {}
    accelerations_mps2: bytes = b""
    wishes: bytes | None = None
    reasons: dict[int, str] = {}
    signals: dict[int, Left] = {}

    @classmethod
    def of(cls, driver: ControllerDriver, scene: Scene) -> HostReply:
        """Return the answer of a driver to a scene."""
        answers, reasons = driver.act(scene), dict[int, str]()
        for corridor in np.flatnonzero(~np.isfinite(answers) & scene.active).tolist():
            if (reason := driver.reason(corridor)) is not None:
                reasons[corridor] = reason
        wishes = driver.wishes()
        return cls(
            accelerations_mps2=answers.tobytes(),
            wishes=None if wishes is None else wishes.astype(np.int8).tobytes(),
            reasons=reasons,
            signals=dict(driver.signals()),
        )

    def numbers(self, corridors: int) -> tuple[FloatArray, NDArray[np.int8] | None]:
        """Return accelerations and wishes, (K,); ValueError for what no driver answers."""
        answers = np.frombuffer(self.accelerations_mps2, np.float64)
        wishes = None if self.wishes is None else np.frombuffer(self.wishes, np.int8)
        if len(answers) != corridors or (wishes is not None and len(wishes) != corridors):
            raise ValueError("an answer has the numbers of other corridors")
        if wishes is not None and not np.isin(wishes, (NO_WISH, STAY, MERGE)).all():
            raise ValueError("an answer has a number that is not a wish")
        return answers, wishes


_DTYPES = (np.bool_, np.int64, np.float64, np.float64, np.int64, np.bool_)
"""Of the arrays of a `Scene`."""


def packed(scene: Scene) -> tuple[bytes | None, ...]:
    """Return the arrays of a scene as bytes."""
    contents: list[bytes | None] = []
    for array, dtype in zip(scene, _DTYPES, strict=True):
        contents.append(None if array is None else np.ascontiguousarray(array, dtype).tobytes())
    return tuple(contents)


def unpacked(contents: tuple[bytes | None, ...]) -> Scene:
    """Return the scene of arrays as bytes."""
    arrays: list[Any] = []
    for content, dtype in zip(contents, _DTYPES, strict=True):
        arrays.append(None if content is None else np.frombuffer(content, dtype))
    active, step, x_m, v_mps, facing, merged = arrays
    shape = -1, len(active)
    return Scene(active, step, x_m.reshape(shape), v_mps.reshape(shape), facing, merged)


encode = msgspec.msgpack.Encoder().encode
decode_request = msgspec.msgpack.Decoder(HostRequest).decode
decode_answer = msgspec.msgpack.Decoder(HostReply | None).decode


def main(settings: Mapping[str, Any]) -> None:
    """Host a controller until the connection ends."""
    sys.argv[1:] = []
    # Output shortly before a crash must not be lost in a buffer.
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


_INSTALLED = _installed()


def _default_signals() -> None:
    """Handle signals as a program does that a user starts; workers do not, and pass that on."""
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # Python itself ignores these two.
    for number in signal.valid_signals() - {signal.SIGPIPE, signal.SIGXFSZ}:
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
