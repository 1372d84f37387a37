"""Where the files that travel with the package are: the net and the policies."""

from __future__ import annotations

from pathlib import Path


def resource(name: str) -> Path:
    """Return the shipped folder `name` ("sumo_net" or "policies").

    A wheel carries the folders inside the package; a source tree has them beside it.
    """
    package = Path(__file__).resolve().parent
    shipped = package / "shipped" / name
    return shipped if shipped.is_dir() else package.parent / name
