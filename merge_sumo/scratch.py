"""Temporary folders, which are removed although the process that made them was killed.

Each has a lock that ends with its process, however that ends: the next process that makes one
removes those whose lock is free. Where the system has no such locks, it removes nothing.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import tempfile
import time
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Final

_HERE: Final = hashlib.sha256(platform.node().encode(errors="replace")).hexdigest()[:8]
"""This machine: a lock in a folder that several machines share may mean nothing to the others."""
PREFIX: Final = f"merge-sumo-{_HERE}-"
YOUNG_S: Final = 60.0
"""Age, in s, from which on a folder without a lock is one of a process that is gone."""


class ScratchFolder(tempfile.TemporaryDirectory[str]):
    """A temporary folder of this process; to be cleaned up, or used in `with`."""

    def __init__(self) -> None:
        """Make the folder; OSError where that cannot be."""
        _remove_remains(tempfile.gettempdir())
        super().__init__(prefix=PREFIX, ignore_cleanup_errors=True)
        self._lock = _locked(Path(self.name))

    def cleanup(self) -> None:
        """Remove the folder."""
        super().cleanup()
        lock, self._lock = self._lock, None
        if lock is not None:
            os.close(lock)


def _locked(folder: Path) -> int | None:
    """Return the descriptor that holds the lock of a folder.

    None where another process has it, this is not a folder, or the system has no such locks.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        return None
    descriptor = None
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        if descriptor is not None:
            os.close(descriptor)
        return None
    return descriptor


@cache
def _remove_remains(above: str) -> None:
    """Remove the folders of ours whose process is gone, once in a process."""
    with suppress(OSError):
        for folder in Path(above).glob(f"{PREFIX}????????"):
            # A young one may not have its lock yet.
            if time.time() - folder.lstat().st_mtime < YOUNG_S:
                continue
            lock = _locked(folder)
            if lock is not None:
                shutil.rmtree(folder, ignore_errors=True)
                os.close(lock)
