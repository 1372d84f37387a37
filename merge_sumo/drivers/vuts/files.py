"""The files of the user's that decide what a VUT does, with the hashes of what is in them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

Files = dict[str, str | None]
"""SHA-256 by path, relative to the working folder where it lies below; None of a lost file."""


def hashed(paths: Iterable[Path]) -> Files:
    """Return the files with their hashes."""
    here = Path.cwd().resolve()
    found: Files = {}
    for path in sorted({path.resolve() for path in paths}):
        name = path.relative_to(here) if path.is_relative_to(here) else path
        found[name.as_posix()] = sha256_of(path)
    return found


def changed(files: Files) -> list[str]:
    """Return the names of files that are not as they were when they were hashed."""
    return [name for name, sha256 in files.items() if sha256_of(Path(name)) != sha256]


def sha256_of(path: Path) -> str | None:
    """Return the SHA-256 of a regular file; None where there is none that can be read."""
    try:
        found = path.stat()
        if not path.is_file():
            return None
        return _sha256(path.resolve(), found.st_mtime_ns, found.st_size)
    except OSError:
        return None


@lru_cache(maxsize=4096)
def _sha256(path: Path, _changed_ns: int, _size: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
