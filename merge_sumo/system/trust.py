"""Whose code the folder of a campaign names: this user's own, or that of who sent the folder.

The folder of a campaign names its controller: a file, a module, a command. Going on with a campaign
runs it. In a folder of the user's own that is what is wanted; in one that was received it would be
code of a stranger. So the cache keeps, signed with a key that never leaves it, from which folder
this user ran which code: the folder by path and inode, the code by name, path and hash. A copy of
a folder has another path or inode, and code that somebody changed has another hash.

Who changes a controller of their own wants to run the changed one. That is taken for such a change
where the campaign was begun here, its `campaign.json` is the very file that was written here (a
copy or an archive that is unpacked over it makes another one, with another time of change, which
nobody can set), and the changed file is the user's own, outside of the folder.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final

from merge_sumo.errors import UserError
from merge_sumo.system.folders import make_place, replace_own
from merge_sumo.system.hashing import sha256_of
from merge_sumo.system.records import decode
from merge_sumo.system.resources import cache_folder
from merge_sumo.system.signature import CACHE, others_can_write, signed, user_key, verified

RUNS: Final = "runs"
"""Folder of the cache with a file for each folder from which this user ran code of their own."""
MOST_BYTES: Final = 1 << 24
"""Of such a file."""


@dataclass(frozen=True, slots=True)
class Code:
    """What is run from a folder."""

    named: tuple[str | None, ...]
    """What names it: the VUT, its command, the POV; None where there is none."""
    files: Mapping[str, str | None]
    """The files that it is known to be made of, by absolute path, with their SHA-256."""
    here: str
    """The working folder, in which its relative names are looked for; empty where it has none."""


@dataclass(frozen=True, slots=True)
class _OwnRun:
    """What the cache keeps of a folder, by its real path, and of the code that was run."""

    folder: str
    inode: int
    """Without the device, whose number may change when a disk is mounted again."""
    record: tuple[int, int]
    """Inode and time of change, ns, of the file in it that names the code."""
    begun: bool
    """Whether the campaign was begun there by this user, and not only gone on with."""
    code: Code


def note_own(folder: Path, at: Path, record: str, code: Code, *, begun: bool) -> None:
    """Remember that this user runs code from a folder that will be `at` a path.

    `record` is the file in it that names the code, `begun` whether this user began the campaign.
    Where nothing can be kept, nothing is: then a person is asked later on.
    """
    with suppress(UserError, OSError):
        key, path = user_key(), _path(at)
        identity = _identity(folder, record)
        before = _known(at)
        if before is not None and (before.inode, before.code.named) == (identity[0], code.named):
            # What was loaded before is of the code, too.
            code = replace(code, files={**before.code.files, **code.files})
        known = _OwnRun(os.path.realpath(at), *identity, begun, code)
        make_place(path.parent, CACHE)
        replace_own(path, signed(json.dumps(asdict(known)).encode(), _what(at), key))


def begun_here(folder: Path, record: str) -> bool:
    """Return whether this user began the campaign in a folder, and has written its record."""
    try:
        known = _known(folder)
        inode, written = _identity(folder, record)
    except (UserError, OSError):
        return False
    return known is not None and known.begun and (known.inode, known.record) == (inode, written)


def doubt(folder: Path, record: str, code: Code) -> str | None:
    """Return why code that a folder names may be a stranger's; None where it is this user's own.

    The files of `code` do not count: what is known of them is what the cache says.
    """
    try:
        known = _known(folder)
        inode, written = _identity(folder, record)
    except UserError as error:
        return f"is not known to be yours ({error})"
    except OSError as error:
        return f"is not known to be yours ({error.strerror})"
    if known is None:
        return "was not made here, or was moved since"
    return _doubt_of_place(known, inode, code) or _doubt_of_changes(known, written)


def _doubt_of_place(known: _OwnRun, inode: int, code: Code) -> str | None:
    if known.inode != inode:
        return "is another folder than the one that you made under this name"
    if known.code.named != code.named:
        return "names another controller than when you made it"
    if known.code.here != code.here:
        return f"was begun in {known.code.here}, and here its controller may be another"
    return None


def _doubt_of_changes(known: _OwnRun, written: tuple[int, int]) -> str | None:
    """Return why changed code may not be this user's own change; None where nothing has changed."""
    changed = [name for name, sha256 in known.code.files.items() if _sha256(name) != sha256]
    if not changed:
        return None
    if not known.begun:
        return f"was not begun here, and {changed[0]} has changed since you ran it"
    if known.record != written:
        return f"was written by somebody else since you made it, and {changed[0]} has changed"
    for name in changed:
        if Path(name).is_relative_to(known.folder):
            return f"holds {name}, which has changed since you ran it"
        if not _is_ours(Path(name)):
            return f"runs {name}, which has changed since you ran it, and others can write it"
    return None


def _known(folder: Path) -> _OwnRun | None:
    """Return what the cache keeps of a folder; None where that is nothing of this user's."""
    key, path = user_key(), _path(folder)
    try:
        if not path.is_file() or path.stat().st_size > MOST_BYTES:
            return None
        content = verified(path.read_bytes(), _what(folder), key)
    except OSError:
        return None
    if content is None:
        return None
    known: _OwnRun = decode(content, _OwnRun)
    return known


def _hash(folder: Path) -> str:
    return hashlib.sha256(os.fsencode(os.path.realpath(folder))).hexdigest()


def _path(folder: Path) -> Path:
    return cache_folder() / RUNS / f"{_hash(folder)[:32]}.json"


def _what(folder: Path) -> str:
    return f"run {_hash(folder)}"


def _identity(folder: Path, record: str) -> tuple[int, tuple[int, int]]:
    """Return the inode of a folder, and inode and time of change, ns, of a file in it."""
    written = (folder / record).lstat()
    return folder.stat().st_ino, (written.st_ino, written.st_ctime_ns)


def _is_ours(path: Path) -> bool:
    """Return whether nobody but this user, or root, can write a file; true where it is gone."""
    try:
        found = path.stat()
    except OSError:
        return True
    if os.name != "posix":
        return True
    return found.st_uid in (0, os.geteuid()) and not others_can_write(found)


def _sha256(name: str) -> str | None:
    try:
        return sha256_of(Path(name))
    except ValueError:
        return None
