"""Names in sentences: as a terminal and a shell may see them, and which one a user may mean."""

from __future__ import annotations

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

    What cannot be printed is escaped as in a sentence, so a shell does not find such a name.

    Args:
        argument: the argument.
    """
    return shlex.quote(printable(str(argument)))


def either(names: Iterable[str]) -> str:
    """Return names in words: a, b or c.

    Args:
        names: one or more names.
    """
    ordered = list(names)
    return ordered[0] if len(ordered) == 1 else f"{', '.join(ordered[:-1])} or {ordered[-1]}"


def meant(name: str, known: Iterable[str]) -> str:
    """Return "did you mean a or b? " where known names are like a name, else nothing.

    Args:
        name: the name.
        known: the known names.
    """
    near = get_close_matches(name, list(known))
    return f"did you mean {either(near)}? " if near else ""
