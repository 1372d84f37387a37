"""The merging game as a gymnasium environment, one decision of 0.5 s per step, by eq. (4).

    import merge_sumo.training.registration
    game = gymnasium.make("merge_sumo/Merge-v0", role="pov", opponent="level0", svo=None)
    games = gymnasium.make_vec("merge_sumo/Merge-v0", num_envs=32, role="vut")

The agent plays the POV or the VUT; its opponent is a driver of this package. Observations are
[x_POV, v_POV, x_VUT, v_VUT] in m and m/s, and psi for a POV with a social value orientation;
actions 0 to 6 are accelerations of -4 to +2 m/s2. `scenario=` plays another scenario. With
`render_mode="rgb_array"` it is drawn from above; gymnasium shows that in a window for `"human"`.
"""

from __future__ import annotations

from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from merge_sumo.drivers.levelk import ACTIONS, DECISION_STEPS
from merge_sumo.drivers.policies import load_network
from merge_sumo.errors import UserError
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import DT_S, SVO, US23, Scenario
from merge_sumo.training.game import Game, of_two, pool_starts
from merge_sumo.training.picture import game_picture
from merge_sumo.training.reward import Reward, Role

BOUND = 10_000.0
"""Bound of an observation: far beyond where any vehicle comes in a game."""
OPPONENTS = {"pov": ("level0", "vut1", "vut2"), "vut": ("level0", "pov1", "pov2")}
"""Opponents by the role of the agent."""
FPS = round(1.0 / (DECISION_STEPS * DT_S))
"""A picture for each decision shows a game in real time."""


class MergeEnv(gymnasium.Env[FloatArray, np.int64]):
    """One merging game, `merge_sumo/Merge-v0`.

    Example:
        game = MergeEnv("vut")
        observation, _ = game.reset(seed=1)
        observation, reward, terminated, truncated, _ = game.step(5)

    Attributes:
        game: the game by eq. (4).
        svo: psi of a POV of level 2, in rad, "random", or None.
        render_mode: "rgb_array", or None for no pictures.
        observation_space: bounds of [x_POV, v_POV, x_VUT, v_VUT], and of psi unless `svo` is None.
        action_space: indices of `game.actions_mps2`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}  # noqa: RUF012

    def __init__(
        self,
        role: Role = "pov",
        opponent: str = "level0",
        svo: float | Literal["random"] | None = None,
        render_mode: str | None = None,
        scenario: Scenario = US23,
    ) -> None:
        """Prepare games of an agent.

        Args:
            role: vehicle of the agent, "pov" or "vut".
            opponent: "level0", or a policy such as "vut1" or "pov1".
            svo: psi of a POV of level 2, in rad, or "random" for one drawn for every game; psi is
                then part of the observation.
            render_mode: "rgb_array" for pictures; `gymnasium.make` takes "human" for a window, too.
            scenario: the scenario that is played; its timeout truncates a game.

        Raises:
            UserError: if these do not make a game.
        """
        if opponent not in OPPONENTS.get(role, ()):
            raise UserError(
                f"a {role} cannot play against {opponent!r}: `role` must be pov or vut, and "
                "`opponent` level0 or a policy of the other role, such as vut1"
            )
        is_psi = isinstance(svo, int | float) and SVO.low <= svo < SVO.high
        if svo is not None and (role == "vut" or not (svo == "random" or is_psi)):
            raise UserError(
                f"svo is {svo!r}: choose 'random', or for a POV a number from 0 to below pi/2"
            )
        network = None if opponent == "level0" else load_network(opponent)
        self.game = Game(role, network, Reward.of(of_two(scenario)))
        self.svo, self.render_mode = svo, render_mode
        observed = 4 if svo is None else 5
        self.observation_space = spaces.Box(-BOUND, BOUND, (observed,), np.float64)
        self.action_space = spaces.Discrete(ACTIONS)
        self._state, self._svo_rad, self._decisions = np.zeros((1, 4)), np.zeros(1), 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Begin a game from a start of the pool.

        Args:
            seed: seed of the starts of this and the next games; None continues with the last one.
            options: not used.

        Returns:
            The observation, (4,) or (5,), and no further information.
        """
        super().reset(seed=seed)
        self._state = pool_starts(1, self.np_random, self.game.scenario)
        if self.svo == "random":
            self._svo_rad = self.np_random.uniform(SVO.low, SVO.high, 1)
        elif self.svo is not None:
            self._svo_rad = np.array([self.svo])
        self._decisions = 0
        return self._observed(), {}

    def step(self, action: np.int64) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Take one decision.

        Args:
            action: index of an acceleration, 0 to 6.

        Returns:
            The observation, the reward, whether the VUT has reached M, whether the game is cut off
            by the timeout of the scenario, and no further information.

        Raises:
            UserError: if it is not an action.
        """
        if not self.action_space.contains(action):
            raise UserError(
                f"an action must be a whole number from 0 to {ACTIONS - 1}, not {action!s:.60}"
            )
        a_mps2 = self.game.actions_mps2[[action]]
        self._state, reward, over = self.game.advance(self._state, self._svo_rad, a_mps2)
        self._decisions += 1
        truncated = not over[0] and self._decisions >= self.game.max_decisions
        return self._observed(), float(reward[0]), bool(over[0]), truncated, {}

    def render(self) -> NDArray[np.uint8] | None:
        """Return the picture of the game, (240, 960, 3), or None without a render mode."""
        if self.render_mode is None:
            return None
        return game_picture(self.game.scenario, self._state[0])

    def _observed(self) -> FloatArray:
        state = self._state[0]
        if self.svo is not None:
            state = np.append(state, self._svo_rad)
        return np.asarray(state)
