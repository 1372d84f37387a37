"""The corridor whose controller is being called, told to another process in shared memory."""

from __future__ import annotations

import struct
from typing import Any, Final

NO_CORRIDOR: Final = -1
ALL_CORRIDORS: Final = -2
"""A batched VUT is called for all at once."""


class BlameCell:
    """Notes who is called in memory that outlives this process, which may die or hang.

    It is `shared` where another process reads it; then this one is there for a VUT alone.
    """

    FORMAT: Final = struct.Struct("<Qq")

    def __init__(self) -> None:
        self.shared = False
        self._memory: Any = bytearray(self.FORMAT.size)
        self._count = 0

    def share(self, memory: Any) -> None:
        """Note it from now on in a buffer that another process reads, too."""
        self.shared, self._memory = True, memory

    @classmethod
    def read(cls, memory: Any) -> tuple[int, int]:
        """Return from such a buffer the number of notes so far, and the last one."""
        count, corridor = cls.FORMAT.unpack_from(memory)
        return count, corridor

    def note(self, corridor: int) -> None:
        """Note a corridor, `NO_CORRIDOR` or `ALL_CORRIDORS`."""
        self._count += 1
        self.FORMAT.pack_into(self._memory, 0, self._count, corridor)


current_call: Final = BlameCell()
"""Of this process."""
