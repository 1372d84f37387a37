"""Where we write: nothing that a call did not make itself is removed, replaced or followed.

What a person names is checked before anything runs for it. A folder is written in an order that
shows whether it is whole, so that the next writer goes on where one was killed. Files of ours in a
folder of ours may be written again, but not through links, which somebody may have put there.
"""

from __future__ import annotations

import json
import os
import re
import secrets
import stat
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from datetime import datetime
from itertools import chain, count
from pathlib import Path
from typing import BinaryIO, Final

from merge_sumo.errors import UserError

TEMPORARY: Final = ".merge-sumo-"
"""Begin of the name, of 28 bytes, under which a file is written."""
LONGEST_NAME: Final = 255
"""Bytes of a name that file systems take."""
ROOM: Final = 64
"""Bytes that the name of a file of ours in a folder needs, with the folder's other name."""
NO_LINK: Final = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
"""Flags to open a file that is no link."""
GENERATOR: Final = b'<meta name="generator" content="merge-sumo">'
HEAD_BYTES: Final = 1000
"""In which a page of ours has that."""
DEFAULT: Final = Path("runs")
"""Folder of what nobody gave a name to."""


def check_new(path: Path, option: str = "`out`") -> None:
    """Raise `UserError` where no new folder or file can be made at `path`; make nothing.

    Folders above it that are missing can be made; `option` names it in the sentence.
    """
    if path.name in ("", ".."):
        raise UserError(f"{option} is {str(path)!r} or empty: write the name of what is to be made")
    try:
        if any(len(os.fsencode(part)) > LONGEST_NAME for part in path.parts):
            raise UserError(f"cannot write {path}: a name in it has more than 255 bytes")
        if _is_there(path):
            raise _exists(path, option)
        _is_there(path / ("x" * ROOM))  # raises where that is too long
        parent = next((p for p in path.parents if os.path.lexists(p)), path.parent)
        if not parent.is_dir():
            raise UserError(f"cannot write {path}: {parent} is no folder")
        _try(parent)
    except OSError as error:
        raise cannot_write(path, error) from error
    except ValueError as error:
        raise UserError(f"{option} is {str(path)!r}: nothing can have that name") from error


def _try(folder: Path) -> None:
    """Raise OSError where a folder cannot be written, with the reason."""
    # On Linux the file never has a name: nothing changes in the folder.
    tempfile.TemporaryFile(dir=folder).close()


def _is_there(path: Path) -> bool:
    """Whether anything has that name, be it a link that leads nowhere."""
    try:
        path.lstat()
    except FileNotFoundError:
        return False
    return True


def check_ending(path: Path, endings: Sequence[str], option: str = "`out`") -> None:
    """Raise `UserError` where a name does not say to other programs what the file is."""
    if path.suffix not in endings:
        raise UserError(f"{option} is {str(path)!r}: end it in {' or '.join(endings)}")


def check_new_file(path: Path, option: str = "`out`", endings: Sequence[str] = ()) -> None:
    """Raise `UserError` where no new file can be written at `path`, in a folder that is there.

    `endings` are those that its name may have; by default any.
    """
    if endings:
        check_ending(path, endings, option)
    check_new(path, option)
    if not path.parent.is_dir():
        raise UserError(f"{option} is {str(path)!r}: there is no folder {path.parent}")


def check_place(folder: Path, option: str = "`out`") -> None:
    """Raise `UserError` where `folder` is neither a folder to add to nor one that can be made."""
    if folder.name in ("", "..") or not _is_folder(folder):
        check_new(folder, option)
        return
    try:
        _try(folder)
    except OSError as error:
        raise cannot_write(folder, error) from error


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


def check_own(*paths: Path) -> None:
    """Raise `UserError` where one of the paths is there and is neither a file nor a folder.

    To be called before writing what we wrote before: in a folder that somebody sent, a link leads
    anywhere, and a pipe never answers.
    """
    for path in paths:
        try:
            mode = path.lstat().st_mode
        except (FileNotFoundError, NotADirectoryError):
            continue
        except OSError as error:
            raise cannot_write(path, error) from error
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            what = "a link" if stat.S_ISLNK(mode) else "no file"
            raise UserError(f"cannot write {path}: it is {what}, and not of our making; remove it")


class TakenError(UserError):
    """The name of what is to be written is that of something else."""


