"""The writer of the folder of a campaign (`run.py`): one process, and whole groups of episodes.

The trajectories of a group go first, so that every outcome on disk has its trajectory there.
"""

from __future__ import annotations

import io
import json
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

import numpy as np

from merge_sumo.campaigns.again import again
from merge_sumo.campaigns.run import (
    FILES,
    IN_VAIN,
    OUTCOMES,
    RAN_AGAIN,
    SETTINGS,
    TRAJECTORIES,
    Run,
    batch_file,
)
from merge_sumo.errors import UserError
from merge_sumo.files import check_own, make_folder, replace_own, sync_folder, write_folder
from merge_sumo.metrics.outcome import Episode, Outcome
from merge_sumo.records import to_json
from merge_sumo.scenario.signals import to_record

MOST_SYNCS = 8
"""Files that are synced at the same time."""


def to_line(outcome: Outcome) -> str:
    """Return the line of `outcomes.jsonl` for an outcome, with its line end."""
    return json.dumps(outcome.to_record(), allow_nan=False) + "\n"


class Journal:
    """Writes a campaign's folder, as the only process that does; to be used in `with`.

    A folder with settings is whole, and what was appended once stays.

    Attributes:
        folder: the folder.
        settings: what `campaign.json` holds.
        earlier: the journal of the earlier version, where the campaign is against one.
    """

    def __init__(self, folder: Path, outcomes: io.FileIO, settings: dict[str, Any]) -> None:
        """Take an open folder; use `create` or `reopen`.

        Args:
            folder: the folder.
            outcomes: its `outcomes.jsonl`, open for reading and writing.
            settings: content of its `campaign.json`.
        """
        self.folder, self.settings = folder, settings
        self.earlier: Self | None = None
        self._outcomes = outcomes
        self._threads = ThreadPoolExecutor(MOST_SYNCS)
        _lock(outcomes, folder)
        make_folder(folder / TRAJECTORIES, exist_ok=True)

    @classmethod
    def create(cls, folder: Path, settings: dict[str, Any]) -> Self:
        """Create the folder with its settings; `UserError` when it exists or cannot be written."""
        write_folder(folder, {OUTCOMES: b"", SETTINGS: _settings_text(settings)})
        return cls(folder, (folder / OUTCOMES).open("r+b", buffering=0), settings)

    @classmethod
    def reopen(cls, folder: Path) -> tuple[Self, Run, int]:
        """Return the journal of a stopped campaign, the campaign, and the number of lost outcomes.

        The outcomes of a batch that was not written to its end are dropped: its cases run again.

        Raises:
            UserError: another process writes the folder, a link in it leads elsewhere, or `Run`
                cannot read it.
        """
        check_own(*(folder / name for name in (SETTINGS, OUTCOMES, TRAJECTORIES)))
        check_own(*(folder / TRAJECTORIES).glob("*"))
        with ExitStack() as opened:
            try:
                outcomes = (folder / OUTCOMES).open("r+b", buffering=0)
                journal = cls(folder, opened.enter_context(outcomes), {})
                run = Run(folder)
                journal.settings = run.record
                dropped = len(run.outcomes) - run.whole_batches() + run.torn
                if dropped:
                    journal.keep(run, run.whole_batches())
            except (FileNotFoundError, NotADirectoryError) as error:
                raise UserError(
                    f"{folder} is not a campaign to go on with: it has no {OUTCOMES}"
                ) from error
            except OSError as error:
                raise UserError(f"cannot write {folder}: {error.strerror}") from error
            opened.pop_all()
        return journal, run, dropped

    def keep(self, run: Run, cases: int) -> None:
        """Drop all outcomes of a run after its first cases, from the folder and from memory."""
        del run.outcomes[cases:]
        self._outcomes.seek(0)
        length = sum(len(line) for line, _ in zip(self._outcomes, run.outcomes, strict=False))
        self._outcomes.truncate(length)
        os.fsync(self._outcomes.fileno())

    def append(self, *groups: Sequence[Episode]) -> None:
        """Write groups and sync them to the disk: several at once take little more time than one.

        What their episodes say of loaded files, of commands in vain, and of cases that ran again
        goes into the settings. Raises `UserError` when they cannot be written; what was there
        before stays.
        """
        if self.earlier is not None:
            self.earlier.append(*([e.earlier for e in group if e.earlier] for group in groups))
        paths = [batch_file(self.folder, group[0].outcome.batch) for group in groups]
        lines, arrays = zip(*map(_encoded, groups), strict=True)
        try:
            end = self._outcomes.seek(0, os.SEEK_END)
            list(self._threads.map(_write, paths, arrays))
            sync_folder(self.folder / TRAJECTORIES)
            try:
                _write_all(self._outcomes, b"".join(lines))
            except OSError:
                self._outcomes.truncate(end)
                raise
        except OSError as error:
            goes_on = again("resume", self.folder, self.settings)
            kept = f"; what ran before is kept: go on with `{goes_on}`"
            raise UserError(
                f"cannot write {self.folder}: {error.strerror}"
                f"{kept if (self.folder / OUTCOMES).is_file() else ''}"
            ) from error
        noted = dict(self.settings)
        for episode in (episode for group in groups for episode in group):
            for name, loaded in zip(FILES, (episode.files, episode.pov_files), strict=True):
                if loaded:
                    noted[name] = loaded | (noted.get(name) or {})  # what was known stays
            for command in episode.trajectory.in_vain:
                cases = noted.get(IN_VAIN) or {}
                noted[IN_VAIN] = cases | {command: cases.get(command, 0) + 1}
            if episode.again:
                noted[RAN_AGAIN] = noted.get(RAN_AGAIN, 0) + 1
        if noted != self.settings:
            self.rewrite_settings(noted)

    def rewrite_settings(self, settings: dict[str, Any]) -> None:
        """Put other settings in the place of those that were there, all or nothing."""
        self.settings = settings
        replace_own(self.folder / SETTINGS, _settings_text(settings))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._threads.shutdown()
        self._outcomes.close()


def _encoded(group: Sequence[Episode]) -> tuple[bytes, bytes]:
    """Return the lines of a group, and the file of its trajectories."""
    outcomes = [episode.outcome for episode in group]
    trajectories = [episode.trajectory for episode in group]
    lines = "".join(map(to_line, outcomes)).encode()
    signals = {
        str(o.index): to_record(t.signals)
        for o, t in zip(outcomes, trajectories, strict=True)
        if t.signals
    }
    text = json.dumps(signals, allow_nan=False).encode()
    kept: dict[str, Any] = {"signals": np.frombuffer(text, np.uint8)} if signals else {}
    motions = [trajectory.whole for trajectory in trajectories]
    arrays = io.BytesIO()
    np.savez(
        arrays,
        **kept,
        index=np.array([o.index for o in outcomes]),
        rows=np.array([len(motion) for motion in motions]),
        motion=np.concatenate([motion.reshape(len(motion), -1) for motion in motions]),
    )
    return lines, arrays.getvalue()


def _settings_text(settings: dict[str, Any]) -> bytes:
    return to_json(settings, indent=2)


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
