"""Files whose content this user decides alone: controllers that are run, and the cache."""

from __future__ import annotations

import os
import stat
import sys
from contextlib import suppress
from pathlib import Path
from typing import Final

from merge_sumo.errors import UserError
from merge_sumo.system.printable import printable, quoted

CACHE: Final = "MERGE_SUMO_CACHE"


def check_code(path: Path) -> None:
    """Raise `UserError` where others than this user and root may write a file of code.

    So may who can write its folder, or put another folder into its place. In a folder with the
    sticky bit, as /tmp, nobody replaces what another user has made.
    """
    real = path.resolve()
    for place in dict.fromkeys((path, path.parent, real, real.parent)):
        why = _written_by_others(place)
        if why is not None:
            raise UserError(
                f"{printable(str(path))} is not run: {why}, and could put other code there; make "
                f"it yours alone (`chmod go-w {quoted(place)}`), or copy it to a folder of your own"
            )


def check_private(folder: Path) -> None:
    """Raise `UserError` where a cache folder is not this user's, or others can write it."""
    why = _written_by_others(folder, of_root=False)
    if why is not None:
        raise UserError(
            f"the cache folder {folder} is not used: {why}, and could forge what it holds; run "
            f"`chmod go-w {quoted(folder)}`, or name another one with {CACHE}"
        )


def _written_by_others(path: Path, *, of_root: bool = True) -> str | None:
    """Return a clause on others who may write a file or a folder, besides root, or None."""
    if sys.platform == "win32":  # the folders of a profile are the user's there
        return None
    try:
        found = path.stat()
    except OSError:
        return None
    if found.st_uid not in {os.geteuid(), *([0] if of_root else [])}:
        import pwd

        owner = f"the user {found.st_uid}"
        with suppress(KeyError):
            owner = pwd.getpwuid(found.st_uid).pw_name
        return f"{printable(str(path))} belongs to {owner}"
    sticky = of_root and stat.S_ISDIR(found.st_mode) and found.st_mode & stat.S_ISVTX
    return f"others can write {printable(str(path))}" if _others_can(found) and not sticky else None


def _others_can(found: os.stat_result) -> bool:
    """Return whether the mode of a file or a folder lets others than its owner write it.

    A group that is the owner's alone, as most Linux systems make one for every user, is no others.
    """
    if found.st_mode & stat.S_IWOTH:
        return True
    if not found.st_mode & stat.S_IWGRP:
        return False
    import grp
    import pwd

    try:
        group, owner = grp.getgrgid(found.st_gid), pwd.getpwuid(found.st_uid)
    except KeyError:
        return True
    is_own = group.gr_name == owner.pw_name and group.gr_gid == owner.pw_gid
    return not is_own or bool(set(group.gr_mem) - {owner.pw_name})
