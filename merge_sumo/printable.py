"""Names in sentences: as a terminal and a shell may see them, and which one a user may mean."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path
from unicodedata import category


def printable(text: str) -> str:
    """Return a text with control characters, line ends and invalid characters escaped.

    Args:
        text: any text.
    """
    return "".join(
        letter
        if letter.isprintable() or category(letter) == "Zs"
        else letter.encode("unicode_escape").decode()
        for letter in text
    )


def sentence(text: str) -> str:
    """Return a text with a capital letter and a full stop.

    Args:
        text: a text that is not empty.
    """
    return f"{text[0].upper()}{text[1:].removesuffix('.')}."


def counted(number: int, what: str) -> str:
    """Return a number of things in words: 1 case, 2 cases.

    Args:
        number: the number.
        what: the thing in the singular.
    """
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def quoted(argument: str | Path) -> str:
    """Return an argument of a command to paste into a shell.

    What cannot be printed is written as bytes in `$'...'`, which bash, zsh and ksh read.

    Args:
        argument: the argument.
    """
    text = str(argument)
    if text.isprintable():
        return shlex.quote(text)
    plain = "".join(
        letter
        if letter.isascii() and letter.isprintable() and letter not in "'\\"
        else "".join(f"\\x{byte:02x}" for byte in os.fsencode(letter))
        for letter in text
    )
    return f"$'{plain}'"


def either(names: Iterable[str]) -> str:
    """Return names in words: a, b or c.

    Args:
        names: one or more names.
    """
    ordered = list(names)
    return ordered[0] if len(ordered) == 1 else f"{', '.join(ordered[:-1])} or {ordered[-1]}"


def meant(name: str, known: Iterable[str], alike: float = 0.6) -> str:
    """Return "did you mean a or b? " where known names are like a name, else nothing.

    Args:
        name: the name; its case does not matter.
        known: the known names.
        alike: ratio of matching characters that they must have, from 0 to 1.
    """
    by_folded = {other.casefold(): other for other in known}
    near = get_close_matches(name.casefold(), by_folded, 3, alike)
    if not near:
        return ""
    return f"did you mean {either([by_folded[folded] for folded in near])}? "
