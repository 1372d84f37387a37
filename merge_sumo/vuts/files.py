"""The files of the user's that decide what a VUT does, with the hashes of what is in them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from merge_sumo.system.hashing import sha256_of

Files = dict[str, str | None]
"""SHA-256 by path, relative to the working folder where it lies below; None of a lost file."""


def hashed(paths: Iterable[Path]) -> Files:
    """Return the files with their hashes."""
    folder = Path.cwd().resolve()
    files: Files = {}
    for path in sorted({path.resolve() for path in paths}):
        name = path.relative_to(folder) if path.is_relative_to(folder) else path
        files[name.as_posix()] = sha256_of(path)
    return files


def changed(files: Files) -> list[str]:
    """Return the names of files that are not as they were when they were hashed."""
    return [name for name, sha256 in files.items() if sha256_of(Path(name)) != sha256]
