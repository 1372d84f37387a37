"""A version of a VUT, as comparisons take it: what is recorded of it, or what has just run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from merge_sumo.campaigns.run import Run
from merge_sumo.metrics.campaign_verdict import judge
from merge_sumo.metrics.chance import one_per_case
from merge_sumo.metrics.episode import Episode
from merge_sumo.metrics.score import Outcome
from merge_sumo.metrics.summary import LevelSummary, summarise
from merge_sumo.records import to_plain
from merge_sumo.scenario.scenario import level_name
from merge_sumo.scenario.trajectory import Trajectory

Motions = Callable[[Iterable[int]], Mapping[int, Trajectory]]
"""Gives motions by the index of their case, without those that are not there."""


@dataclass(frozen=True)
class Version:
    """A version of a VUT: the outcomes that are recorded of it.

    Attributes:
        vut: name of the VUT.
        folder: of its campaign; None where it ran in the cases of another one's.
        outcomes: all runs.
        tolerated: share of its runs in which a case may fail.
        levels: POV levels.
        motions: gives its motions.
        sampler: who chose its cases.
    """

    vut: str
    folder: str | None
    outcomes: Sequence[Outcome]
    tolerated: float
    levels: Sequence[int]
    motions: Motions
    sampler: str

    @classmethod
    def of(cls, run: Run) -> Version:
        """Return a campaign as a version."""
        levels = sorted({*run.levels, *(outcome.case.level for outcome in run.outcomes)})
        folder = str(run.folder)
        known = run.outcomes, run.tolerated, levels, run.trajectories
        return cls(run.vut, folder, *known, run.settings.sampler)

    def with_vut(self, vut: str, episodes: Sequence[Episode]) -> Version:
        """Return the version of another VUT in the same cases, by its episodes."""
        outcomes = [episode.outcome for episode in episodes]
        own = {episode.outcome.index: episode.trajectory for episode in episodes}

        def motions(indices: Iterable[int]) -> dict[int, Trajectory]:
            return {index: own[index] for index in indices if index in own}

        return replace(self, vut=vut, folder=None, outcomes=outcomes, motions=motions)

    @cached_property
    def cases(self) -> list[Outcome]:
        """The deciding run of each case."""
        return one_per_case(self.outcomes, self.tolerated)

    @cached_property
    def at(self) -> dict[int, LevelSummary]:
        """By level, what is known of it."""
        return summarise(self.outcomes, self.levels, self.tolerated).levels

    def to_record(self) -> dict[str, Any]:
        """Return it as JSON shows it."""
        levels = {level_name(level): to_plain(self.at[level]) for level in self.levels}
        counts = judge(self.outcomes, self.tolerated).to_record()
        return {"vut": self.vut, "folder": self.folder, **counts, "levels": levels}
