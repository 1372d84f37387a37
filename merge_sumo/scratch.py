"""Temporary folders, which are removed although the process that made them was killed.

Each has a lock that ends with its process, however that ends: the next process that makes one
removes those whose lock is free. Where the system has no such locks, it removes nothing.
"""

from __future__ import annotations

import errno
import hashlib
import os
import platform
import re
import shutil
import tempfile
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, Final

_HERE: Final = hashlib.sha256(platform.node().encode(errors="replace")).hexdigest()[:8]
"""This machine: a lock in a folder that several machines share may mean nothing to the others."""
PREFIX: Final = f"merge-sumo-{_HERE}-"
_OURS: Final = re.compile(re.escape(PREFIX) + r"[a-z0-9_]{8}")


class ScratchFolder(tempfile.TemporaryDirectory[str]):
    """A temporary folder of this process; to be cleaned up, or used in `with`."""

    def __init__(self) -> None:
        """Make the folder; OSError where that cannot be."""
        _remove_remains(tempfile.gettempdir())
        self._lock: int | None = None
        while True:
            super().__init__(prefix=PREFIX, ignore_cleanup_errors=True)
            try:
                self._lock = _locked(Path(self.name))
                return
            except (BlockingIOError, FileNotFoundError):
                self.cleanup()  # another process took it for remains before it had its lock

    def cleanup(self) -> None:
        """Remove the folder."""
        super().cleanup()
        lock, self._lock = self._lock, None
        if lock is not None:
            os.close(lock)


def _locked(folder: Path) -> int | None:
    """Return the descriptor that holds the lock of a folder; None where there are no locks.

    Raises BlockingIOError where another has the lock, and OSError where this is not a folder.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        return None
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.path.samestat(os.fstat(descriptor), folder.lstat()):
            return descriptor
        raise FileNotFoundError(errno.ENOENT, "replaced", str(folder))
    except (BlockingIOError, FileNotFoundError):
        os.close(descriptor)
        raise
    except OSError:  # the file system has no locks
        os.close(descriptor)
        return None


@cache
def _remove_remains(above: str) -> None:
    """Remove the folders of ours whose process is gone, once in a process."""
    with suppress(OSError):
        for folder in Path(above).iterdir():
            if _OURS.fullmatch(folder.name):
                with suppress(OSError):
                    _remove_if_left(folder)


def _remove_if_left(folder: Path) -> None:
    """Remove a folder of this user that no process holds; OSError where it is none."""
    geteuid: Any = getattr(os, "geteuid", None)
    if geteuid is None or folder.lstat().st_uid != geteuid():
        return
    lock = _locked(folder)
    if lock is not None:
        try:
            shutil.rmtree(folder, ignore_errors=True)
        finally:
            os.close(lock)
