"""Which corridor's controller is being asked, for whoever watches the process of a VUT."""

from __future__ import annotations

import struct
from typing import Any, Final

NOBODY: Final = -1
EVERYBODY: Final = -2
"""Whom a batched VUT is asked for."""


class BlameCell:
    """Which corridor's controller is being asked, in memory that outlives the process.

    Whoever watches the process reads from it whose doing it was that the process died or hangs.
    """

    FORMAT: Final = struct.Struct("<Qq")

    def __init__(self) -> None:
        """Note it where nobody else reads it."""
        self.shared = False
        """Whether somebody does: then this process is there for a VUT alone."""
        self._memory: Any = bytearray(self.FORMAT.size)
        self._count = 0

    def share(self, memory: Any) -> None:
        """Note it from now on in a buffer that another process reads, too."""
        self.shared, self._memory = True, memory

    @classmethod
    def read(cls, memory: Any) -> tuple[int, int]:
        """Return from such a buffer how often something was noted, and what was last."""
        count, corridor = cls.FORMAT.unpack_from(memory)
        return count, corridor

    def note(self, corridor: int) -> None:
        """Note a corridor, `NOBODY` or `EVERYBODY`."""
        self._count += 1
        self.FORMAT.pack_into(self._memory, 0, self._count, corridor)


asked: Final = BlameCell()
"""Of this process."""
