"""Child processes that import neither the main module nor modules of the working folder.

They may end with the process that started them, whatever native code they run.
"""

from __future__ import annotations

import importlib
import json
import os
import select
import signal
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

BOOT = (
    "import json, sys; settings = json.loads(sys.argv[-1]); sys.path[:] = settings['path']; "
    f"from {__name__} import named; named(settings['main'])(settings)"
)
NAMES = ("__file__", "__spec__")
"""By which `multiprocessing` finds the main module."""
SAFE_PATH = "PYTHONSAFEPATH"
OURS = "merge-sumo"
"""Its value where we have set it: any text does."""


@contextmanager
def without_main() -> Iterator[None]:
    """Let processes that are started meanwhile begin without the main module.

    `multiprocessing` imports it into every new process: from standard input or a prompt there is no
    such file, and a script without a main guard would begin again in each. Our workers are told
    nothing that is defined there, so they do without.
    """
    main = sys.modules["__main__"].__dict__
    hidden: dict[str, Any] = {name: main.pop(name) for name in NAMES if name in main}
    main["__spec__"] = None
    try:
        yield
    finally:
        del main["__spec__"]
        main.update(hidden)


@contextmanager
def without_cwd() -> Iterator[None]:
    """Let processes that are started meanwhile import nothing from the working directory.

    `multiprocessing` starts them by `python -c`, which looks there first: a `json.py` in a folder
    that was received would run. The process calls `forget_safe_path`: the programs that it
    starts in turn may be a user's.
    """
    if os.environ.get(SAFE_PATH):
        yield
        return
    os.environ[SAFE_PATH] = OURS
    try:
        yield
    finally:
        os.environ.pop(SAFE_PATH, None)


def forget_safe_path() -> None:
    """Let what this process starts find its modules where it always does."""
    if os.environ.get(SAFE_PATH) == OURS:
        del os.environ[SAFE_PATH]


def python_command(main: str, settings: Mapping[str, Any]) -> list[str]:
    """Return a command that calls a function with settings in a new interpreter.

    It imports modules from where this process does and from nowhere else; the settings travel as
    JSON.

    Args:
        main: the function, "MODULE:FUNCTION".
        settings: its argument, as JSON has it.
    """
    told = {**settings, "main": main, "path": sys.path}
    return [sys.executable, "-P", "-c", BOOT, json.dumps(told)]


def named(name: str) -> Any:
    """Return an object by its name.

    Args:
        name: "MODULE:NAME".
    """
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)


def end_with(lifeline: int) -> None:
    """Have the system end this process when the other end of a pipe is closed.

    By a signal and not by a thread: native code that never returns would hold a thread up.

    Args:
        lifeline: file descriptor of this end of the pipe.
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
