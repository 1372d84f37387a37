"""The name that a user may have meant."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from typing import Final

ALIKE: Final = 0.6
"""Ratio of matching characters from which on a name may have been meant."""
MOST: Final = 3


def nearest(name: str, known: Iterable[str], alike: float = ALIKE) -> list[str]:
    """Return the known names that are like one, at most three, the most like first.

    Upper and lower case are the same; a name that differs in that alone is the only one.

    Args:
        name: the name.
        known: the known names.
        alike: ratio of matching characters that they must have.
    """
    by_folded = {other.casefold(): other for other in known}
    if name.casefold() in by_folded:
        return [by_folded[name.casefold()]]
    return [by_folded[near] for near in get_close_matches(name.casefold(), by_folded, MOST, alike)]


def either(names: Iterable[str]) -> str:
    """Return names in words: a, b or c."""
    ordered = list(names)
    return ordered[0] if len(ordered) == 1 else f"{', '.join(ordered[:-1])} or {ordered[-1]}"


def meant(name: str, known: Iterable[str], alike: float = ALIKE) -> str:
    """Return "did you mean a or b? " where names are like one, else nothing.

    Args:
        name: the name.
        known: the known names.
        alike: ratio of matching characters that they must have.
    """
    near = nearest(name, known, alike)
    return f"did you mean {either(near)}? " if near else ""
