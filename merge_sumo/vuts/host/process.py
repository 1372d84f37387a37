"""The process that hosts a user's VUT: what the VUT does to its process, it does to this one.

It is started by `HostedVut` and answers its questions. Standard input and output belong to the
channel at first and are then given to the VUT as nothing and as its log.
"""

from __future__ import annotations

import mmap
import os
import signal
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

from merge_sumo.drivers.base import Driver, VutLostError
from merge_sumo.errors import UserError
from merge_sumo.system.limits import lower_limits
from merge_sumo.system.spawning import end_with
from merge_sumo.vuts.base import Vut, VutOptions, text_of
from merge_sumo.vuts.blame_cell import BlameCell, current_call
from merge_sumo.vuts.host import wire
from merge_sumo.vuts.host.file_audit import LoadedFiles
from merge_sumo.vuts.host.wire import About, Facts, Frame, Lost, Opening, Said
from merge_sumo.vuts.registry import KINDS


def main(settings: Mapping[str, Any]) -> None:
    """Host a VUT until the channel ends."""
    sys.argv[1:] = []
    hosting = _Hosting()
    _hear_signals()
    lower_limits(RLIMIT_DATA=int(settings["memory_gib"] * 2**30), RLIMIT_CORE=0)
    end_with(settings["lifeline"])
    current_call.share(mmap.mmap(settings["blame_cell"], BlameCell.FORMAT.size))
    hosting.serve()


class _Hosting:
    """A VUT and its driver, by the questions that the other process asks."""

    def __init__(self) -> None:
        self._in, self._out = os.dup(0), os.dup(1)
        nothing = os.open(os.devnull, os.O_RDONLY)
        os.dup2(nothing, 0)
        os.close(nothing)
        os.dup2(2, 1)
        # What is printed shortly before a crash must not be lost in a buffer.
        sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
        self._buffer = bytearray()
        self._process = os.getpid()
        self._vut: Vut | None = None
        self._driver: Driver | None = None

    def serve(self) -> None:
        """Answer question by question."""
        while (question := self._receive()) is not None:
            try:
                about, content = self._answer(question)
            except UserError as error:
                about, content = About.REFUSED, wire.to_json(str(error))
            except VutLostError as lost:
                why = Lost(lost.reason, lost.corridor, lost.final)
                about, content = About.LOST, wire.to_json(why)
            except Exception as error:
                sentence = f"{type(error).__name__}: {text_of(error)}"
                about, content = About.REFUSED, wire.to_json(sentence)
            if os.getpid() != self._process:
                os._exit(0)  # the VUT forked, and its child came back here
            wire.write(self._out, wire.frame(question.number, about, content))
            if question.about is About.CLOSE:
                return

    def _receive(self) -> Frame | None:
        """Return the next question; None when the other process is gone."""
        while (question := wire.take(self._buffer)) is None:
            part = os.read(self._in, 1 << 16)
            if not part:
                return None
            self._buffer += part
        return question

    def _answer(self, question: Frame) -> tuple[About, bytes]:
        if question.about is About.OPEN:
            return About.DONE, wire.to_json(self._open(wire.from_json(question.content, Opening)))
        if question.about is About.MAKE:
            assert self._vut is not None, "opened first"  # noqa: S101
            self._driver = self._vut.make(wire.from_json(question.content, int), None)
            return About.DONE, wire.to_json(dict(self._driver.parameters()))
        if question.about is About.FILES:
            return About.DONE, wire.to_json(self._files())
        assert self._driver is not None, "made first"  # noqa: S101
        if question.about is About.CLOSE:
            self._driver.close()
            return About.DONE, b""
        return About.DONE, self._act(self._driver, question.content)

    def _open(self, asked: Opening) -> Facts:
        options = VutOptions(deadline_s=asked.deadline_s, in_process=True)
        kind = KINDS[asked.spec.kind]
        self._loaded = LoadedFiles()
        self._vut = kind.prepare(asked.spec, options)
        files = self._files()
        data = sorted(set(files) - self._named() - self._loaded.code())
        return Facts(self._vut.max_corridors, self._vut.max_workers, files, data)

    def _files(self) -> list[str]:
        return sorted(self._named() | self._loaded.files())

    def _named(self) -> set[str]:
        assert self._vut is not None, "opened first"  # noqa: S101
        return {str(file.resolve()) for file in self._vut.files}

    def _act(self, driver: Driver, content: bytes) -> bytes:
        begun, scene = wire.unpack_scene(content)
        for corridor, case in begun:
            driver.begin(corridor, case)
        answers = driver.act(scene)
        wrong = np.flatnonzero(~np.isfinite(answers) & scene.active).tolist()
        reasons = {k: reason for k in wrong if (reason := driver.reason(k)) is not None}
        wishes = driver.wishes()
        told = None if wishes is None else wishes.tolist()
        return wire.pack_answers(answers, Said(reasons, dict(driver.signals()), told))


def _hear_signals() -> None:
    """Take signals as a program does that a person starts; a worker does not, and hands that on."""
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # Python itself ignores these two.
    for number in signal.valid_signals() - {signal.SIGPIPE, signal.SIGXFSZ}:
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
