"""Results that say themselves in lines: as a command prints them, and so in a notebook."""

from __future__ import annotations

from abc import abstractmethod
from html import escape

from merge_sumo.system.printable import printable


class InLines:
    """What `print` and a notebook show as lines; `repr` is the first of them."""

    __slots__ = ()

    @abstractmethod
    def lines(self) -> list[str]:
        """Return what a person reads, line by line."""

    def __str__(self) -> str:
        """Return the lines as a text; control characters are escaped."""
        return "\n".join(map(printable, self.lines()))

    def __repr__(self) -> str:
        """Return the first line."""
        first = " ".join(self.lines()[0].split())
        return f"<{type(self).__name__}: {printable(first)}>"

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>"
