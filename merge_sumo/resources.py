"""Where files are: the net and the policies that travel with the package, the user's cache."""

from __future__ import annotations

import os
from pathlib import Path


def resource(name: str) -> Path:
    """Return the shipped folder `name` ("sumo_net" or "policies").

    A wheel carries the folders inside the package; a source tree has them next to it.
    """
    package = Path(__file__).resolve().parent
    shipped = package / "shipped" / name
    return shipped if shipped.is_dir() else package.parent / name


def cache_folder() -> Path:
    """Return the folder of the cache: MERGE_SUMO_CACHE, or the user's cache folder."""
    named = os.environ.get("MERGE_SUMO_CACHE")
    if named:
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "merge-sumo"
