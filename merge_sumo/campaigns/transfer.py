"""What earlier campaigns teach: of other versions of a VUT, or at other levels."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from merge_sumo.campaigns.store import Run
from merge_sumo.errors import UserError
from merge_sumo.system.printable import printable
from merge_sumo.values.case import FloatArray
from merge_sumo.values.scenario import Scenario

MOST_CASES: Final = 400
"""Cases that are learned from at most, of all campaigns together."""


def lessons(folders: Sequence[str], scenario: Scenario) -> dict[str, list[FloatArray]]:
    """Return the motions, (T + 1, A, 3), that are learned from, of each campaign by its folder.

    Half are those of its worst cases, the others spread over the rest. Nothing of a folder is run.
    """
    if not folders:
        return {}
    most = MOST_CASES // len(folders)
    found = {}
    for folder in folders:
        run = Run(Path(folder))
        if run.scenario != scenario:
            raise UserError(
                f"--learn-from: {printable(folder)} was run on {run.scenario.name}, which is not "
                "the scenario of this campaign, or has other numbers: name a campaign of the same"
            )
        tested = [o for o in run.outcomes if o.measures.score is not None]
        if not tested:
            raise UserError(
                f"--learn-from: {printable(folder)} has no case that ended well: leave it out"
            )
        by_score = sorted(tested, key=lambda o: (o.measures.score, o.index))
        if len(by_score) > most:
            half = most // 2
            spread = np.linspace(half, len(by_score) - 1, most - half).astype(np.int64)
            by_score = by_score[:half] + [by_score[place] for place in spread.tolist()]
        found[folder] = [run.trajectory(o.index).motion for o in by_score]
    return found


def hashes(taught: dict[str, list[FloatArray]]) -> dict[str, str]:
    """Return the hash of what each campaign teaches, by its folder."""
    return {
        folder: hashlib.sha256(b"".join(m.tobytes() for m in motions)).hexdigest()
        for folder, motions in taught.items()
    }
