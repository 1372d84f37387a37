"""Packages of others, as pip leaves them."""

from __future__ import annotations

from pathlib import Path


def install(folder: Path, package: str, source: str, group: str, entries: str) -> None:
    """Write a package of one module, with entry points of a group, into a folder."""
    (folder / f"{package}.py").write_text(source)
    info = folder / f"{package}-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1\n")
    (info / "entry_points.txt").write_text(f"[{group}]\n{entries}\n")
