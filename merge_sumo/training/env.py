"""The merging game as gymnasium environments, one decision of 0.5 s per step, by eq. (4).

    import merge_sumo.training.registration
    env = gymnasium.make("merge_sumo/Merge-v0", role="pov", opponent="level0", svo=None)
    games = gymnasium.make_vec("merge_sumo/Merge-v0", num_envs=32, role="vut")

The agent plays the POV or the VUT; its opponent is a driver of this package. Observations are
[x_POV, v_POV, x_VUT, v_VUT] in m and m/s, and psi for a POV with a social value orientation;
actions 0 to 6 are accelerations of -4 to +2 m/s2. `scenario=` plays another scenario. With
`render_mode="rgb_array"` or `"human"` it is drawn as the player of the report draws a case.
"""

from __future__ import annotations

import math
from typing import Any, Final, Literal

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from merge_sumo.drivers.levelk import ACTIONS, DECISION_STEPS, QNetwork
from merge_sumo.drivers.policies import load_network
from merge_sumo.errors import UserError
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scale import Units
from merge_sumo.scenario.scenario import DT_S, SVO, US23, Scenario
from merge_sumo.training.game import Game, of_two, pool_starts
from merge_sumo.training.picture import GamePicture
from merge_sumo.training.reward import Reward, RewardWeights, Role

STATE_LOW: Final = np.array([-500.0, 0.0, -200.0, 0.0])
STATE_HIGH: Final = np.array([1900.0, 100.0, 30.0, 100.0])
"""Of an observation, in the units of the scenario."""
FPS: Final = round(1.0 / (DECISION_STEPS * DT_S))
"""A picture for each decision shows a game in real time."""


