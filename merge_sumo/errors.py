"""Errors and warnings for the user: one sentence that says what to do."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

MOST_CHARACTERS = 10_000
"""Maximum length of a sentence: it may quote a received file."""


class UserError(Exception):
    """Wrong input, or a missing part of the installation, in one sentence with a remedy.

    The command line prints the sentence and exits with code 2.
    """

    def __init__(self, sentence: str) -> None:
        """Take the sentence, in one line.

        Args:
            sentence: the problem and the remedy. It may quote several lines of a library.
        """
        super().__init__(" ".join(sentence[:MOST_CHARACTERS].splitlines()))

    def _render_traceback_(self) -> list[str]:
        """Return the lines that a notebook shows: the sentence, without a traceback."""
        return [f"{type(self).__name__}: {self}", *getattr(self, "__notes__", ())]


@contextmanager
def explained(clause: str) -> Iterator[None]:
    """Within `with`, put a clause in front of the sentence of a `UserError`.

    Args:
        clause: the problem; the sentence gives its cause.
    """
    try:
        yield
    except UserError as error:
        raise type(error)(f"{clause}: {error}") from error


class ControllerError(UserError):
    """The code of a controller fails before it drives, or its process ends."""


class WorkersLostError(UserError):
    """The cluster whose workers ran the cases is gone; finished cases may be kept."""


class Notice(UserWarning):
    """A warning about a result. The command line prints it as a note."""


def notice(sentence: str, category: type[Warning] = Notice) -> None:
    """Warn the caller of the package, however many calls above.

    Args:
        sentence: the warning.
        category: its type.
    """
    frame: FrameType | None = sys._getframe(1)
    level = 2
    while frame is not None and frame.f_globals.get("__name__", "").startswith("merge_sumo."):
        frame, level = frame.f_back, level + 1
    warnings.warn(sentence, category, stacklevel=level)
