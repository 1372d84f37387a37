"""The base class of results: a JSON record, and lines for a terminal."""

from __future__ import annotations

from dataclasses import dataclass
from functools import singledispatch
from html import escape
from typing import Any, ClassVar

from merge_sumo.printable import printable
from merge_sumo.records import to_plain


@singledispatch
def lines_of(result: Result) -> list[str]:
    """Return the lines of a result, as `reports/text.py` writes them for each study.

    Args:
        result: the result.
    """
    raise TypeError(f"{type(result).__name__} has no lines")


class Result:
    """A result: `print` and a notebook show its lines, `repr` shows the first line.

    Control characters are escaped.
    """

    __slots__ = ()
    computed: ClassVar[tuple[str, ...]] = ()
    """Properties that `--json` prints with the fields."""

    @property
    def is_good(self) -> bool:
        """Whether the exit code of the command is 0, and not 1."""
        return True

    def to_record(self) -> dict[str, Any]:
        """Return the object that `--json` prints."""
        record: dict[str, Any] = to_plain(self)
        return record | {name: to_plain(getattr(self, name)) for name in self.computed}

    def lines(self) -> list[str]:
        """Return the lines that a command prints."""
        return lines_of(self)

    def __str__(self) -> str:
        return "\n".join(map(printable, self.lines()))

    def __repr__(self) -> str:
        first = " ".join(self.lines()[0].split())
        return f"<{type(self).__name__}: {printable(first)}>"

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>"


@dataclass(frozen=True, slots=True, repr=False)
class Shown(Result):
    """A result without attributes of its own: the object that `--json` prints, and lines of text.

    Attributes:
        record: the object that `--json` prints.
        text: the lines.
    """

    record: dict[str, Any]
    text: list[str]

    def to_record(self) -> dict[str, Any]:
        """Return the object that `--json` prints."""
        return self.record

    def lines(self) -> list[str]:
        """Return the lines of text."""
        return self.text
