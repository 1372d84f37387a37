"""Which files of the user's a VUT is made of: what it imported, opened for reading, or linked."""

from __future__ import annotations

import os
import re
import site
import sys
import sysconfig
from pathlib import Path
from typing import Any, Final

from merge_sumo.system.resources import resource

SYSTEM: Final = ("/proc", "/sys", "/dev", "/etc", "/usr/lib", "/usr/share", "/lib", "/run")
METADATA: Final = re.compile(r"\.dist-info.(entry_points\.txt|METADATA)$")
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
        self._not_theirs = tuple(f"{folder}{os.sep}" for folder in _not_theirs())
        self._before = set(sys.modules)
        sys.addaudithook(self._audit)

    def files(self) -> set[str]:
        """Return the paths of the files so far."""
        modules: list[Any] = [m for n, m in list(sys.modules.items()) if n not in self._before]
        imported = [str(getattr(module, "__file__", None) or "") for module in modules]
        sources = {os.path.realpath(file) for file in imported if file}
        paths = sources | self._read - self._written
        return {path for path in paths if self._theirs(path) and Path(path).is_file()}

    def _theirs(self, path: str) -> bool:
        # Compiled modules stand for their sources, which are in `sys.modules`; what packages are
        # installed is read to find the kind of the VUT.
        no_source = path.endswith(".pyc") or METADATA.search(path) is not None
        return not path.startswith(self._not_theirs) and not no_source

    def _audit(self, event: str, arguments: tuple[Any, ...]) -> None:
        if len(self._read) + len(self._written) > MOST_FILES:
            return
        if event == "open":
            path, mode, flags = arguments
        elif event == "ctypes.dlopen":
            path, mode, flags = *arguments, None, os.O_RDONLY
        else:
            return
        if not isinstance(path, str | bytes):
            return  # a descriptor, opened before
        try:
            real_path = os.path.realpath(os.fsdecode(path))
        except (OSError, ValueError):  # the name is none; the VUT shall hear it from `open`
            return
        reads = isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR) == 0
        if isinstance(mode, str):
            reads = not set(mode) & set("wax+")
        (self._read if reads else self._written).add(real_path)


def _not_theirs() -> set[str]:
    installed = [sys.prefix, sys.base_prefix, sys.exec_prefix, *site.getsitepackages()]
    installed += [site.getusersitepackages(), *sysconfig.get_paths().values()]
    ours = [Path(__file__).parents[2], resource("policies"), resource("sumo_net")]
    return {os.path.realpath(folder) for folder in (*installed, *map(str, ours), *SYSTEM)} - {"/"}