class MergeVectorEnv(VectorEnv[FloatArray, NDArray[np.int64], NDArray[Any]]):
    """K merging games as one gymnasium vector environment.

    A game that has ended begins anew in the next step, which ignores its action and has reward 0:
    `AutoresetMode.NEXT_STEP`, which the wrappers of gymnasium expect.
    """

    metadata = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "render_fps": FPS,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 32,
        role: Role = "pov",
        opponent: str = "level0",
        svo: float | Literal["random"] | None = None,
        weights: RewardWeights | None = None,
        scenario: Scenario = US23,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Play `role` against `opponent`: "level0", or a policy such as "vut1" or "pov1".

        `svo` is psi of a POV of level 2, or "random" for one drawn anew for every game; psi is
        then part of the observation. The weights are those of the scenario unless they are given.
        A game is truncated by the scenario's timeout, or after `max_episode_steps` decisions where
        that is earlier. Raises `UserError` for what makes no game.
        """
        if role == "vut" and svo is not None:
            raise UserError("svo is the orientation of a POV: leave it out for role='vut'")
        if max_episode_steps is not None and max_episode_steps < 1:
            raise UserError(f"max_episode_steps is {max_episode_steps}: it must be 1 or more")
        if num_envs < 1:
            raise UserError(f"num_envs is {num_envs}: it must be 1 or more")
        if not (svo is None or svo == "random" or _is_psi(svo)):
            raise UserError(f"svo is {svo!r}: choose 'random', or 0 up to, and below, pi/2")
        self.num_envs, self.role, self.svo = num_envs, role, svo
        reward = Reward(weights or RewardWeights.of(scenario), of_two(scenario))
        self.game = Game(role, _opponent(role, opponent), reward)
        until_timeout = math.ceil(scenario.max_steps / DECISION_STEPS)
        self._most = min(until_timeout, max_episode_steps or until_timeout)
        unit = Units.of(scenario)
        units = np.array([unit.length, unit.speed, unit.length, unit.speed])
        low, high = STATE_LOW * units, STATE_HIGH * units
        if svo is not None:
            low, high = np.append(low, SVO.low), np.append(high, SVO.high)
        self._low, self._high = low, high
        self.single_observation_space = spaces.Box(low, high, dtype=np.float64)
        self.single_action_space = spaces.Discrete(ACTIONS)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._rng = np.random.default_rng()
        self._state, self._svo_rad = np.zeros((num_envs, 4)), np.zeros(num_envs)
        self._decisions = np.zeros(num_envs, dtype=np.int64)
        self._ended = np.zeros(num_envs, dtype=bool)
        self.render_mode = checked_mode(render_mode, self.metadata)
        self._picture = None if render_mode is None else GamePicture(self.game.scenario)

    def reset(
        self,
        *,
        seed: int | list[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Begin all games, from starts of the pool."""
        if seed is not None:
            self._rng = np.random.default_rng([s or 0 for s in np.atleast_1d(np.array(seed))])
        self._begin(np.arange(self.num_envs))
        self._ended = np.zeros(self.num_envs, dtype=bool)
        return self._observed(), {}

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[FloatArray, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Take one decision in every game that has not ended; begin the others anew.

        Raises `UserError` for what is no action.
        """
        began = self._ended
        a_mps2 = self.game.actions_mps2[self._checked(actions)]
        self._state, reward, over = self.game.advance(self._state, self._svo_rad, a_mps2)
        self._decisions += 1
        terminated = over & ~began
        truncated = ~over & ~began & (self._decisions >= self._most)
        self._ended = terminated | truncated
        if began.any():
            self._begin(np.flatnonzero(began))
        return self._observed(), np.where(began, 0.0, reward), terminated, truncated, {}

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a picture of each game; nothing without a `render_mode`."""
        if self._picture is None:
            return None
        return tuple(map(self._picture.frame, self._state))

    def show(self) -> None:
        """Show the first game in a window."""
        if self._picture is not None:
            self._picture.show(self._state[0], FPS)

    def close_extras(self, **kwargs: Any) -> None:
        """Close the window."""
        if self._picture is not None:
            self._picture.close()

    def _checked(self, actions: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return actions as an array, (K,); `UserError` where they are none."""
        chosen = np.asarray(actions)
        whole = chosen.shape == (self.num_envs,) and np.issubdtype(chosen.dtype, np.integer)
        if not whole or (chosen < 0).any() or (chosen >= ACTIONS).any():
            each = "" if self.num_envs == 1 else f" for each of {self.num_envs} games"
            raise UserError(
                f"an action is a whole number from 0 to {ACTIONS - 1}{each}: not {chosen!s:.60}"
            )
        return chosen

    def _begin(self, which: NDArray[np.int64]) -> None:
        self._state[which] = pool_starts(len(which), self._rng, self.game.scenario)
        if self.svo is not None:
            drawn = self._rng.uniform(SVO.low, SVO.high, len(which))
            self._svo_rad[which] = drawn if self.svo == "random" else self.svo
        self._decisions[which] = 0

    def _observed(self) -> FloatArray:
        state = self._state
        if self.svo is not None:
            state = np.column_stack([state, self._svo_rad])
        return np.clip(state, self._low, self._high)


class MergeEnv(gymnasium.Env[FloatArray, np.int64]):
    """One merging game, `merge_sumo/Merge-v0`."""

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": FPS}  # noqa: RUF012

    def __init__(
        self,
        role: Role = "pov",
        opponent: str = "level0",
        svo: float | Literal["random"] | None = None,
        weights: RewardWeights | None = None,
        render_mode: str | None = None,
        scenario: Scenario = US23,
    ) -> None:
        """See `MergeVectorEnv`; "human" shows a window, in which a game takes its real time."""
        self.render_mode = checked_mode(render_mode, self.metadata)
        drawn = None if render_mode is None else "rgb_array"
        self._games = MergeVectorEnv(1, role, opponent, svo, weights, scenario, render_mode=drawn)
        self.observation_space = self._games.single_observation_space
        self.action_space = self._games.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Begin a game from a start of the pool."""
        super().reset(seed=seed)
        observations, _ = self._games.reset(seed=int(self.np_random.integers(2**31)))
        self._show()
        return observations[0], {}

    def step(self, action: np.int64) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Take one decision."""
        observations, reward, terminated, truncated, _ = self._games.step(np.array([action]))
        self._show()
        return observations[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), {}

    def render(self) -> NDArray[np.uint8] | None:
        """Return the picture of the game; nothing where a window shows it, or without a mode."""
        frames = self._games.render() if self.render_mode == "rgb_array" else None
        return None if frames is None else frames[0]

    def close(self) -> None:
        """Close the window, if there is one."""
        self._games.close()

    def _show(self) -> None:
        if self.render_mode == "human":
            self._games.show()


def checked_mode(mode: str | None, metadata: dict[str, Any]) -> str | None:
    """Return a `render_mode`; `UserError` where an environment has no such mode."""
    if mode is not None and mode not in metadata["render_modes"]:
        modes = " or ".join(map(repr, metadata["render_modes"]))
        raise UserError(f"there is no render_mode {mode!r}: choose {modes}, or leave it out")
    return mode


def _is_psi(svo: object) -> bool:
    return isinstance(svo, int | float) and SVO.low <= svo < SVO.high


def _opponent(role: Role, opponent: str) -> QNetwork | None:
    """Return the network that plays against `role`; None for level 0."""
    if role not in ("pov", "vut"):
        raise UserError(f"there is no role {role!r}: choose pov or vut")
    if opponent == "level0":
        return None
    wanted = "vut" if role == "pov" else "pov"
    if not opponent.startswith(wanted):
        raise UserError(f"a {role} cannot play against {opponent!r}: choose level0 or a {wanted}")
    return load_network(opponent)
