"""Limits of the system on which a command fails: found before it runs, or named when it does."""

from __future__ import annotations

import errno
from contextlib import suppress

from merge_sumo.errors import UserError

ADDRESS_SPACE_GIB = 2.0
"""Below this SUMO, or the libraries of linear algebra, end the process without a word."""
EXHAUSTED = {
    errno.EMFILE: "too many files are open: raise the limit (`ulimit -n`)",
    errno.ENFILE: "too many files are open in the whole system: close some programs",
    errno.EAGAIN: "the system cannot start more processes: raise the limit (`ulimit -u`)",
    errno.ENOMEM: "the memory is full: use fewer `workers`, or raise the limit (`ulimit -v`)",
    errno.EFBIG: "a file would exceed the limit of its size: raise it (`ulimit -f`)",
    errno.ENOSPC: "the disk is full: free space, or choose another folder with `out` and TMPDIR",
    errno.EDQUOT: "the disk quota is used up: free space, or choose another folder",
    errno.EROFS: "the disk is read-only: choose another folder with `out` and TMPDIR",
    errno.EIO: "a disk or a terminal failed: try again",
}
"""Advice where the system refuses more, by its error."""


def check_limits() -> None:
    """Raise `UserError` where this process may not have the memory that it takes."""
    with suppress(ImportError):  # Windows
        import resource

        most, _ = resource.getrlimit(resource.RLIMIT_AS)
        if most != resource.RLIM_INFINITY and most < ADDRESS_SPACE_GIB * 2**30:
            raise UserError(
                f"the limit of address space (`ulimit -v`) is {most / 2**30:.2g} GiB: raise it "
                f"to {ADDRESS_SPACE_GIB:g} GiB or more"
            )


def lower_limits(**most: int) -> None:
    """Let something run out in this process before it runs out for all others.

    Args:
        most: the limit by its name, as `RLIMIT_DATA`.
    """
    with suppress(ImportError):  # Windows
        import resource

        for name, limit in most.items():
            with suppress(ValueError, OSError):  # a limit of the system may be lower
                resource.setrlimit(getattr(resource, name), (limit, limit))


def exhausted(error: BaseException) -> str | None:
    """Return advice on an error of the system that is not a fault of the program, or None.

    Args:
        error: any error.
    """
    if isinstance(error, OSError) and error.errno in EXHAUSTED:
        where = f"{error.filename}: " if isinstance(error.filename, str) else ""
        return where + EXHAUSTED[error.errno]
    if isinstance(error, MemoryError):
        return EXHAUSTED[errno.ENOMEM]
    if isinstance(error, RuntimeError) and str(error) == "can't start new thread":
        return EXHAUSTED[errno.EAGAIN]
    return None
