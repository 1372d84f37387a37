"""The time limit of calls to a controller, and the words for their errors."""

from __future__ import annotations

import math
import signal
import sys
import threading
from bdb import BdbQuit
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from time import perf_counter
from types import FrameType, TracebackType
from typing import Any, ClassVar, Self

from merge_sumo.interrupt import Stopped
from merge_sumo.scenario.trajectory import as_reason


class DeadlineExceeded(BaseException):
    """A call took too long; no `Exception`, so that a controller does not catch it by habit."""


RING_AFTER = 1.02
"""The timer rings at this share of the deadline, when the call is certainly late."""
MOST_CHARACTERS = 300
"""Maximum length of a text that comes from a controller."""


class Deadline:
    """Ends calls to a controller that take longer than the deadline.

    While it is entered, a timer in the main thread interrupts a late call, and the output of
    the controller goes to standard error. Native code is not interrupted, and neither is a call in
    another thread or on Windows: such a call counts as late when it returns. The parent of a child
    process kills it where it does not return (`hosted.GRACE_S`).

    Example:
        ```python
        with Deadline(1.0) as deadline:
            deadline.start()
            answer = controller.act(seen)
            deadline.stop()
        ```

    Attributes:
        deadline_s: time for a call.
        before_call: called with the present time in s before each call; None but in the child
            process of a controller. Where it is set, a KeyboardInterrupt is a fault of the
            controller, and not an interruption by the user.
    """

    before_call: ClassVar[Callable[[float], None] | None] = None

    def __init__(self, deadline_s: float) -> None:
        """Time no call yet.

        Args:
            deadline_s: time for a call.
        """
        self.deadline_s, self._since_s = deadline_s, math.inf
        self._is_timed = False

    def __enter__(self) -> Self:
        self._stdout, sys.stdout = sys.stdout, sys.stderr
        is_main = threading.current_thread() is threading.main_thread()
        self._is_timed = is_main and hasattr(signal, "setitimer")
        if self._is_timed:
            self._handler = signal.signal(signal.SIGALRM, self._ring)
            self._timer = signal.setitimer(signal.ITIMER_REAL, 0.0)
        return self

    def __exit__(self, *_: object) -> None:
        self._since_s = math.inf
        if self._is_timed:
            signal.setitimer(signal.ITIMER_REAL, *self._timer)
            signal.signal(signal.SIGALRM, self._handler)
        sys.stdout = self._stdout

    def start(self) -> None:
        """Begin the time of a call."""
        if self._is_timed:
            # Set again for each call: an early ring would cut short a call that waits in C.
            first_s = RING_AFTER * self.deadline_s
            signal.setitimer(signal.ITIMER_REAL, first_s, self.deadline_s / 10)
        now_s = perf_counter()
        if Deadline.before_call is not None:
            Deadline.before_call(now_s)
        self._since_s = now_s

    def stop(self) -> None:
        """End the time of a call.

        Raises:
            DeadlineExceeded: if it took too long.
        """
        spent_s, self._since_s = perf_counter() - self._since_s, math.inf
        if spent_s > self.deadline_s:
            raise DeadlineExceeded

    def reason(self, error: BaseException) -> str:
        """Return the error of a call in words, with file and line; Ctrl-C is raised again.

        Args:
            error: the error that the call raised.
        """
        self._since_s = math.inf
        if isinstance(error, (Stopped, KeyboardInterrupt)) and Deadline.before_call is None:
            raise error
        if isinstance(error, DeadlineExceeded):
            return f"took longer than the deadline of {self.deadline_s:g} s"
        if isinstance(error, BdbQuit):
            return "a debugger ended the call; use breakpoints with `merge-sumo run --debug`"
        name = text_of(error, lambda error: type(error).__name__)
        return f"{name}: {text_of(error)}{text_of(error, _raised_at)}"

    def _ring(self, _signal: int, _frame: FrameType | None) -> None:
        if perf_counter() - self._since_s > self.deadline_s:
            raise DeadlineExceeded


def close_within(deadline_s: float, close: Callable[[], Any]) -> None:
    """Call a controller's `close` within the deadline; an error is printed and changes nothing.

    Args:
        deadline_s: time for the call.
        close: the function to call.
    """
    deadline = Deadline(deadline_s)  # its own: this may be part of another call
    try:
        with deadline:
            deadline.start()
            close()
            deadline.stop()
    except BaseException as error:
        with suppress(OSError):
            sys.stderr.write(f"error while closing the VUT: {deadline.reason(error)}\n")


def text_of(thing: object, as_text: Callable[[Any], str] = str) -> str:
    """Return the text of a controller's object in one line, even where making it raises.

    Args:
        thing: the object.
        as_text: makes its text.
    """
    try:  # a subclass of `str` may override its methods: take its characters only
        return as_reason(str.__str__(as_text(thing)))[:MOST_CHARACTERS]
    except Exception as error:
        return f"({type(error).__name__} while it was printed)"


def _raised_at(error: BaseException) -> str:
    """Return where an error was raised, " (FILE, line N)"; "" for an error of this package."""
    last: TracebackType | None = error.__traceback__
    while last is not None and last.tb_next is not None:  # a recursion leaves thousands
        last = last.tb_next
    if last is None:
        return ""
    file = Path(last.tb_frame.f_code.co_filename)
    return "" if file.parent == Path(__file__).parent else f" ({file.name}, line {last.tb_lineno})"
