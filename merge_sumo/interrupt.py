"""SIGINT and SIGTERM: the first finishes the running batch, the second stops at once.

After SIGTERM, systems send SIGKILL: the running batch has a few seconds to finish. Work without a
batch stops at the first signal, in good order.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Self

SIGNALS = (signal.SIGINT, signal.SIGTERM)
ENDING = ("SIGTERM", "SIGHUP")
"""SIGHUP comes when a terminal is closed; not every platform has it."""
STDERR = 2
PATIENCE_S = 5.0
"""Time in s after SIGTERM in which the running batch may end."""


class Stopped(BaseException):
    """A signal asked to stop. Not an `Exception`: no VUT that swallows errors swallows this."""

    def __init__(self, number: int) -> None:
        """Take the signal.

        Args:
            number: number of the signal.
        """
        super().__init__(signal.Signals(number).name)
        self.number = number

    @property
    def exit_code(self) -> int:
        """Exit code by the convention of shells: 130 for SIGINT, 143 for SIGTERM."""
        return 128 + self.number


class Interrupt:
    """Within `with`, signals are noted; to be used in the main thread.

    `check` raises `Stopped` after the first signal; the second raises it wherever the program is.
    """

    def __init__(self, note: str) -> None:
        """Prepare to note signals.

        Args:
            note: text to print at the first signal.
        """
        self._note = f"\n{note}\n".encode()
        self._number: int | None = None
        self._before: list[Any] = []
        self._again = threading.Timer(PATIENCE_S, os.kill, (os.getpid(), signal.SIGTERM))
        self._again.daemon = True

    def check(self) -> None:
        """Raise `Stopped` when a signal has come."""
        if self._number is not None:
            raise Stopped(self._number)

    def _handle(self, number: int, _: FrameType | None) -> None:
        if self._number is not None:
            raise Stopped(number)
        self._number = number
        # Not print: the signal may have come in the middle of one.
        os.write(STDERR, self._note)
        if number == signal.SIGTERM:
            self._again.start()

    def __enter__(self) -> Self:
        self._before = [signal.signal(number, self._handle) for number in SIGNALS]
        return self

    def __exit__(self, *_: object) -> None:
        self._again.cancel()
        for number, handler in zip(SIGNALS, self._before, strict=True):
            signal.signal(number, handler)


@contextmanager
def stopping_in_order() -> Iterator[None]:
    """Within `with`, a signal that would end this process raises `Stopped` instead.

    So open files and processes are closed first. SIGINT raises KeyboardInterrupt anyway. A signal
    that is ignored or has a handler keeps it. Outside of the main thread nothing is changed.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [
        number
        for name in ENDING
        if (number := getattr(signal, name, None)) is not None
        and signal.getsignal(number) is signal.SIG_DFL
    ]
    for number in numbers:
        signal.signal(number, _stop)
    try:
        yield
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)


def _stop(number: int, _: FrameType | None) -> None:
    raise Stopped(number)
