"""Who writes what a campaign remembers: one process, whole batches, synced.

A bit that flips on a disk or on a way is found: `campaign.json` has a hash of itself, a batch's
file that of its lines, and its zip archive a checksum of every array.
"""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from merge_sumo.campaigns.ownership import note_run
from merge_sumo.campaigns.run import (
    CHECKSUM,
    OUTCOMES,
    SETTINGS,
    TRAJECTORIES,
    Run,
    batch_file,
    settings_sha256,
    to_line,
)
from merge_sumo.errors import UserError
from merge_sumo.system.anchors import Anchor
from merge_sumo.system.folders import check_own, new_folder, replace_own, sync_folder
from merge_sumo.system.printable import quoted
from merge_sumo.system.trust import begun_here
from merge_sumo.values.score import Outcome
from merge_sumo.values.signals import to_record
from merge_sumo.values.trajectory import Trajectory

Batch = list[tuple[Outcome, Trajectory]]
MOST_SYNCS: Final = 8
"""Files that are synced at the same time."""


class Journal:
    """Writes a campaign's folder, as the only process that does; to be used in `with`.

    The folder appears whole or not at all, and what was appended once stays.
    """

    def __init__(self, folder: Path, place: Anchor, outcomes: io.FileIO, *, begun: bool) -> None:
        """Take the folder by name and as it is held, and its open outcomes.

        Use `create` or `reopen`. `begun` is whether this user began the campaign there.
        """
        self.folder = folder
        self._place = place
        self._begun = begun
        self._outcomes = outcomes
        self._threads = ThreadPoolExecutor(MOST_SYNCS)
        _lock(outcomes, folder)

    @classmethod
    def create(cls, folder: Path, settings: dict[str, Any]) -> Self:
        """Create the folder with its settings; `UserError` when it exists or cannot be written."""
        with new_folder(folder) as new, ExitStack() as undo:
            (new / TRAJECTORIES).mkdir()
            _write(new / SETTINGS, _settings_text(settings))
            place = Anchor(new)
            undo.callback(place.close)
            journal = cls(folder, place, (new / OUTCOMES).open("wb", buffering=0), begun=True)
            note_run(new, folder, settings, begun=True)  # before a kill can leave the folder alone
            sync_folder(new)
            undo.pop_all()
        return journal

    @classmethod
    def reopen(cls, folder: Path) -> tuple[Self, Run, int]:
        """Return the journal of a campaign to go on with, what it holds, and what was dropped.

        Dropped are outcomes, whole or torn, of a batch that was not written to its end: they are
        run again. Raises `UserError` when another process writes the folder, when a link in it
        leads elsewhere, or as `Run` does.
        """
        check_own(*(folder / name for name in (SETTINGS, OUTCOMES, TRAJECTORIES)))
        check_own(*(folder / TRAJECTORIES).glob("*"))
        undo = ExitStack()
        try:
            place = Anchor(folder)
            undo.callback(place.close)
            outcomes = (place.path / OUTCOMES).open("r+b", buffering=0)
            undo.callback(outcomes.close)
        except OSError as error:
            undo.close()
            if error.errno in (errno.ENOENT, errno.ENOTDIR):
                raise UserError(
                    f"{folder} is not a campaign to go on with: it has no {OUTCOMES}"
                ) from error
            raise UserError(f"cannot write {folder}: {error.strerror}") from error
        try:
            journal = cls(folder, place, outcomes, begun=begun_here(folder, SETTINGS))
            run = Run(folder)
            whole = run.outcomes[: run.whole_batches()]
            dropped = len(run.outcomes) - len(whole) + run.torn
            run.outcomes = whole
            if dropped:
                outcomes.seek(0)
                length = sum(len(line) for line, _ in zip(outcomes, whole, strict=False))
                outcomes.truncate(length)
                os.fsync(outcomes.fileno())
        except OSError as error:
            undo.close()
            raise UserError(f"cannot write {folder}: {error.strerror}") from error
        except BaseException:
            undo.close()
            raise
        return journal, run, dropped

    def append(self, *batches: Batch) -> None:
        """Write the outcomes of batches and their trajectories, and sync them to the disk.

        The trajectories go first, so that every outcome on disk has its trajectory there. Raises
        `UserError` when they cannot be written; what was there before stays. A disk syncs several
        batches at once in little more time than one.
        """
        paths = [batch_file(self._place.path, batch[0][0].batch) for batch in batches]
        lines, arrays = zip(*map(_encoded, batches), strict=True)
        try:
            end = self._outcomes.seek(0, os.SEEK_END)
            list(self._threads.map(_write, paths, arrays))
            sync_folder(self._place.path / TRAJECTORIES)
            try:
                _write_all(self._outcomes, b"".join(lines))
            except OSError:
                self._outcomes.truncate(end)
                raise
        except OSError as error:
            raise UserError(
                f"cannot write {self.folder}: {error.strerror}; what ran before is kept: go on "
                f"with `merge-sumo campaign --resume {quoted(self.folder)}`"
            ) from error

    def rewrite_settings(self, settings: dict[str, Any]) -> None:
        """Put other settings in the place of those that were there, all or nothing."""
        replace_own(self.folder / SETTINGS, _settings_text(settings), place=self._place.path)
        self.note_own(settings)

    def note_own(self, settings: dict[str, Any]) -> None:
        """Remember that this user runs the code that the settings name, from this folder."""
        note_run(self.folder, self.folder, settings, begun=self._begun)

    def __enter__(self) -> Self:
        """Return the journal."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the folder; another process may write it."""
        self._threads.shutdown()
        self._outcomes.close()
        self._place.close()


def _encoded(batch: Batch) -> tuple[bytes, bytes]:
    """Return the lines of a batch, and the file of its trajectories."""
    outcomes, trajectories = zip(*batch, strict=True)
    lines = "".join(map(to_line, outcomes)).encode()
    signals = {str(o.index): to_record(t.signals) for o, t in batch if t.signals}
    text = json.dumps(signals, allow_nan=False).encode()
    kept: dict[str, Any] = {"signals": np.frombuffer(text, np.uint8)} if signals else {}
    arrays = io.BytesIO()
    np.savez(
        arrays,
        **kept,
        index=np.array([o.index for o in outcomes]),
        rows=np.array([len(t.motion) for t in trajectories]),
        motion=np.concatenate([t.motion.reshape(len(t.motion), -1) for t in trajectories]),
        lines_sha256=hashlib.sha256(lines).hexdigest(),
    )
    return lines, arrays.getvalue()


def _settings_text(settings: dict[str, Any]) -> bytes:
    record = {**settings, CHECKSUM: settings_sha256(settings)}
    return (json.dumps(record, indent=2, allow_nan=False) + "\n").encode()


def _lock(outcomes: io.FileIO, folder: Path) -> None:
    """Refuse when another process holds the lock; it goes with the process, however that ends."""
    if sys.platform == "win32":  # no flock there
        return
    import fcntl

    try:
        fcntl.flock(outcomes, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        outcomes.close()
        raise UserError(f"another process writes {folder}: wait until it has ended") from error


def _write(path: Path, content: bytes) -> None:
    """Write a file and sync it to the disk."""
    with path.open("wb", buffering=0) as file:
        _write_all(file, content)


def _write_all(file: io.FileIO, content: bytes) -> None:
    # Unbuffered: after an error, nothing is left that closing the file would write after all.
    rest = memoryview(content)
    while rest:
        rest = rest[file.write(rest) :]
    os.fsync(file.fileno())
