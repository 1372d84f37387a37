"""Hashes of what is in files, by which a change is seen."""

from __future__ import annotations

import hashlib
import stat
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

from merge_sumo.errors import UserError

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


def files_now(recorded: Files, loaded: Files) -> Files:
    """Return recorded files with the hashes that they have now, then what is `loaded` besides.

    A name in a record is relative to where it was written, which may be elsewhere: a file that is
    not there is that of its name among those that are loaded, or next to them.
    """
    now: Files = {}
    for name in recorded:
        try:
            now[name] = sha256_of(Path(name))
        except ValueError as error:
            raise UserError(f"a record has a file that no file can be named: {error}") from error
        moved = [other for other in loaded if Path(other).name == Path(name).name]
        if now[name] is None and moved:
            now[name] = loaded[moved[0]]
            loaded = {other: sha256 for other, sha256 in loaded.items() if other != moved[0]}
        elif now[name] is None:
            beside = (Path(other).with_name(Path(name).name) for other in loaded)
            now[name] = next(filter(None, map(sha256_of, beside)), None)
    return now | loaded


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


# By the time of the last change of the inode: unlike that of the content, it cannot be set.
@lru_cache(maxsize=4096)
def _sha256(path: Path, _inode: int, _changed_ns: int, _size: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
