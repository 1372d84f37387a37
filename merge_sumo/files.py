"""Files and folders: written without overwriting those of a user, and read only where regular.

What a user names as an output must not exist. It is written under a temporary name next to its
place and renamed when it is whole, so a process that is killed leaves nothing that looks finished.
Files of merge-sumo in a run folder may be written again, but not through links.
"""

from __future__ import annotations

import errno
import hashlib
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
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

from merge_sumo.errors import UserError
from merge_sumo.printable import printable, quoted

TEMPORARY = ".merge-sumo-"
"""Begin of the names under which files are written."""
LONG_NAME = "x" * 64
"""As long as the name of a file that is written into a new folder."""
GENERATOR = b'<meta name="generator" content="merge-sumo">'
DEFAULT = Path("runs")
"""Folder of runs without a name."""
LATEST = "latest"
CACHE = "MERGE_SUMO_CACHE"
DATED = re.compile(r"[\w.-]*-[0-9]{8}-[0-9]{6}(-[0-9]+)?")
"""The names that `dated` gives."""


class TakenError(UserError):
    """There is something else at the place of an output."""


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Within `with`, an error of the system is a `UserError` that names what cannot be written.

    Args:
        path: the file or the folder.
    """
    try:
        yield
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror or error}") from error


def regular(path: Path) -> Path:
    """Return the path of a file to read.

    Args:
        path: the path; nothing may be there.

    Raises:
        OSError: it is a folder, a pipe or a device.
    """
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "it is not a file", str(path))
    return path


def read_limited(path: Path, most_bytes: int) -> bytes:
    """Return the bytes of a regular file.

    Args:
        path: the file.
        most_bytes: maximum size.

    Raises:
        OSError: it is not a regular file, or larger.
    """
    with regular(path).open("rb") as file:
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise OSError(errno.EFBIG, f"it is larger than {most_bytes // 2**20} MiB", str(path))
    return content


def check_new(path: Path, option: str = "`out`", endings: Sequence[str] = ()) -> None:
    """Raise `UserError` where no new file or folder can be made at a path.

    Args:
        path: the file or folder; missing folders above it can be made.
        option: what names it in the message.
        endings: allowed endings of a file.
    """
    if endings and path.suffix not in endings:
        raise UserError(f"{option} is {str(path)!r}: its name must end in {' or '.join(endings)}")
    if path.name in ("", ".."):
        raise UserError(f"{option} is {str(path)!r} or empty: give a name")
    if os.path.lexists(path):
        raise _exists(path, option)
    try:
        with writing(path), suppress(FileNotFoundError):
            (path / LONG_NAME).lstat()
    except ValueError as error:
        raise UserError(f"{option} is {str(path)!r}: a file cannot have this name") from error
    parent = path.parent
    while not os.path.lexists(parent) and parent != parent.parent:
        parent = parent.parent
    if not parent.is_dir():
        raise UserError(f"cannot write {path}: {parent} is not a folder")
    with writing(path):
        # On Linux the file never has a name: nothing changes in the folder.
        tempfile.TemporaryFile(dir=parent).close()


def check_own(*paths: Path) -> None:
    """Raise `UserError` where one of the paths exists and is neither a file nor a folder.

    To be called before a file is written again: in a received folder, a link leads anywhere, and a
    pipe never answers.

    Args:
        paths: files and folders of merge-sumo, which may not exist.
    """
    for path in paths:
        with writing(path):
            try:
                mode = path.lstat().st_mode
            except (FileNotFoundError, NotADirectoryError):
                continue
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            what = "a link" if stat.S_ISLNK(mode) else "not a file"
            raise UserError(f"cannot write {path}: it is {what}; remove it")


def check_generated(path: Path, mark: bytes = GENERATOR) -> None:
    """Raise `UserError` where there is a file that merge-sumo did not write.

    Args:
        path: the file, which may not exist.
        mark: bytes that a file of merge-sumo of that name contains unless it is empty; by default
            the generator of a page.
    """
    check_own(path)
    with writing(path):
        try:
            content = path.read_bytes()
        except FileNotFoundError:
            return
    if content and mark not in content:
        raise UserError(
            f"{path} was not created by merge-sumo and is not overwritten: move or rename it"
        )


def make_folder(path: Path, option: str = "`out`", *, exist_ok: bool = False) -> None:
    """Make a folder.

    Args:
        path: the folder.
        option: what names it in the message.
        exist_ok: whether it may exist.

    Raises:
        UserError: it exists or cannot be made.
    """
    with suppress(OSError):  # `check_new` refuses a name that is too long
        if exist_ok and path.name not in ("", "..") and path.is_dir():
            return
    check_new(path, option)
    with writing(path):
        path.mkdir(parents=True)


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
    with writing(path):
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


def _holds(path: Path, files: Mapping[str, bytes]) -> bool:
    """Return whether a path is a folder of just these files."""
    if path.is_symlink() or not path.is_dir():
        return False
    try:
        return {file.name: regular(file).read_bytes() for file in path.iterdir()} == files
    except OSError:
        return False


def write_new(path: Path, content: bytes, option: str = "`out`") -> None:
    """Write a new file; it is there whole, or not at all.

    Args:
        path: the file.
        content: its bytes.
        option: what names it in the message.

    Raises:
        UserError: something is there, or it cannot be written.
    """
    with writing(path):
        if os.path.lexists(path):
            raise _exists(path, option)
        path.parent.mkdir(parents=True, exist_ok=True)
        with _temporary(path) as (new, file):
            file.write(content)
            file.flush()
            try:
                os.link(new, path, follow_symlinks=False)  # refuses a name taken since
            except FileExistsError as error:
                raise _exists(path, option) from error
            except (OSError, NotImplementedError):  # a file system without hard links
                new.rename(path)


def replace_own(path: Path, content: bytes, mark: bytes = b"") -> None:
    """Write a file of merge-sumo in the place of an older one, whole or not at all; sync it.

    Args:
        path: the file.
        content: its bytes.
        mark: bytes that the older file contains (`check_generated`).

    Raises:
        UserError: something else is there, or it cannot be written.
    """
    check_generated(path, mark)
    with writing(path):
        with _temporary(path) as (new, file):
            _sync(file, content)
            new.replace(path)
        sync_folder(path.parent)


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
    """Sync the entries of a folder to the disk, so that a new file is found after a crash.

    Args:
        folder: the folder.
    """
    if sys.platform == "win32":  # folders cannot be opened there
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def dated(what: str) -> Path:
    """Return a dated name below `runs/`, of which `what` becomes a part.

    It has microseconds: several campaigns of a VUT may begin in the same second.

    Args:
        what: a name, such as that of the VUT.
    """
    name = re.sub(r"[^\w.-]+", "-", what, flags=re.ASCII).strip("-.")[-100:]
    return DEFAULT / f"{name}-{datetime.now().astimezone():%Y%m%d-%H%M%S-%f}"


def link_latest(folder: Path) -> None:
    """Let `runs/latest` lead to a folder that has its name from `dated`.

    Only a link to such a folder is replaced; where links cannot be made nothing happens.

    Args:
        folder: the folder of a campaign.
    """
    if folder.parent != DEFAULT or not DATED.fullmatch(folder.name) or not folder.is_dir():
        return
    link = DEFAULT / LATEST
    with suppress(OSError):
        if os.path.lexists(link) and not DATED.fullmatch(str(link.readlink())):
            return
        new = _temporary_name(link)
        new.symlink_to(folder.name, target_is_directory=True)
        new.replace(link)


def _exists(path: Path, option: str) -> TakenError:
    return TakenError(f"{path} exists: choose another name with {option}, or remove it first")


Files = dict[str, str | None]
"""SHA-256 by path, relative to the working folder where it lies below; None of a lost file."""


def hashed(paths: Iterable[Path]) -> Files:
    """Return files with their hashes.

    Args:
        paths: the files.
    """
    folder = Path.cwd().resolve()
    files: Files = {}
    for path in sorted({path.resolve() for path in paths}):
        name = path.relative_to(folder) if path.is_relative_to(folder) else path
        files[name.as_posix()] = sha256_of(path)
    return files


def files_now(recorded: Files, loaded: Files) -> Files:
    """Return recorded files with the hashes that they have now, then the other `loaded` files.

    Args:
        recorded: files by names that are relative to where a record was written.
        loaded: files that are loaded now. A recorded file that is not at its place is looked for
            next to them.
    """
    now, others = {}, dict(loaded)
    for name in recorded:
        now[name] = sha256_of(Path(name))
        for other in loaded:
            path = Path(other).with_name(Path(name).name)
            if now[name] is None and (found := sha256_of(path)) is not None:
                now[name] = found
                others.pop(str(path), None)
    return now | others


def sha256_of(path: Path) -> str | None:
    """Return the SHA-256 of a regular file; None where it cannot be read.

    Args:
        path: the file.
    """
    try:
        found = path.stat()
        if not stat.S_ISREG(found.st_mode):
            return None
        return _sha256(path.resolve(), found.st_ino, found.st_ctime_ns, found.st_size)
    except (OSError, ValueError):
        return None


# By the time of the last change of the inode: unlike that of the content, it cannot be set.
@lru_cache(maxsize=4096)
def _sha256(path: Path, _inode: int, _changed_ns: int, _size: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def check_code(path: Path) -> None:
    """Refuse code that users other than this one and root may write.

    Args:
        path: the file of code.

    Raises:
        UserError: others may write it.
    """
    if why := _written_by_others(path, 0):
        raise UserError(
            f"{printable(str(path))} is not run: {why}; make it writable for you alone (`chmod "
            f"go-w {quoted(path)}`), or copy it"
        )


def check_private(folder: Path) -> None:
    """Refuse a cache folder that is not this user's, or that others can write.

    Args:
        folder: the folder.

    Raises:
        UserError: others may write it.
    """
    if why := _written_by_others(folder):
        raise UserError(
            f"the cache folder {folder} is not used: {why}, and could change its files; run "
            f"`chmod go-w {quoted(folder)}`, or set {CACHE} to another folder"
        )


def _written_by_others(path: Path, *trusted: int) -> str | None:
    """Return a clause on others who may write a file or a folder; None where there are none."""
    if sys.platform == "win32":  # the folders of a profile are the user's there
        return None
    try:
        found = path.stat()
    except OSError:
        return None
    if found.st_uid not in (os.geteuid(), *trusted):
        return f"it belongs to the user {found.st_uid}"
    return "others can write it" if found.st_mode & stat.S_IWOTH else None


def resource(name: str) -> Path:
    """Return a shipped folder.

    A wheel carries the folders inside the package; a source tree has them next to it.

    Args:
        name: "sumo_net" or "policies".
    """
    package = Path(__file__).resolve().parent
    shipped = package / "shipped" / name
    return shipped if shipped.is_dir() else package.parent / name


def cache_folder() -> Path:
    """Return the folder of the cache: MERGE_SUMO_CACHE, or the user's cache folder."""
    if named := os.environ.get(CACHE):
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "merge-sumo"


class ScratchFolder(tempfile.TemporaryDirectory[str]):
    """A temporary folder of this process; to be cleaned up, or used in `with`."""

    def __init__(self) -> None:
        """Make the folder; OSError where that cannot be."""
        super().__init__(prefix="merge-sumo-", ignore_cleanup_errors=True)
