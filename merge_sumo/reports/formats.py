"""The formats of `merge-sumo export` by name; here, where their names cost no import."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from merge_sumo.system.registry import Registry

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


FORMATS: Final[Registry[ExportFormat]] = Registry(
    "merge_sumo.exports",
    "format",
    {
        "sumo": "merge_sumo.reports.exports:SUMO",
        "openscenario": "merge_sumo.reports.exports:OPENSCENARIO",
        "csv": "merge_sumo.reports.exports:CSV",
        "parquet": "merge_sumo.reports.exports:PARQUET",
    },
    accepts=lambda item: (
        isinstance(item, ExportFormat) and (item.write_case is None) != (item.write_table is None)
    ),
    contract="a merge_sumo.reports.formats.ExportFormat with one function that writes",
)
