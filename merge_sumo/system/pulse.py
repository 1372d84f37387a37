"""Whether this process was stopped: with its container, by a signal, or by a machine too busy.

A deadline that passes while nothing of ours could run says nothing of who was waited for.
"""

from __future__ import annotations

import threading
from time import monotonic
from typing import Final, Self

TICK_S: Final = 0.1
PAUSE_S: Final = 0.5
"""A tick that is so late was stopped."""


class Pulse:
    """Ticks in a thread while it is entered; a tick that comes late is a pause."""

    def __init__(self) -> None:
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._tick, daemon=True)
        self._last_s = monotonic()
        self._pauses = 0

    def pauses(self) -> int:
        """Return the number of pauses so far."""
        return self._pauses + (monotonic() - self._last_s > PAUSE_S)

    def __enter__(self) -> Self:
        self._last_s = monotonic()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()

    def _tick(self) -> None:
        while not self._end.wait(TICK_S):
            now_s = monotonic()
            self._pauses += now_s - self._last_s > PAUSE_S
            self._last_s = now_s


class AwakeClock:
    """Seconds in which this process ran, for a loop that looks at it every `most_s` or sooner."""

    def __init__(self, most_s: float) -> None:
        self._most_s, self._last_s, self._awake_s = most_s, monotonic(), 0.0

    def restart(self) -> None:
        """Begin at 0 again."""
        self._last_s, self._awake_s = monotonic(), 0.0

    def elapsed_s(self) -> float:
        """Return the seconds so far; of a longer time between two looks, `most_s` count."""
        now_s = monotonic()
        self._awake_s += min(now_s - self._last_s, self._most_s)
        self._last_s = now_s
        return self._awake_s
