"""Importing this module makes `gymnasium.make("merge_sumo/Merge-v0")` work."""

from __future__ import annotations

from typing import Final

from gymnasium.envs import registration

from merge_sumo.drivers.levelk import DECISION_STEPS
from merge_sumo.values.scenario import US23

ENV_ID: Final = "merge_sumo/Merge-v0"

# The environments themselves are imported when one is made.
registration.register(
    ENV_ID,
    entry_point="merge_sumo.training.env:MergeEnv",
    vector_entry_point="merge_sumo.training.env:MergeVectorEnv",
    max_episode_steps=US23.max_steps // DECISION_STEPS,
)
