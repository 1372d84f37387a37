"""Folders held by a descriptor: what is written there goes there, whatever takes their name.

Where others can write a folder on the way, they can put a link, or another folder, into the place
of the one in which we write; the name then leads to files of this user's elsewhere. So a folder is
opened once, no link that another user has made is followed on the way to it, and what is written
goes through the descriptor. That needs Linux; elsewhere, or without /proc, names are used.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

SUPPORTED: Final = hasattr(os, "O_PATH") and Path("/proc/self/fd").is_dir()
MOST_LINKS: Final = 40
"""On the way to a folder, as in the kernel."""


class Anchor:
    """A folder that is held open.

    `path` leads to it, and to it alone, for this process and its children until it is closed.
    """

    def __init__(self, folder: Path, *, descriptor: int | None = None) -> None:
        """Open a folder, or take its descriptor; OSError where there is none, or a strange link."""
        self._descriptor = descriptor
        self.path = folder
        if SUPPORTED:
            if self._descriptor is None:
                self._descriptor = _open(folder)
            self.path = _held() / str(self._descriptor)

    def again(self) -> Anchor:
        """Return the same folder, held by another descriptor."""
        if self._descriptor is None:
            return Anchor(self.path)
        return Anchor(self.path, descriptor=os.dup(self._descriptor))

    def new_folder(self, name: str) -> Anchor:
        """Make a folder in this one and hold it; OSError where that cannot be.

        What somebody puts into its place at this moment is not taken for it.
        """
        (self.path / name).mkdir()
        if self._descriptor is None:
            return Anchor(self.path / name)
        flags = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW
        made = Anchor(self.path / name, descriptor=os.open(self.path / name, flags))
        if (made.path.stat().st_uid, os.listdir(made.path)) != (os.geteuid(), []):  # noqa: PTH208
            made.close()
            raise OSError(errno.EPERM, "somebody has put another folder into its place", name)
        return made

    def close(self) -> None:
        """Let go of the folder."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


@contextmanager
def anchored(folder: Path) -> Iterator[Path]:
    """Give a path that leads to a folder whatever takes its name; OSError as of `Anchor`."""
    anchor = Anchor(folder)
    try:
        yield anchor.path
    finally:
        anchor.close()


def _held() -> Path:
    """Return the folder in which the kernel shows what this process has opened."""
    return Path(f"/proc/{os.getpid()}/fd")


def _open(folder: Path) -> int:
    """Return a descriptor of a folder, to which no link of another user's leads.

    Links of this user, of root and of who owns the root of the file system are followed, the last
    because in a container root may have another number.
    """
    trusted = {0, os.geteuid(), os.stat("/").st_uid}  # noqa: PTH116 (once for each folder)
    begins = Path("/" if folder.is_absolute() else ".")
    if folder.is_relative_to(_held()):  # it is held, and its name must not be looked for again
        begins = Path(*folder.parts[: len(_held().parts) + 1])
    here = os.open(begins, os.O_PATH | os.O_DIRECTORY)
    missing = list(reversed(folder.relative_to(begins).parts))
    links = 0
    try:
        while missing:
            name = missing.pop()
            found = os.open(name, os.O_PATH | os.O_NOFOLLOW, dir_fd=here)
            try:
                about = os.fstat(found)
                if not stat.S_ISLNK(about.st_mode):
                    here, found = found, here
                    continue
                links += 1
                target = os.readlink("", dir_fd=found)
            finally:
                os.close(found)
            if about.st_uid not in trusted or links > MOST_LINKS:
                raise OSError(errno.EPERM, f"somebody else has made the link {name} on the way")
            parts = Path(target).parts
            if Path(target).is_absolute():
                os.close(here)
                here = os.open("/", os.O_PATH | os.O_DIRECTORY)
                parts = parts[1:]
            missing += reversed(parts)
        return os.open(f"/proc/self/fd/{here}", os.O_RDONLY | os.O_DIRECTORY)
    finally:
        os.close(here)