def write_folder(path: Path, files: Mapping[str, bytes]) -> None:
    """Write a folder of files in their order, of which the last says that it is whole.

    Where a writer was killed, the next one goes on: a folder with nothing but the beginning of what
    is written, or all of it, loses nothing. Raises `TakenError` where `path` is anything else, and
    `UserError` when it cannot be written; then what was made here is gone again.
    """
    with ExitStack() as undo:
        try:
            if path.is_symlink() or not path.is_dir():
                make_folder(path)
                undo.callback(_remove_if_empty, path)
            there = {entry.name: entry for entry in path.iterdir()}
            if not all(_begins(entry, files.get(name)) for name, entry in there.items()):
                raise _exists(path)
            for name, content in files.items():
                file = path / name
                if name not in there:
                    file.touch(exist_ok=False)
                    undo.callback(file.unlink, missing_ok=True)
                if file.lstat().st_size < len(content):
                    descriptor = os.open(file, os.O_RDWR | NO_LINK)
                    with os.fdopen(descriptor, "r+b") as opened:
                        _sync(opened, content)
            sync_folder(path)
            sync_folder(path.parent)
        except OSError as error:
            raise cannot_write(path, error) from error
        undo.pop_all()


def _begins(path: Path, content: bytes | None) -> bool:
    """Return whether a path is a file with the beginning of a content, or all of it."""
    if content is None or not stat.S_ISREG((found := path.lstat()).st_mode):
        return False
    return found.st_size <= len(content) and content.startswith(path.read_bytes())


def _sync(file: BinaryIO, content: bytes) -> None:
    file.write(content)
    file.flush()
    os.fsync(file.fileno())


def make_folder(path: Path, option: str = "`out`") -> None:
    """Make an empty folder; `UserError` where it exists or cannot be made."""
    check_new(path, option)
    with ExitStack() as undo:
        try:
            for folder in reversed([parent for parent in path.parents if not parent.is_dir()]):
                with suppress(FileExistsError):  # as "a/..", or by somebody else since
                    folder.mkdir()
                    undo.callback(_remove_if_empty, folder)
            path.mkdir()
        except FileExistsError as error:
            raise _exists(path, option) from error
        except OSError as error:
            raise cannot_write(path, error) from error
        undo.pop_all()


def make_place(folder: Path, option: str = "`out`") -> None:
    """Make a folder unless it is there; `UserError` where it cannot be."""
    check_place(folder, option)
    if not folder.is_dir():
        try:
            make_folder(folder, option)
        except UserError:
            if not _is_folder(folder):
                raise
            check_place(folder, option)  # made by another process since


def _remove_if_empty(folder: Path) -> None:
    with suppress(OSError):
        folder.rmdir()


@contextmanager
def new_file(path: Path, option: str = "`out`", mode: int = 0o666) -> Iterator[BinaryIO]:
    """Give a new file to write, readable as `mode` says; it is at `path` in the end, or nowhere.

    Raises `UserError` where something is at `path` or it cannot be written.
    """
    try:
        if _is_there(path):
            raise _exists(path, option)
        with _temporary(path, mode) as (new, file):
            yield file
            file.flush()
            _name_file(new, path, mode)
    except FileExistsError as error:
        raise _exists(path, option) from error
    except OSError as error:
        raise cannot_write(path, error) from error


def _name_file(new: Path, path: Path, mode: int) -> None:
    """Give a file a name that is free, in one step where the file system has hard links.

    Raises FileExistsError where the name is taken.
    """
    try:
        os.link(new, path, follow_symlinks=False)
    except FileExistsError:
        raise
    except (OSError, NotImplementedError):
        path.touch(mode, exist_ok=False)  # the name is ours: a rename replaces anything
        try:
            new.replace(path)
        except BaseException:
            path.unlink(missing_ok=True)
            raise


@contextmanager
def _temporary(path: Path, mode: int = 0o666) -> Iterator[tuple[Path, BinaryIO]]:
    """Give a file beside `path` under a name of ours; it is gone in the end, if not renamed."""
    new = path.with_name(f"{TEMPORARY}{secrets.token_hex(8)}")
    with open(new, "xb", opener=lambda name, flags: os.open(name, flags, mode)) as file:
        try:
            yield new, file
        finally:
            new.unlink(missing_ok=True)


def write_new(path: Path, content: bytes, option: str = "`out`") -> None:
    """Write a new file; `UserError` where something is there or it cannot be written."""
    with new_file(path, option) as file:
        file.write(content)


