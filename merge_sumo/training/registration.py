"""Importing this module makes `gymnasium.make("merge_sumo/Merge-v0")` and `make_vec` work."""

from __future__ import annotations

from gymnasium.envs import registration

from merge_sumo.drivers.levelk import DECISION_STEPS
from merge_sumo.scenario.scenario import DT_S, MAX_EPISODE_S

ENV_ID = "merge_sumo/Merge-v0"

# The environment truncates a game by the timeout of its scenario. Wrappers that ask for a limit get
# one that no scenario exceeds.
registration.register(
    ENV_ID,
    entry_point="merge_sumo.training.env:MergeEnv",
    max_episode_steps=round(MAX_EPISODE_S / DT_S) // DECISION_STEPS,
)
