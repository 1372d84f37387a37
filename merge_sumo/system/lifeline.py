"""A process that ends with the one that started it, whatever native code it is in."""

from __future__ import annotations

import os
import select
import signal


def end_with(lifeline: int) -> None:
    """Have the system end this process when the other end of a pipe is closed.

    By a signal and not by a thread: native code that never returns would hold a thread up.
    """
    import fcntl

    asynchronous = getattr(os, "O_ASYNC", 0o20000)
    signal.signal(signal.SIGIO, signal.SIG_DFL)
    if hasattr(fcntl, "F_SETSIG"):  # a signal that nothing here can block or ignore
        fcntl.fcntl(lifeline, fcntl.F_SETSIG, signal.SIGKILL)
    fcntl.fcntl(lifeline, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(lifeline, fcntl.F_SETFL, fcntl.fcntl(lifeline, fcntl.F_GETFL) | asynchronous)
    # An end that was closed before sends no signal any more.
    ended = select.poll()
    ended.register(lifeline, 0)
    if ended.poll(0):
        os.kill(os.getpid(), signal.SIGKILL)
