"""Ownership and permission checks of controllers that are run, and of the cache."""

from __future__ import annotations

import os
import stat
import sys
from pathlib import Path
from typing import Final

from merge_sumo.errors import UserError
from merge_sumo.printable import printable, quoted

CACHE: Final = "MERGE_SUMO_CACHE"
ROOT: Final = 0


def check_code(path: Path) -> None:
    """Raise `UserError` where other users than root may write a file of code, or own it."""
    why = _written_by_others(path, ROOT)
    if why is not None:
        raise UserError(
            f"{printable(str(path))} is not run: {why}; make it yours alone (`chmod go-w "
            f"{quoted(path)}`), or copy it"
        )


def check_private(folder: Path) -> None:
    """Raise `UserError` where a cache folder is not this user's, or others can write it."""
    why = _written_by_others(folder)
    if why is not None:
        raise UserError(
            f"the cache folder {folder} is not used: {why}, and could forge what it holds; run "
            f"`chmod go-w {quoted(folder)}`, or name another one with {CACHE}"
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
