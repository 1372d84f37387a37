"""Files and folders: written without overwriting what is not ours, and read only where regular.

What a user names as an output must not exist. It is written under a temporary name next to its
place and renamed when it is whole, so a process that is killed leaves nothing that looks finished.
Files of merge-sumo in a run folder may be written again, but not through links.
"""

from __future__ import annotations

import errno
import json
import os
import re
import secrets
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from itertools import count
from pathlib import Path
from typing import BinaryIO, Final

from merge_sumo.errors import UserError

TEMPORARY: Final = ".merge-sumo-"
"""Begin of the names under which files are written."""
LONG_NAME: Final = "x" * 64
"""As long as the name of a file that is written into a new folder."""
GENERATOR: Final = b'<meta name="generator" content="merge-sumo">'
DEFAULT: Final = Path("runs")
"""Folder of runs without a name."""
LATEST: Final = "latest"
DATED: Final = re.compile(r"[\w.-]*-([0-9]{8}-[0-9]{6})")
"""The names that `dated` gives, with the time."""


class TakenError(UserError):
    """There is something else at the place of an output."""


def regular(path: Path) -> Path:
    """Return the path of a file to read; OSError where it is a folder, a pipe or a device."""
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "it is not a file", str(path))
    return path


def read_limited(path: Path, most_bytes: int) -> bytes:
    """Return the bytes of a regular file; OSError where it is not one, or larger."""
    with regular(path).open("rb") as file:
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise OSError(errno.EFBIG, f"it is larger than {most_bytes // 2**20} MiB", str(path))
    return content


def check_new(path: Path, option: str = "`out`") -> None:
    """Raise `UserError` where no new folder or file can be made at `path`.

    Missing folders above it can be made; `option` names it in the message.
    """
    if path.name in ("", ".."):
        raise UserError(f"{option} is {str(path)!r} or empty: write the name of what is to be made")
    if os.path.lexists(path):
        raise _exists(path, option)
    try:
        with suppress(FileNotFoundError):
            (path / LONG_NAME).lstat()
    except ValueError as error:
        raise UserError(f"{option} is {str(path)!r}: no file can have that name") from error
    except OSError as error:
        raise cannot_write(path, error) from error
    parent = next((p for p in path.parents if os.path.lexists(p)), path.parent)
    if not parent.is_dir():
        raise UserError(f"cannot write {path}: {parent} is not a folder")
    _check_writable(parent, path)


def _check_writable(folder: Path, path: Path) -> None:
    try:
        # On Linux the file never has a name: nothing changes in the folder.
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise cannot_write(path, error) from error


def check_ending(path: Path, endings: Sequence[str], option: str = "`out`") -> None:
    """Raise `UserError` where a name does not say to other programs what the file is.

    Args:
        path: the file.
        endings: those that its name may have.
        option: what names it in the message.
    """
    if path.suffix not in endings:
        raise UserError(f"{option} is {str(path)!r}: end it in {' or '.join(endings)}")


def check_new_file(path: Path, option: str = "`out`", endings: Sequence[str] = ()) -> None:
    """Raise `UserError` where no new file can be written at `path`, in an existing folder.

    Args:
        path: the file.
        option: what names it in the message.
        endings: those that its name may have; by default any.
    """
    if endings:
        check_ending(path, endings, option)
    check_new(path, option)
    if not path.parent.is_dir():
        raise UserError(f"{option} is {str(path)!r}: there is no folder {path.parent}")


def check_place(folder: Path, option: str = "`out`") -> None:
    """Raise `UserError` where `folder` is neither a folder to add to nor one that can be made."""
    try:
        is_there = folder.is_dir() and folder.name not in ("", "..")
    except (OSError, ValueError):
        is_there = False
    if is_there:
        _check_writable(folder, folder)
    else:
        check_new(folder, option)


