"""Names and messages that come from outside, as a terminal and a shell may see them."""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from unicodedata import category


def printable(text: str) -> str:
    """Return a text with control characters, line ends and invalid characters escaped."""
    return "".join(
        letter
        if letter.isprintable() or category(letter) == "Zs"
        else letter.encode("unicode_escape").decode()
        for letter in text
    )


def counted(number: int, what: str) -> str:
    """Return a number of things in words."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def quoted(argument: str | Path) -> str:
    """Return an argument of a command to paste into a shell.

    What cannot be printed is written as bytes in `$'...'`, which bash, zsh and ksh read.
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
