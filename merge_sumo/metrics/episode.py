"""An episode: a case that was run, from the worker that ran it to the file that keeps it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from merge_sumo.files import Files
from merge_sumo.metrics.prediction import Prediction
from merge_sumo.metrics.score import Outcome
from merge_sumo.scenario.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class Episode:
    """A case that was run: its outcome, what happened, and how it came to that.

    Attributes:
        outcome: verdict and measures, with the place of the case in its campaign.
        trajectory: what happened.
        files: those of the user's that the VUT had loaded by then, with their hashes.
        pov_files: those that a POV of the user's own had loaded.
        again: whether it ran again, because a process had died or had been stopped.
        in_sumo: whether SUMO ran it; the engine of the plan may be another.
        earlier: the same case by the earlier version, where a campaign is against one.
    """

    outcome: Outcome
    trajectory: Trajectory
    files: Files = field(default_factory=dict)
    pov_files: Files = field(default_factory=dict)
    again: bool = False
    in_sumo: bool = True
    earlier: Episode | None = None

    def at(self, index: int, batch: int, prediction: Prediction | None = None) -> Episode:
        """Return the episode at a place in a campaign.

        Where it ran with two versions, what was predicted is recorded with the earlier one.
        """
        earlier = self.earlier
        if earlier is not None:
            earlier, prediction = earlier.at(index, batch, prediction), None
        outcome = replace(self.outcome, index=index, batch=batch, prediction=prediction)
        return replace(self, outcome=outcome, earlier=earlier)