def check_own(*paths: Path) -> None:
    """Raise `UserError` where one of the paths exists and is neither a file nor a folder.

    To be called before writing what was written before: in a folder of another person, a link leads
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
            what = "a link" if stat.S_ISLNK(mode) else "not a file"
            raise UserError(f"cannot write {path}: it is {what}; remove it")


def check_ours(path: Path, keys: Iterable[str] = ()) -> None:
    """Raise `UserError` where there is a page or a record that merge-sumo did not write.

    A page of merge-sumo names its generator; a record has more of the `keys` than others, which may
    be of another version.
    """
    check_own(path)
    try:
        if path.suffix == ".html":
            ours = GENERATOR in path.read_bytes()
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
        raise UserError(f"{path} was not created by merge-sumo and is not overwritten: move it")


def _keys(content: bytes, suffix: str) -> set[str]:
    """Return the keys of a record, or of the first of many."""
    try:
        record = json.loads(content.partition(b"\n")[0] if suffix == ".jsonl" else content)
    except (ValueError, RecursionError):
        return set()
    return set(record) if isinstance(record, dict) else set()


def make_folder(path: Path, option: str = "`out`") -> None:
    """Make an empty folder; `UserError` where it exists or cannot be made."""
    check_new(path, option)
    try:
        path.mkdir(parents=True)
    except FileExistsError as error:
        raise _exists(path, option) from error
    except OSError as error:
        raise cannot_write(path, error) from error


def make_place(folder: Path, option: str = "`out`") -> None:
    """Make a folder unless it is there; `UserError` where it cannot be made."""
    check_place(folder, option)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from error


def write_folder(path: Path, files: Mapping[str, bytes]) -> None:
    """Write a folder of files at once; a folder that holds the same files stays as it is.

    Args:
        path: the folder, which does not exist.
        files: the contents by name.

    Raises:
        TakenError: something else is there.
        UserError: it cannot be written; then nothing is there.
    """
    if _holds(path, files):
        return
    check_new(path)
    new = _temporary_name(path)
    try:
        new.mkdir(parents=True)
        try:
            for name, content in files.items():
                with (new / name).open("xb") as file:
                    _sync(file, content)
            sync_folder(new)
            new.rename(path)
        except BaseException:
            shutil.rmtree(new, ignore_errors=True)
            raise
        sync_folder(path.parent)
    except OSError as error:
        raise cannot_write(path, error) from error


def _holds(path: Path, files: Mapping[str, bytes]) -> bool:
    """Return whether a path is a folder of just these files."""
    try:
        if path.is_symlink() or {entry.name for entry in path.iterdir()} != files.keys():
            return False
        return all(regular(path / name).read_bytes() == files[name] for name in files)
    except (OSError, ValueError):
        return False


@contextmanager
def new_file(path: Path, option: str = "`out`") -> Iterator[BinaryIO]:
    """Give a new file to write; it is at `path` in the end, or nowhere.

    Raises `UserError` where something is at `path` or it cannot be written.
    """
    try:
        if os.path.lexists(path):
            raise FileExistsError
        with _temporary(path) as (new, file):
            yield file
            file.flush()
            try:
                os.link(new, path, follow_symlinks=False)  # refuses a name that was taken since
            except FileExistsError:
                raise
            except (OSError, NotImplementedError):  # a file system without hard links
                new.rename(path)
    except FileExistsError as error:
        raise _exists(path, option) from error
    except OSError as error:
        raise cannot_write(path, error) from error


def write_new(path: Path, content: bytes, option: str = "`out`") -> None:
    """Write a new file.

    Args:
        path: the file.
        content: its bytes.
        option: what names it in the message.

    Raises:
        UserError: something is there, or it cannot be written.
    """
    with new_file(path, option) as file:
        file.write(content)


def replace_own(path: Path, content: bytes) -> None:
    """Write a file of merge-sumo in the place of an older one, whole or not at all; sync it.

    Raises `UserError` where something else is there (`check_ours`) or it cannot be written.
    """
    check_ours(path, _keys(content, path.suffix))
    try:
        with _temporary(path) as (new, file):
            _sync(file, content)
            new.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        raise cannot_write(path, error) from error


def _temporary_name(path: Path) -> Path:
    return path.with_name(f"{TEMPORARY}{secrets.token_hex(8)}")


@contextmanager
def _temporary(path: Path) -> Iterator[tuple[Path, BinaryIO]]:
    """Give a file next to `path` under a temporary name; it is gone in the end, if not renamed."""
    new = _temporary_name(path)
    with new.open("xb") as file:
        try:
            yield new, file
        finally:
            new.unlink(missing_ok=True)


def _sync(file: BinaryIO, content: bytes) -> None:
    file.write(content)
    file.flush()
    os.fsync(file.fileno())


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
    candidate, number = path, count(2)
    while os.path.lexists(candidate):
        candidate = path.with_stem(f"{path.stem}-{next(number)}")
    return candidate


def dated(what: str) -> Path:
    """Return a free dated name below `runs/`, of which `what` becomes a part."""
    name = re.sub(r"[^\w.-]+", "-", what, flags=re.ASCII).strip("-.")[-100:]
    now = f"{datetime.now().astimezone():%Y%m%d-%H%M%S}"
    candidate, number = DEFAULT / f"{name}-{now}", count(2)
    while os.path.lexists(candidate):
        candidate = DEFAULT / f"{name}-{next(number)}-{now}"
    return candidate


def link_latest(folder: Path) -> None:
    """Let `runs/latest` lead to a folder that has its name from `dated`, unless one is newer.

    Only a link to such a folder is replaced; where links cannot be made nothing happens.
    """
    named = DATED.fullmatch(folder.name)
    if folder.parent != DEFAULT or named is None or not folder.is_dir():
        return
    link = DEFAULT / LATEST
    with suppress(OSError):
        if os.path.lexists(link):
            before = DATED.fullmatch(str(link.readlink()))  # raises where it is not a link
            if before is None or before[1] > named[1]:
                return
        new = _temporary_name(link)
        new.symlink_to(folder.name, target_is_directory=True)
        new.replace(link)


def cannot_write(path: Path, error: OSError) -> UserError:
    """Return the error for a path that cannot be written."""
    return UserError(f"cannot write {path}: {error.strerror or error}")


def _exists(path: Path, option: str = "`out`") -> TakenError:
    return TakenError(f"{path} exists: choose another name with {option}, or remove it first")
