"""Processes that do not import the program that a person runs."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

NAMES: Final = ("__file__", "__spec__")
"""By which `multiprocessing` finds the main module."""


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
