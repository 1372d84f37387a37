"""What this user wrote before: signatures (HMAC-SHA-256) with a key that nobody else can read.

The key is in the cache folder, which must be the user's own: whoever can write there can put
another key into its place. A signature says that this user wrote something, so that a truth that
somebody planted is not believed. Users who share a cache folder do not believe each other.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import secrets
import stat
import sys
from pathlib import Path
from typing import Final

from merge_sumo.errors import UserError
from merge_sumo.system.folders import make_place, new_file
from merge_sumo.system.printable import quoted
from merge_sumo.system.resources import cache_folder

KEY: Final = "key"
KEY_BYTES: Final = 32
SIGNATURE_BYTES: Final = 32
CACHE: Final = "MERGE_SUMO_CACHE"


def user_key() -> bytes:
    """Return the user's key, made where there is none yet.

    Raises `UserError` where none can be kept, where the cache folder or the key is somebody else's,
    or others may write the one or read the other.
    """
    folder = cache_folder()
    path = folder / KEY
    if not os.path.lexists(path):
        if not folder.is_dir():
            make_place(folder, CACHE)
            folder.chmod(stat.S_IRWXU)
        check_private(folder)
        _make_key(path)
    check_private(folder)
    return _read_key(path)


def check_private(folder: Path) -> None:
    """Raise `UserError` where a cache folder is not this user's, or others can write it."""
    if sys.platform == "win32":  # the folders of a profile are the user's there
        return
    try:
        found = folder.stat()
    except OSError as error:
        raise UserError(f"cannot read the cache folder {folder}: {error.strerror}") from error
    if found.st_uid != os.geteuid():
        raise UserError(
            f"the cache folder {folder} belongs to {_name_of(found.st_uid)}, who could forge what "
            f"it holds: name one of your own with {CACHE}"
        )
    if others_can_write(found):
        raise UserError(
            f"others can write the cache folder {folder}, and forge what it holds: run `chmod go-w "
            f"{quoted(folder)}`, or name another one with {CACHE}"
        )


def others_can_write(found: os.stat_result) -> bool:
    """Return whether the mode of a file or a folder lets others than its owner write it.

    A group that is the owner's alone, as most Linux systems make one for every user, is no others.
    """
    if found.st_mode & stat.S_IWOTH:
        return True
    return bool(found.st_mode & stat.S_IWGRP) and not _is_private_group(found)


def _is_private_group(found: os.stat_result) -> bool:
    """Return whether the group of a file has the name of its owner and no other member."""
    import grp
    import pwd

    try:
        group, owner = grp.getgrgid(found.st_gid), pwd.getpwuid(found.st_uid)
    except KeyError:
        return False
    is_own = group.gr_name == owner.pw_name and group.gr_gid == owner.pw_gid
    return is_own and not set(group.gr_mem) - {owner.pw_name}


def _name_of(user: int) -> str:
    import pwd

    try:
        return pwd.getpwuid(user).pw_name
    except KeyError:
        return f"the user {user}"


def _make_key(path: Path) -> None:
    """Write a new key, unless another process is quicker; it appears whole or not at all."""
    try:
        with new_file(path, CACHE, mode=stat.S_IRUSR | stat.S_IWUSR) as file:
            file.write(secrets.token_bytes(KEY_BYTES))
            file.flush()
            os.fsync(file.fileno())
    except UserError:
        if not os.path.lexists(path):
            raise


def _read_key(path: Path) -> bytes:
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    try:
        descriptor = os.open(path, flags | getattr(os, "O_BINARY", 0))
    except OSError as error:
        raise UserError(f"cannot read your key {path}: {error.strerror}") from error
    try:
        found = os.fstat(descriptor)
        is_file = stat.S_ISREG(found.st_mode)
        content = os.read(descriptor, KEY_BYTES + 1) if is_file else b""
    finally:
        os.close(descriptor)
    if sys.platform != "win32" and (
        found.st_uid != os.geteuid() or stat.S_IMODE(found.st_mode) & (stat.S_IRWXG | stat.S_IRWXO)
    ):
        raise UserError(
            f"your key {path} is somebody else's, or others can read it: remove it, and a new one "
            "is made; what the old one has signed is not believed any more"
        )
    if len(content) != KEY_BYTES:
        raise UserError(
            f"your key {path} is not as it was written: remove it, and a new one is made; what the "
            "old one has signed is not believed any more"
        )
    return content


def signed(content: bytes, what: str, key: bytes) -> bytes:
    """Return content with a signature behind it; `what` tells what it is of, and is signed too.

    A zip archive, such as numpy's .npz, can be read with the signature behind it.
    """
    return content + _signature(content, what, key)


def verified(content: bytes, what: str, key: bytes) -> bytes | None:
    """Return what was signed, without its signature; None where that is no signature of the key."""
    signature = content[-SIGNATURE_BYTES:]
    inner = content[:-SIGNATURE_BYTES]
    return inner if hmac.compare_digest(signature, _signature(inner, what, key)) else None


def _signature(content: bytes, what: str, key: bytes) -> bytes:
    name = what.encode()
    return hmac.new(key, b"%d:%s:%s" % (len(name), name, content), hashlib.sha256).digest()
