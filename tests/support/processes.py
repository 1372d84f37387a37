"""What processes a test has left behind, by a mark that they inherit; waiting, and CPU time."""

from __future__ import annotations

import os
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest


def marked(mark: str) -> list[str]:
    """Return the command lines of the processes whose environment began with a mark."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            # What has ended and is not yet taken note of has no environment any more.
            if mark.encode() in (process / "environ").read_bytes():
                found.append((process / "cmdline").read_bytes().replace(b"\0", b" ").decode())
    return found


def wait_for(condition: Callable[[], object]) -> bool:
    """Wait until a condition holds; return whether it did in ten minutes or more."""
    for _ in range(12_000):
        if condition():
            return True
        time.sleep(0.05)
    return False


def cpu_s() -> float:
    """Return the CPU time of this process and of those of its children that it has waited for."""
    spent = os.times()
    return spent.user + spent.system + spent.children_user + spent.children_system


@contextmanager
def none_left() -> Iterator[str]:
    """Check that nothing that is started within, by whomever, is left a little later.

    Yields the mark.
    """
    with pytest.MonkeyPatch.context() as patch:
        mark = secrets.token_hex(8)
        patch.setenv("MERGE_SUMO_TEST", mark)
        yield mark
        assert wait_for(lambda: not marked(mark)), marked(mark)
