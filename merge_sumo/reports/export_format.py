"""The type of a format of `merge-sumo export`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from pathlib import Path

    from merge_sumo.campaigns.run import Run
    from merge_sumo.road.corridor import Corridor

EXPORTS: Final = "exports"


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportFormat:
    """A format of cases; one of the two functions writes it.

    Attributes:
        about: what is written, in a sentence without its full stop.
        write_case: writes the case of an index into a new folder, and returns the file to open.
        write_table: writes cases into a new file of a folder, and returns its path.
        below: folder in that of the campaign, where a person names none.
    """

    about: str
    write_case: Callable[[Run, int, Path, Corridor], Path] | None = None
    write_table: Callable[[Run, Sequence[int], Path], Path] | None = None
    below: str = EXPORTS
