"""Hashes of what is in files."""

from __future__ import annotations

import hashlib
import stat
from functools import lru_cache
from pathlib import Path


def sha256_of(path: Path) -> str | None:
    """Return the SHA-256 of a regular file; None where there is none that can be read.

    Raises ValueError for a name that no file can have.
    """
    try:
        found = path.stat()
        if not stat.S_ISREG(found.st_mode):
            return None
        return _sha256(path.resolve(), found.st_ino, found.st_ctime_ns, found.st_size)
    except OSError:
        return None


# By the time of the last change of the inode: unlike that of the content, nobody can set it.
@lru_cache(maxsize=4096)
def _sha256(path: Path, _inode: int, _changed_ns: int, _size: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
