"""The software that decides on outcomes, and where it differs between two places."""

from __future__ import annotations

import platform
from importlib.metadata import version
from typing import Any, Final

from merge_sumo.engine.povs import Povs

POLICY: Final = "policy "
"""Begins the name of a policy among the software."""


def versions() -> dict[str, str]:
    """Return the versions that decide the outcome of a case."""
    packages = ("merge-sumo", "libsumo", "numpy", "scipy", "scikit-learn")
    return {"python": platform.python_version()} | {name: version(name) for name in packages}


def software(povs: Povs | None = None) -> dict[str, str]:
    """Return the versions, and the hashes of the policies, by name."""
    policies = (povs or Povs()).sha256()
    return versions() | {f"{POLICY}{name}": sha256 for name, sha256 in policies.items()}


def differences(was: Any, now: Any, name: str = "") -> dict[str, tuple[Any, Any]]:
    """Return by name where two records differ, with both values; None where there is none."""
    if isinstance(was, dict) and isinstance(now, dict):
        found: dict[str, tuple[Any, Any]] = {}
        for key in now | was:
            inner = f"{name}.{key}" if name else key
            found |= differences(was.get(key), now.get(key), inner)
        return found
    was, now = (list(value) if isinstance(value, tuple) else value for value in (was, now))
    return {} if was == now else {name: (was, now)}
