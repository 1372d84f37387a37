"""The child process that runs a user's controller: its main function and its messages.

`hosted.py` is the side of the parent. A user's code runs here, so nothing is pickled: messages are
data of known types.
"""

from __future__ import annotations

import os
import signal
import site
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import msgspec
import numpy as np

from merge_sumo.controllers.controller import ControllerDriver, Start
from merge_sumo.controllers.deadline import Deadline, text_of
from merge_sumo.controllers.process import parent_connection
from merge_sumo.controllers.spec import ControllerKind, ControllerOptions, ControllerSpec
from merge_sumo.drivers.base import EpisodesLostError, Scene
from merge_sumo.errors import ControllerError, UserError
from merge_sumo.printable import printable
from merge_sumo.scenario.signals import StepSignals
from merge_sumo.spawning import named

ALIVE_S = 0.25
"""Least time between two messages to the parent that a request is still in progress."""
INSTALLED_FOLDERS = (
    *(sys.prefix, sys.base_prefix, site.getusersitepackages()),
    str(Path(__file__).parents[1]),
)
"""Code in these folders does not belong to the user."""


class HostRequest(msgspec.Struct, omit_defaults=True):
    """Make a driver, let it act, or close it.

    Attributes:
        action: the method of `_Host` that replies, without its underscore.
        corridors: number of corridors of the driver to make.
        starts: corridors in which an episode begins before the driver acts, with its start.
        scene: the scene in which the driver acts.
    """

    action: Literal["make", "act", "close"]
    corridors: int = 0
    starts: list[tuple[int, Start]] = []
    scene: Scene | None = None


class HostReply(msgspec.Struct, omit_defaults=True):
    """The reply to a request; the first one is sent when the controller is loaded.

    Attributes:
        failed: why the request failed; "" where it did not.
        is_finding: whether the code of the controller failed to load.
        max_corridors: corridors that one driver can serve; None for any number.
        files: all files of code that were loaded so far; empty if no module was loaded since the
            last reply.
        parameters: present values of the parameters of the driver that was made.
        accelerations_mps2: answers of the driver, (K,).
        merge_requests: its merge requests, (K,); None where it made none.
        reasons: errors of the controllers whose answer is not finite, by corridor.
        signals: signals of the answers, by corridor.
    """

    failed: str = ""
    is_finding: bool = False
    max_corridors: int | None = None
    files: list[bytes] = []
    parameters: dict[str, float] = {}
    accelerations_mps2: list[float] = []
    merge_requests: list[Literal[-1, 0, 1]] | None = None
    reasons: dict[int, str] = {}
    signals: dict[int, StepSignals] = {}


encode = msgspec.msgpack.Encoder(enc_hook=np.ndarray.tolist).encode
decode_request = msgspec.msgpack.Decoder(
    HostRequest, dec_hook=lambda _, rows: np.array(rows)
).decode
decode_reply = msgspec.msgpack.Decoder(HostReply | None).decode
"""A reply of None says that the request is still in progress."""


def main(settings: Mapping[str, Any]) -> None:
    """Host a controller until the connection ends.

    Args:
        settings: those of `ControllerProcess`, with the kind, the spec and the limits.
    """
    sys.argv[1:] = []
    # Output shortly before a crash must not be lost in a buffer.
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    # Workers block Ctrl-C, and processes that they start inherit it.
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    signal.signal(signal.SIGINT, signal.default_int_handler)
    connection = parent_connection(settings, RLIMIT_DATA=int(settings["memory_gib"] * 2**30))
    with suppress(EOFError):
        _Host(connection, settings).serve()


class _Host:
    """A loaded controller, its driver, and the connection by which both are used."""

    _kind: ControllerKind
    _driver: ControllerDriver

    def __init__(self, connection: Connection, settings: Mapping[str, Any]) -> None:
        self._connection, self._settings = connection, settings
        self._alive_s = perf_counter()
        self._imported, self._modules = set(sys.modules), 0

    def serve(self) -> None:
        """Load the controller, then answer request by request."""
        Deadline.before_call = self._beat
        self._answer(self._load)
        is_open = True
        while is_open:
            request = decode_request(self._connection.recv_bytes())
            self._answer(partial(getattr(self, f"_{request.action}"), request))
            is_open = request.action != "close"

    def _answer(self, action: Callable[[], HostReply]) -> None:
        process = os.getpid()
        try:
            reply = action()
        except (UserError, EpisodesLostError) as error:
            failed = printable(str(error))  # names of files may not be valid text
            reply = HostReply(failed=failed, is_finding=isinstance(error, ControllerError))
        except Exception as error:
            reply = HostReply(failed=f"{type(error).__name__}: {text_of(error)}")
        if os.getpid() != process:
            os._exit(0)  # the controller forked, and this is the copy
        self._connection.send_bytes(encode(reply))

    def _load(self) -> HostReply:
        settings = self._settings
        spec = msgspec.convert(settings["spec"], ControllerSpec)
        options = ControllerOptions(deadline_s=settings["deadline_s"])
        self._kind = kind = named(settings["kind"])(spec, options)
        return HostReply(max_corridors=kind.max_corridors, files=self._files())

    def _make(self, request: HostRequest) -> HostReply:
        driver = self._kind.driver(request.corridors, None)
        if not isinstance(driver, ControllerDriver):
            raise TypeError("a kind that is `hosted` has a ControllerDriver")
        self._driver = driver
        return HostReply(parameters=dict(driver.parameters()))

    def _act(self, request: HostRequest) -> HostReply:
        driver, scene = self._driver, request.scene
        assert scene is not None, "of each such request"  # noqa: S101
        for corridor, start in request.starts:
            driver.reset(corridor, start)
        answers, merge_requests = driver.act(scene), driver.merge_requests()
        reasons = {}
        for corridor in np.flatnonzero(~np.isfinite(answers) & scene.active).tolist():
            if (reason := driver.reason(corridor)) is not None:
                reasons[corridor] = reason
        return HostReply(
            accelerations_mps2=answers.tolist(),
            merge_requests=None if merge_requests is None else merge_requests.tolist(),
            reasons=reasons,
            signals=dict(driver.signals()),
            files=self._files(),
        )

    def _close(self, _request: HostRequest) -> HostReply:
        self._driver.close()
        return HostReply()

    def _beat(self, now_s: float) -> None:
        """Tell the parent from time to time that one controller after the other is called."""
        if now_s - self._alive_s > ALIVE_S:
            self._alive_s = now_s
            self._connection.send_bytes(encode(None))

    def _files(self) -> list[bytes]:
        """Return the files of code that belong to the user; none if no module was loaded since."""
        if len(sys.modules) == self._modules:
            return []
        self._modules, files = len(sys.modules), set(self._kind.code)
        for name, module in list(sys.modules.items()):
            file = getattr(module, "__file__", None)
            if file and name not in self._imported:
                path = Path(file).resolve()
                if path.is_file() and not any(map(path.is_relative_to, INSTALLED_FOLDERS)):
                    files.add(path)
        return sorted(map(os.fsencode, files))