def check_ours(path: Path, keys: Iterable[str] = ()) -> None:
    """Raise `UserError` where something is at `path` that we did not write.

    A page of ours names its generator; a record of ours has more of the `keys` than others, which
    may be of another version. Other files are those of folders that are known to be ours.
    """
    check_own(path)
    try:
        if path.suffix == ".html":
            with path.open("rb") as file:
                ours = GENERATOR in file.read(HEAD_BYTES)
        elif path.suffix in (".json", ".jsonl"):
            found, expected = _keys(path.read_bytes(), path.suffix), set(keys)
            ours = len(found & expected) > len(found ^ expected)
        else:
            return
    except FileNotFoundError:
        return
    except OSError as error:
        raise cannot_write(path, error) from error
    if not ours:
        raise UserError(f"{path} is not of our making and is not replaced: move it away")


def _keys(content: bytes, suffix: str) -> set[str]:
    """Return the keys of a record, or of the first of many."""
    try:
        record = json.loads(content.partition(b"\n")[0] if suffix == ".jsonl" else content)
    except (ValueError, RecursionError):
        return set()
    return set(record) if isinstance(record, dict) else set()


def replace_own(path: Path, content: bytes) -> None:
    """Write a file of ours, in the place of an older one, whole or not at all; sync it.

    Raises `UserError` when something else is there (`check_ours`) or it cannot be written.
    """
    check_ours(path, _keys(content, path.suffix))
    try:
        with _temporary(path) as (new, file):
            _sync(file, content)
            new.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        raise cannot_write(path, error) from error


def add_to(path: Path, content: bytes, *, new: bool) -> None:
    """Add to a file of ours, which is begun where `new`, and sync it.

    Raises `UserError` where a link is there, something that was not begun, or it cannot be written.
    """
    flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | NO_LINK | (os.O_EXCL if new else 0)
    try:
        descriptor = os.open(path, flags, 0o666)
        with os.fdopen(descriptor, "ab") as file:
            _sync(file, content)
    except OSError as error:
        raise cannot_write(path, error) from error


def sync_folder(folder: Path) -> None:
    """Sync the entries of a folder to the disk, so that a new file is found after a crash."""
    if sys.platform == "win32":  # folders cannot be opened there
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def free(path: Path) -> Path:
    """Return a path, with a number at the end of its stem where something is there."""
    paths = (path.with_stem(f"{path.stem}{again}") for again in chain([""], count(-2, -1)))
    return next(path for path in paths if not os.path.lexists(path))


def dated(what: str) -> Path:
    """Return a dated name below `runs/` that is free, of which `what` becomes a part."""
    name = re.sub(r"[^\w.-]+", "-", what, flags=re.ASCII).strip("-.")[-100:]
    now = f"{datetime.now().astimezone():%Y%m%d-%H%M%S}"
    paths = (DEFAULT / f"{name}{again}-{now}" for again in chain([""], count(-2, -1)))
    return next(path for path in paths if not os.path.lexists(path))


LATEST: Final = "latest"
DATED: Final = re.compile(r"[\w.-]*-([0-9]{8}-[0-9]{6})")
"""The names that `dated` gives, with the time."""


def link_latest(folder: Path) -> None:
    """Let `runs/latest` lead to a folder that has its name from `dated`, if none is newer.

    An older link of this kind is ours to replace: it leads to such a folder beside it. Anything
    else of that name stays, and so does everything where links cannot be made.
    """
    named = DATED.fullmatch(folder.name)
    if folder.parent != DEFAULT or named is None or not folder.is_dir():
        return
    link = DEFAULT / LATEST
    with suppress(OSError):
        if _is_there(link):
            before = DATED.fullmatch(str(link.readlink()))  # raises where it is no link
            if before is None or before[1] > named[1]:
                return
        new = link.with_name(f"{TEMPORARY}{secrets.token_hex(8)}")
        new.symlink_to(folder.name, target_is_directory=True)
        try:
            new.replace(link)
        finally:
            new.unlink(missing_ok=True)


def cannot_write(path: Path, error: OSError) -> UserError:
    """Return the error for a path that cannot be written."""
    return UserError(f"cannot write {path}: {error.strerror or error}")


def _exists(path: Path, option: str = "`out`") -> TakenError:
    return TakenError(f"{path} exists: choose another name with {option}, or remove it first")
