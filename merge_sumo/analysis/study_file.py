"""Files of studies in the folder of a campaign: each is declared once, with what it holds.

A file of a folder which somebody sent is data as everything in it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from merge_sumo.campaigns.run import Run
from merge_sumo.folders import check_ours, replace_own
from merge_sumo.records import Record, read_record, to_json

R = TypeVar("R", bound=Record)


@dataclass(frozen=True, slots=True)
class StudyFile(Generic[R]):
    """A file of a campaign: JSON with one record, or a line for each of some failures.

    Attributes:
        name: of the file.
        kind: type of the record, or of a line, which has an `index`.
    """

    name: str
    kind: type[R]

    def check(self, folder: Path) -> None:
        """Raise `UserError` where a file of this name is not ours to replace."""
        check_ours(folder / self.name, self.kind.__struct_fields__)

    def read(self, folder: Path) -> R | None:
        """Read the record; None without the file, `UserError` where it is not as it was written."""
        return read_record(folder / self.name, self.kind)

    def write(self, folder: Path, record: R) -> None:
        """Write the record, in the place of an older one."""
        replace_own(folder / self.name, to_json(record, indent=1))

    def read_lines(self, run: Run) -> dict[int, R]:
        """Read the lines by index; `UserError` for one that is not of a failure of the campaign."""
        failing = {outcome.index for outcome in run.outcomes if outcome.failed}
        return run.read_lines(self.name, self.kind, failing)

    def write_lines(self, folder: Path, lines: Iterable[R]) -> None:
        """Write lines, in the place of older ones."""
        replace_own(folder / self.name, b"".join(map(to_json, lines)))
