"""Hashes of what is in files, by which a change is seen."""

from __future__ import annotations

import hashlib
import stat
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

Files = dict[str, str | None]
"""SHA-256 by path, relative to the working folder where it lies below; None of a lost file."""


def hashed(paths: Iterable[Path]) -> Files:
    """Return files with their hashes."""
    folder = Path.cwd().resolve()
    files: Files = {}
    for path in sorted({path.resolve() for path in paths}):
        name = path.relative_to(folder) if path.is_relative_to(folder) else path
        files[name.as_posix()] = sha256_of(path)
    return files


def changed(files: Files) -> list[str]:
    """Return the names of files that are not as they were when they were hashed."""
    return [name for name, sha256 in files.items() if sha256_of(Path(name)) != sha256]


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
