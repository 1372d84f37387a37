"""Train a merging agent with stable-baselines3, and test it as a controller.

python examples/merging_agent.py runs/agent.zip
merge-sumo campaign --vut examples/merging_agent.py:Agent --level 0

`docs/how-to/reinforcement-learning.md` explains each part.
"""

from __future__ import annotations

import sys
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers import TransformObservation
from stable_baselines3 import PPO

import merge_sumo.training.registration  # noqa: F401 (registers the environment)

FILE = "runs/agent.zip"


def features(state: Any) -> Any:
    """Return the features of a state [x_POV, v_POV, x_VUT, v_VUT], each about -4 to 4.

    The fourth matters most: the position of the POV when the VUT reaches M, if both keep their
    speeds.
    """
    x_pov_m, v_pov_mps, x_vut_m, v_vut_mps = (float(value) for value in state)
    pov_at_merge_m = x_pov_m - x_vut_m * v_pov_mps / max(v_vut_mps, 1.0)
    seen = [
        x_vut_m / 100.0 + 1.0,
        (v_vut_mps - 22.0) / 5.0,
        (v_pov_mps - 30.0) / 5.0,
        np.clip(pov_at_merge_m / 40.0, -4.0, 4.0),
        np.clip(x_pov_m / 150.0 + 1.0, -4.0, 4.0),
    ]
    return np.array(seen, dtype=np.float32)


def train(file: str, decisions: int = 32_768, seed: int = 0) -> None:
    """Train an agent against the POV that keeps its speed, and save it."""
    torch.set_num_threads(1)
    game = gymnasium.make("merge_sumo/Merge-v0", role="vut", opponent="level0")
    seen = gymnasium.spaces.Box(-50.0, 50.0, (5,), np.float32)
    agent = PPO(
        "MlpPolicy",
        TransformObservation(game, features, seen),
        learning_rate=1e-3,
        n_steps=512,
        batch_size=128,
        n_epochs=6,
        gamma=0.995,
        ent_coef=0.01,
        seed=seed,
        device="cpu",
    )
    agent.learn(decisions)
    Path(file).parent.mkdir(parents=True, exist_ok=True)
    agent.save(file)
    game.close()


@cache
def trained(file: str) -> PPO:
    """Return the agent of a file. All controllers of a process share it."""
    return PPO.load(file, device="cpu")


class Agent:
    """A controller that asks the agent every 0.5 s, as in training."""

    def __init__(self) -> None:
        """Load the agent."""
        self.agent = trained(FILE)

    def reset(self, seen: Any) -> None:
        """Start a case without acceleration."""
        self.a_mps2 = 0.0

    def act(self, seen: Any) -> float:
        """Return the acceleration of the last decision. Actions 0 to 6 are -4 to 2 m/s2."""
        if round(10.0 * seen.t_s) % 5 == 0:
            state = seen.x_pov_m, seen.v_pov_mps, seen.x_vut_m, seen.v_vut_mps
            action, _ = self.agent.predict(features(state), deterministic=True)
            self.a_mps2 = float(action) - 4.0
            self.signals = {"decision_mps2": self.a_mps2}
        return self.a_mps2


if __name__ == "__main__":
    train(sys.argv[1])
