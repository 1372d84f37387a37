"""Which files of the user's a VUT is made of: what it imported, opened for reading, or linked."""

from __future__ import annotations

import os
import site
import sys
import sysconfig
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from merge_sumo.system.resources import resource

SYSTEM: Final = ("/proc", "/sys", "/dev", "/etc", "/usr/lib", "/usr/share", "/lib", "/run")
MOST_FILES: Final = 10_000
"""That are remembered; a VUT may open files for ever."""


class LoadedFiles:
    """Notes files from the moment it is made, by what the interpreter tells its auditors.

    Not noted are files of the interpreter and its packages, of the system and of this package,
    those that the VUT itself wrote, and what native code opens by itself.
    """

    def __init__(self) -> None:
        """Listen; there is no way to stop that, so make one in a process of its own."""
        self._read: set[str] = set()
        self._written: set[str] = set()
        self._libraries: set[str] = set()
        self._not_theirs = tuple(f"{folder}{os.sep}" for folder in _not_theirs())
        self._before = set(sys.modules)
        sys.addaudithook(self._audit)

    def files(self) -> set[str]:
        """Return the paths of the files so far."""
        return self.code() | set(filter(self._is_theirs, self._read - self._written))

    def code(self) -> set[str]:
        """Return those of modules and libraries."""
        modules: list[Any] = [m for n, m in list(sys.modules.items()) if n not in self._before]
        imported = [str(getattr(module, "__file__", None) or "") for module in modules]
        sources = {os.path.realpath(file) for file in imported if file}
        return set(filter(self._is_theirs, sources | self._libraries))

    def _is_theirs(self, path: str) -> bool:
        # Compiled modules stand for their sources, which are in `sys.modules`.
        ours = path.startswith(self._not_theirs) or path.endswith(".pyc")
        return not ours and ".dist-info" + os.sep not in path and Path(path).is_file()

    def _audit(self, event: str, arguments: tuple[Any, ...]) -> None:
        if len(self._read) + len(self._written) > MOST_FILES:
            return
        if event == "open":
            path, mode, flags = arguments
            reads = isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR) == 0
            files = self._read if reads and not set(mode or "") & set("wax+") else self._written
        elif event == "ctypes.dlopen":
            (path,), files = arguments, self._libraries
        else:
            return
        if not isinstance(path, str | bytes):
            return  # a descriptor, opened before
        with suppress(OSError, ValueError):  # the name is none; the VUT shall hear it from `open`
            files.add(os.path.realpath(os.fsdecode(path)))


def _not_theirs() -> set[str]:
    installed = [sys.prefix, sys.base_prefix, sys.exec_prefix, *site.getsitepackages()]
    installed += [site.getusersitepackages(), *sysconfig.get_paths().values()]
    ours = [Path(__file__).parents[2], resource("policies"), resource("sumo_net")]
    return {os.path.realpath(folder) for folder in (*installed, *map(str, ours), *SYSTEM)} - {"/"}
