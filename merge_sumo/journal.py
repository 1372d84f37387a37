"""What a campaign remembers: a folder with settings, outcomes and trajectories.

campaign.json             every resolved setting, versions, hashes
outcomes.jsonl            one line per case, in order, synced after every batch
trajectories/00007.npz    the motion of every case of a batch
"""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import numpy as np

from merge_sumo.errors import UserError
from merge_sumo.score import Outcome
from merge_sumo.trajectory import End, Trajectory

SETTINGS: Final = "campaign.json"
OUTCOMES: Final = "outcomes.jsonl"
TRAJECTORIES: Final = "trajectories"

UNREADABLE_NPZ: Final = (OSError, EOFError, ValueError, TypeError, KeyError, zipfile.BadZipFile)
"""What numpy raises when a file is not the archive of arrays that it should be."""


class Journal:
    """Writes a campaign's folder; raises `UserError` when it exists or cannot be written."""

    def __init__(self, folder: Path, settings: dict[str, Any]) -> None:
        """Create the folder and write its settings; nothing that exists is touched."""
        self.folder = folder
        try:
            folder.mkdir(parents=True)
            (folder / TRAJECTORIES).mkdir()
            text = json.dumps(settings, indent=2, allow_nan=False) + "\n"
            (folder / SETTINGS).write_text(text, encoding="utf-8")
            (folder / OUTCOMES).touch()
        except FileExistsError as error:
            raise UserError(
                f"{folder} exists: choose another folder with --out, or remove it first"
            ) from error
        except OSError as error:
            raise UserError(f"cannot write {folder}: {error.strerror}") from error

    def append(self, ran: list[tuple[Outcome, Trajectory]]) -> None:
        """Write the outcomes of one batch and its trajectories, and sync them to the disk.

        The trajectories go first, so that every outcome on disk has its trajectory there.
        """
        outcomes, trajectories = zip(*ran, strict=True)
        try:
            with _batch_file(self.folder, outcomes[0].batch).open("wb") as file:
                np.savez(
                    file,
                    index=np.array([o.index for o in outcomes]),
                    rows=np.array([len(t.motion) for t in trajectories]),
                    motion=np.concatenate([t.motion for t in trajectories]),
                )
                file.flush()
                os.fsync(file.fileno())
            with (self.folder / OUTCOMES).open("a", encoding="utf-8") as file:
                file.writelines(to_line(outcome) for outcome in outcomes)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise UserError(f"cannot write {self.folder}: {error.strerror}") from error


class Run:
    """A finished or interrupted campaign, read from its folder.

    Raises `UserError` when the folder is no campaign or a line of it cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        """Read settings and outcomes; trajectories are read when they are asked for."""
        self.folder = folder
        settings = folder / SETTINGS
        try:
            self.settings: dict[str, Any] = json.loads(settings.read_text(encoding="utf-8"))
            text = (folder / OUTCOMES).read_bytes()
        except OSError as error:
            raise UserError(
                f"{folder} is not a campaign: cannot read {error.filename} ({error.strerror})"
            ) from error
        except ValueError as error:
            raise UserError(f"{settings} is not readable JSON: {error}") from error
        if not isinstance(self.settings, dict):
            raise UserError(f"{settings} is not a JSON object")
        self.outcomes, self.torn = read_outcomes(text, str(folder / OUTCOMES))
        self._batches: dict[int, dict[int, np.ndarray[Any, Any]]] = {}

    def outcome(self, index: int) -> Outcome:
        """Return the outcome of a case; `UserError` when the campaign has no such case."""
        if not 0 <= index < len(self.outcomes):
            raise UserError(
                f"{self.folder} has no case {index}: it has cases 0 to {len(self.outcomes) - 1}"
            )
        return self.outcomes[index]

    def trajectory(self, index: int) -> Trajectory:
        """Return the trajectory of a case; `UserError` when it is missing or unreadable."""
        outcome = self.outcome(index)
        path = _batch_file(self.folder, outcome.batch)
        if outcome.batch not in self._batches:
            try:
                with np.load(path, allow_pickle=False) as data:
                    parts = np.split(data["motion"], np.cumsum(data["rows"])[:-1])
                    batch = dict(zip(data["index"].tolist(), parts, strict=True))
            except UNREADABLE_NPZ as error:
                raise UserError(f"cannot read the trajectories in {path}: {error}") from error
            self._batches[outcome.batch] = batch
        motion = self._batches[outcome.batch].get(index)
        if motion is None:
            raise UserError(f"{path} has no trajectory of case {index}")
        measures = outcome.measures
        end = End.MERGED if measures.end is End.COLLISION else measures.end
        return Trajectory(outcome.case, motion, end, measures.error, measures.clipped_steps)


def to_line(outcome: Outcome) -> str:
    """Return the line of `outcomes.jsonl` for an outcome, with its line end."""
    return json.dumps(outcome.to_record(), allow_nan=False) + "\n"


def read_outcomes(text: bytes, name: str) -> tuple[list[Outcome], bool]:
    """Return the outcomes in the bytes of an `outcomes.jsonl`, and whether the last was torn.

    A last line without its end was being written when the campaign stopped: it is dropped. Any
    other line that is not the outcome of its place is an error that names the line.
    """
    lines = text.split(b"\n")
    torn = lines.pop() != b""
    outcomes = []
    for number, line in enumerate(lines, start=1):
        try:
            outcome = Outcome.from_record(json.loads(line))
            if outcome.index != number - 1:
                raise ValueError(f"index is {outcome.index}")
        except (ValueError, TypeError, KeyError, AttributeError, UserError) as error:
            raise UserError(
                f"line {number} of {name} is not the outcome of case {number - 1}: "
                f"{type(error).__name__} {error}"
            ) from error
        outcomes.append(outcome)
    return outcomes, torn


def failures(outcomes: Iterable[Outcome]) -> list[Outcome]:
    """Return the failing outcomes, the worst first."""
    return sorted((o for o in outcomes if o.failed), key=lambda o: (o.measures.score, o.index))


def _batch_file(folder: Path, batch: int) -> Path:
    return folder / TRAJECTORIES / f"{batch:05d}.npz"
