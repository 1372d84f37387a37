"""The name that a person may have meant."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import SequenceMatcher
from typing import Final

ALIKE: Final = 0.6
"""Ratio of matching characters from which on a name may have been meant."""
MOST: Final = 3


def nearest(name: str, known: Iterable[str], alike: float = ALIKE) -> list[str]:
    """Return the known names that are like one, at most three, the most like first.

    Upper and lower case are the same; a name that differs in that alone is the only one.
    """
    folded = name.casefold()
    found: list[tuple[float, int, str]] = []
    matcher = SequenceMatcher(None, "", folded)
    for other in known:
        if other.casefold() == folded:
            return [other]
        matcher.set_seq1(other.casefold())
        # The first two are quick and never below the third: nets have thousands of names.
        ratios = (matcher.real_quick_ratio, matcher.quick_ratio, matcher.ratio)
        if all((ratio := of()) >= alike for of in ratios):
            found.append((-ratio, len(found), other))
    return [other for _, _, other in sorted(found)[:MOST]]


def either(names: Iterable[str]) -> str:
    """Return names in words: a, b or c."""
    ordered = list(names)
    return ordered[0] if len(ordered) == 1 else f"{', '.join(ordered[:-1])} or {ordered[-1]}"


def meant(name: str, known: Iterable[str], alike: float = ALIKE) -> str:
    """Return "did you mean a or b? " where names are like one, else nothing."""
    near = nearest(name, known, alike)
    return f"did you mean {either(near)}? " if near else ""
