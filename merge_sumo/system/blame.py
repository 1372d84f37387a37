"""Whom to blame for a death: of a worker, or of the process in which a VUT runs.

What dies beside others may have been struck by one of them, and what dies once may have been killed
from outside: by a person, or by a kernel that is short of memory. So it runs again alone, and only
what it does again alone is its own doing.
"""

from __future__ import annotations

import signal
from collections import Counter
from collections.abc import Hashable
from typing import Final, Generic, TypeVar

MAX_DEATHS: Final = 2
"""What died so often, each time on its own, is to blame."""
MAX_KILLS: Final = 4
"""The same where it was killed by SIGKILL, which seldom comes from within."""

T = TypeVar("T", bound=Hashable)


class Blame(Generic[T]):
    """Counts the deaths of items of work, and says of each whose doing it was."""

    def __init__(self) -> None:
        self._deaths: Counter[T] = Counter()

    def died(
        self,
        item: T,
        *,
        alone: bool,
        named: bool = False,
        repeatable: bool = False,
        killed: bool = False,
    ) -> bool:
        """Count a death; return whether the item is to blame. If not, it is to run again alone.

        `alone` is where nothing ran beside it, `named` where it is known to have been at work,
        `repeatable` where it hung and would again, `killed` where SIGKILL ended it.
        """
        self._deaths[item] += alone or named
        most = MAX_KILLS if killed else MAX_DEATHS
        return alone and (repeatable or self._deaths[item] >= most)


def how_it_ended(code: int | None) -> str:
    """Return the end of a process in words, by its exit code; None for a broken channel."""
    if code is None:
        return "broke the channel to its process"
    if code >= 0:
        return f"ended its process with exit code {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:  # a signal of real time
        name = "unknown"
    return f"ended its process by signal {-code} ({name})"
