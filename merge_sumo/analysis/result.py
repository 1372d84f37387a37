"""The base of what the verbs of the API return: a JSON record, and lines for a terminal."""

from __future__ import annotations

from abc import abstractmethod
from html import escape
from typing import Any

from merge_sumo.system.printable import printable


class Result:
    """A result: `print` and a notebook show its lines, `repr` the first of them."""

    __slots__ = ()

    @abstractmethod
    def to_record(self) -> dict[str, Any]:
        """Return what `--json` prints."""

    @abstractmethod
    def lines(self) -> list[str]:
        """Return what a command prints."""

    def __str__(self) -> str:
        """Return the lines as a text; control characters are escaped."""
        return "\n".join(map(printable, self.lines()))

    def __repr__(self) -> str:
        """Return the first line."""
        first = " ".join(self.lines()[0].split())
        return f"<{type(self).__name__}: {printable(first)}>"

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>"
