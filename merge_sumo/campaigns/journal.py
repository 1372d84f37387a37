"""The writer of a campaign folder (`recorded.py`): one process, and whole batches of episodes.

The trajectories of a batch go first, so that every outcome on disk has its trajectory there.
"""

from __future__ import annotations

import io
import json
import os
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from itertools import chain
from pathlib import Path
from typing import Any, Self

import numpy as np

from merge_sumo.campaigns.printed_commands import campaign_command
from merge_sumo.campaigns.recorded import (
    FILES,
    IN_VAIN,
    OUTCOMES,
    RAN_AGAIN,
    SETTINGS,
    TRAJECTORIES,
    RecordedCampaign,
    batch_file,
)
from merge_sumo.errors import UserError
from merge_sumo.files import (
    check_own,
    make_folder,
    replace_own,
    sync_folder,
    write_folder,
    writing,
)
from merge_sumo.metrics.outcome import Episode, Outcome
from merge_sumo.records import to_json
from merge_sumo.scenario.signals import to_runs


def to_line(outcome: Outcome) -> str:
    """Return the line of `outcomes.jsonl` for an outcome, with its line end.

    Args:
        outcome: the outcome.
    """
    return json.dumps(outcome.to_record(), allow_nan=False) + "\n"


class Journal:
    """Writes a campaign's folder, as the only process that does; to be used in `with`.

    A folder with settings is complete, and appended outcomes stay.

    Example:
        with Journal.create(folder, settings.to_record(plan)) as journal:
            journal.append(episodes)

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
        _lock(outcomes, folder)
        make_folder(folder / TRAJECTORIES, exist_ok=True)

    @classmethod
    def create(cls, folder: Path, settings: dict[str, Any]) -> Self:
        """Create a folder with its settings, and return its journal.

        Args:
            folder: the folder.
            settings: content of its `campaign.json`.

        Raises:
            UserError: it exists or cannot be written.
        """
        write_folder(folder, {OUTCOMES: b"", SETTINGS: to_json(settings, indent=2)})
        return cls(folder, (folder / OUTCOMES).open("r+b", buffering=0), settings)

    @classmethod
    def reopen(cls, folder: Path) -> tuple[Self, RecordedCampaign, int]:
        """Return the journal of a stopped campaign, the campaign, and the number of lost outcomes.

        The outcomes of a batch that was not written to its end are dropped: its cases run again.

        Args:
            folder: the folder of the campaign.

        Raises:
            UserError: another process writes the folder, a link in it leads elsewhere, or
                `RecordedCampaign` cannot read it.
        """
        check_own(*(folder / name for name in (SETTINGS, OUTCOMES, TRAJECTORIES)))
        check_own(*(folder / TRAJECTORIES).glob("*"))
        with writing(folder), ExitStack() as opened:
            outcomes = (folder / OUTCOMES).open("r+b", buffering=0)
            journal = cls(folder, opened.enter_context(outcomes), {})
            run = RecordedCampaign(folder)
            journal.settings = run.record
            whole = run.whole_batches()
            dropped = len(run.outcomes) - whole + run.torn
            if dropped:
                journal.keep(run, whole)
            opened.pop_all()
        return journal, run, dropped

    def keep(self, run: RecordedCampaign, cases: int) -> None:
        """Drop outcomes from the end, from the folder and from memory.

        Args:
            run: the campaign of this journal.
            cases: number of the first cases that stay.
        """
        del run.outcomes[cases:]
        self._outcomes.seek(0)
        length = sum(len(line) for line, _ in zip(self._outcomes, run.outcomes, strict=False))
        self._outcomes.truncate(length)
        os.fsync(self._outcomes.fileno())

    def append(self, *batches: Sequence[Episode]) -> None:
        """Write batches and sync them to the disk.

        Loaded files, commands without effect and cases that ran again are noted in the settings.

        Args:
            batches: the episodes of each batch.

        Raises:
            UserError: they cannot be written; earlier batches stay.
        """
        if self.earlier is not None:
            earlier = []
            for batch in batches:
                earlier.append([episode.earlier for episode in batch if episode.earlier])
            self.earlier.append(*earlier)
        episodes = list(chain.from_iterable(batches))
        lines = "".join(to_line(episode.outcome) for episode in episodes)
        try:
            with writing(self.folder):
                for batch in batches:
                    path = batch_file(self.folder, batch[0].outcome.batch)
                    with path.open("wb", buffering=0) as file:
                        _write_all(file, _arrays(batch))
                sync_folder(self.folder / TRAJECTORIES)
                end = self._outcomes.seek(0, os.SEEK_END)
                try:
                    _write_all(self._outcomes, lines.encode())
                except OSError:
                    self._outcomes.truncate(end)
                    raise
        except UserError as error:
            resume = campaign_command("resume", self.folder, self.settings)
            raise UserError(f"{error}; when it is writable, continue with `{resume}`") from error
        before = dict(self.settings)
        for episode in episodes:
            self._note(episode)
        if self.settings != before:
            self.write_settings()

    def _note(self, episode: Episode) -> None:
        """Note in the settings what an episode has loaded, commanded in vain, or repeated."""
        noted = self.settings
        for name, files in zip(FILES, (episode.files, episode.pov_files), strict=True):
            if files:
                noted[name] = files | (noted.get(name) or {})  # the first hash of a file stays
        for command in episode.trajectory.in_vain:
            cases = noted.get(IN_VAIN, {})
            noted[IN_VAIN] = cases | {command: cases.get(command, 0) + 1}
        if episode.ran_again:
            noted[RAN_AGAIN] = noted.get(RAN_AGAIN, 0) + 1

    def write_settings(self) -> None:
        """Replace `campaign.json`, all or nothing."""
        if self.earlier is not None:
            self.earlier.write_settings()
        replace_own(self.folder / SETTINGS, to_json(self.settings, indent=2))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._outcomes.close()


def _arrays(batch: Sequence[Episode]) -> bytes:
    """Return the file of the trajectories of a batch."""
    indices, rows, motions, signals = [], [], [], {}
    for episode in batch:
        index, trajectory = episode.outcome.index, episode.trajectory
        indices.append(index)
        rows.append(len(trajectory.whole))
        motions.append(trajectory.whole.reshape(len(trajectory.whole), -1))
        if trajectory.signals:
            signals[str(index)] = to_runs(trajectory.signals)
    arrays: dict[str, Any] = {}
    if signals:
        arrays["signals"] = np.frombuffer(json.dumps(signals, allow_nan=False).encode(), np.uint8)
    arrays |= {"index": np.array(indices), "rows": np.array(rows)}
    arrays["motion"] = np.concatenate(motions)
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def _lock(outcomes: io.FileIO, folder: Path) -> None:
    """Refuse when another process holds the lock; it goes with the process, however that ends."""
    if sys.platform == "win32":  # no flock there
        return
    import fcntl

    try:
        fcntl.flock(outcomes, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        outcomes.close()
        raise UserError(f"another process is writing {folder}: wait until it ends") from error


def _write_all(file: io.FileIO, content: bytes) -> None:
    """Write bytes to an unbuffered file, and sync it to the disk.

    After an error, nothing is left in a buffer that closing the file would write after all.
    """
    rest = memoryview(content)
    while rest:
        rest = rest[file.write(rest) :]
    os.fsync(file.fileno())
