"""Landlock: this process gives up files, ports and other processes, where the kernel can hold it.

Needs no privileges. Linux from 5.13 on holds files, from 6.7 on ports, from 6.12 on signals to
other processes; elsewhere nothing is given up (https://docs.kernel.org/userspace-api/landlock.html).
"""

from __future__ import annotations

import ctypes
import os
import struct
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

CREATE_RULESET, ADD_RULE, RESTRICT_SELF = 444, 445, 446
"""Numbers of the system calls, on every architecture."""
VERSION_FLAG: Final = 1
PATH_BENEATH: Final = 1
PR_SET_NO_NEW_PRIVS: Final = 38
READ: Final = 1 << 0 | 1 << 2 | 1 << 3
"""Execute and read files, list folders."""
FILE_RIGHTS: Final = ((1, (1 << 13) - 1), (2, 1 << 13), (3, 1 << 14), (5, 1 << 15))
"""(version, rights that it knows besides): the first 13, rename across, truncate, devices."""
NET_RIGHTS: Final = (4, 0b11)
"""Bind and connect by TCP."""
SCOPES: Final = (6, 0b11)
"""Abstract sockets, and signals to processes outside."""


def version() -> int:
    """Return the version that the kernel has; 0 where it has none."""
    if sys.platform != "linux":
        return 0
    found: int = _libc().syscall(CREATE_RULESET, None, ctypes.c_size_t(0), VERSION_FLAG)
    return max(found, 0)


def lock_in(write: Sequence[Path], read: Sequence[Path], *, ports: bool = False) -> bool:
    """Give up all files but those in folders to `write` and `read`, and TCP unless `ports`.

    Files, connections and listeners that are open stay open. Returns whether the kernel holds it.
    """
    known = version()
    if known == 0:
        return False
    libc = _libc()
    files = sum(rights for since, rights in FILE_RIGHTS if known >= since)
    net, scopes = (rights if known >= since else 0 for since, rights in (NET_RIGHTS, SCOPES))
    net = 0 if ports else net
    attributes = struct.pack("QQQ", files, net, scopes)
    # An older kernel takes a longer structure where it knows none of the rest.
    ruleset = libc.syscall(CREATE_RULESET, attributes, ctypes.c_size_t(len(attributes)), 0)
    if ruleset < 0:
        return False
    try:
        for folders, rights in ((write, files), (read, READ)):
            for folder in folders:
                if folder.is_dir() and not _allow(libc, ruleset, folder, rights):
                    return False
        no_more = libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0
        return bool(no_more and libc.syscall(RESTRICT_SELF, ruleset, 0) == 0)
    finally:
        os.close(ruleset)


def _allow(libc: ctypes.CDLL, ruleset: int, folder: Path, rights: int) -> bool:
    descriptor = os.open(folder, os.O_PATH | os.O_CLOEXEC)
    try:
        rule = struct.pack("=Qi", rights, descriptor)
        return bool(libc.syscall(ADD_RULE, ruleset, PATH_BENEATH, rule, 0) == 0)
    finally:
        os.close(descriptor)


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)
