"""Python files that a user names: `FILE.py:NAME`. Nothing else in a folder is code."""

from __future__ import annotations

import importlib.util
import sys
from functools import cache
from pathlib import Path
from types import ModuleType


def module_of_file(path: Path) -> ModuleType:
    """Return the module that a file holds; it is executed once, and again when it has changed.

    Modules beside it are found. Raises OSError where it cannot be read, and what its code raises.
    """
    return _executed(path.resolve(), path.stat().st_mtime_ns)


@cache
def _executed(path: Path, _changed_ns: int) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"merge_sumo_file_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise ImportError("it is no Python file")
    module = importlib.util.module_from_spec(spec)
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))  # for the modules beside it
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
