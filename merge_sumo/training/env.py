"""The merging game as gymnasium environments in SUMO, one decision of 0.5 s per step.

    import merge_sumo.training.registration
    env = gymnasium.make("merge_sumo/Merge-v0", role="pov", opponent="level0", svo=None)
    games = gymnasium.make_vec("merge_sumo/Merge-v0", num_envs=32, role="vut")

The agent plays the POV or the VUT; its opponent is a driver of this package. Observations are
[x_POV, v_POV, x_VUT, v_VUT] in m and m/s, and psi for a POV with a social value orientation;
actions 0 to 6 are accelerations of -4 to +2 m/s2. `scenario=` plays another scenario.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final, Literal

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from merge_sumo.drivers.base import Driver, Scene
from merge_sumo.drivers.level0 import Level0Pov, Level0Vut, level0_time_to
from merge_sumo.drivers.levelk import ACTIONS, DECISION_STEPS, actions_mps2
from merge_sumo.drivers.policies import load_driver
from merge_sumo.errors import UserError
from merge_sumo.road.corridor import Corridor
from merge_sumo.road.merge import road_for
from merge_sumo.scenario.case import FloatArray, MergeCase
from merge_sumo.scenario.scale import Units
from merge_sumo.scenario.scenario import POV, SVO, US23, VUT, Scenario, as_merge
from merge_sumo.sumo.world import World
from merge_sumo.training.game import of_two
from merge_sumo.training.reward import Reward, RewardParts, RewardWeights, Role

STATE_LOW: Final = np.array([-500.0, 0.0, -200.0, 0.0])
STATE_HIGH: Final = np.array([1900.0, 100.0, 30.0, 100.0])
"""Of an observation, in the units of the scenario."""


class MergeGame:
    """K games in the corridors of one SUMO world, each advanced by decisions of 0.5 s."""

    def __init__(
        self,
        role: Role,
        opponent: Driver,
        reward: Reward,
        road: Corridor | None = None,
        a_min_mps2: float | None = None,
    ) -> None:
        """Open a world with as many corridors as the opponent drives in.

        The reward says which scenario is played; its road is the shipped one where none is given.
        `a_min_mps2` is the hardest braking of the agent, by default that of the scenario.
        """
        self.role, self.opponent, self.reward = role, opponent, reward
        self.scenario = as_merge(reward.scenario)
        self.a_min_mps2 = a_min_mps2
        self.of_agent = (
            self.scenario if a_min_mps2 is None else replace(self.scenario, a_min_mps2=a_min_mps2)
        )
        """The scenario with the agent's limit of braking."""
        self.actions_mps2 = actions_mps2(self.of_agent)
        self.max_decisions = self.scenario.max_steps // DECISION_STEPS
        self.corridors = opponent.corridors
        self.world = World(self.corridors, road, scenario=self.scenario)
        self.step_count = np.zeros(self.corridors, dtype=np.int64)

    def begin(self, corridor: int, state: FloatArray, svo_rad: float | None = None) -> None:
        """Start a game in a corridor from a state [x_POV, v_POV, x_VUT, v_VUT]."""
        x_pov, v_pov, x_vut, v_vut = state.tolist()
        x_pov = max(x_pov, -self.world.road.mainline.before_m)
        self.world.place(corridor, [(x_pov, v_pov), (x_vut, v_vut)])
        case = MergeCase(
            level=1 if svo_rad is None else 2,
            x_pov0_m=self.scenario.x_pov0_m[0],
            v_pov0_mps=self.scenario.v_pov0_mps[0],
            v_vut0_mps=self.scenario.bounds("v_vut0_mps")[0],
            svo_rad=svo_rad,
            scenario=self.scenario,
        )
        self.opponent.begin(corridor, case)
        self.step_count[corridor] = 0

    def state(self) -> FloatArray:
        """Return the states of all games, (K, 4), as read from SUMO."""
        x, v = self.world.x_m, self.world.v_mps
        return np.stack([x[POV], v[POV], x[VUT], v[VUT]], axis=1)

    def decide(
        self, a_mps2: FloatArray, ended: NDArray[np.bool_] | None = None
    ) -> tuple[FloatArray, RewardParts, NDArray[np.bool_]]:
        """Hold the agent's accelerations, (K,), for one decision.

        Games that have `ended`, (K,), stand still and earn nothing.

        Returns the states at its end (or at t1, where that came first), the reward in parts, and
        which games are over because the VUT is at M. Those stand until they begin anew.
        """
        world, reward = self.world, self.reward
        parts = RewardParts(*np.zeros((3, self.corridors)))
        over = np.zeros(self.corridors, dtype=bool) if ended is None else ended.copy()
        state = self.state()
        agent, other = (POV, VUT) if self.role == "pov" else (VUT, POV)
        a = np.empty((2, self.corridors))
        for _ in range(DECISION_STEPS):
            live = ~over
            x, v = world.x_m, world.v_mps
            scene = Scene(live, self.step_count, x, v)
            a[agent] = a_mps2
            a[other] = self.opponent.act(scene)
            a[:, over] = 0.0
            parts.pov_ego[live] += reward.pov_step(v[POV], a[POV])[live]
            parts.vut_ego[live] += reward.vut_step(v[VUT], a[VUT])[live]
            world.step(a)
            self.step_count += 1
            arrived = live & (world.x_m[VUT] >= 0.0)
            state = np.where(over[:, None], state, self.state())
            if arrived.any():
                dx, dv = world.x_m[POV] - world.x_m[VUT], world.v_mps[POV] - world.v_mps[VUT]
                parts.safe[arrived] += reward.safety(dx, dv)[arrived]
                parts.vut_ego[arrived] += reward.vut_end(world.v_mps[VUT])[arrived]
                over |= arrived
        return state, parts, over

    def close(self) -> None:
        """Close the world and the opponent."""
        self.world.close()
        self.opponent.close()


def pool_starts(n: int, rng: np.random.Generator, scenario: Scenario) -> FloatArray:
    """Return `n` starting states, (n, 4), uniform over the pool."""
    merge = as_merge(scenario)
    x_pov = rng.uniform(*merge.x_pov0_m, n)
    v_pov = rng.uniform(*merge.v_pov0_mps, n)
    v_vut = _starting_speeds(n, rng, scenario)
    return np.stack([x_pov, v_pov, np.full(n, scenario.x_vut0_m), v_vut], axis=1)


def _starting_speeds(n: int, rng: np.random.Generator, scenario: Scenario) -> FloatArray:
    low, high = scenario.bounds("v_vut0_mps")
    return rng.uniform(low, high, n) if low < high else np.full(n, low)


def exploring_starts(
    n: int, rng: np.random.Generator, midway: float = 0.6, *, scenario: Scenario
) -> FloatArray:
    """Return `n` starting states, (n, 4): a share from mid-way in a game, the rest of the pool.

    Most of the former are states from which both would reach M together, because that is where
    a small error of Q is a collision; some are anywhere, because a black-box VUT brings the
    drivers there.
    """
    unit, wide_gap = Units.of(scenario), RewardWeights.of(scenario).gap_full_m / 60.0
    x_vut0, a, v_cruise = scenario.x_vut0_m, scenario.level0_a_mps2, scenario.level0_v_mps
    merge = as_merge(scenario)
    (x_low, _), (v_low, v_high) = merge.x_pov0_m, merge.v_pov0_mps
    x_vut = rng.uniform(x_vut0, -1.0 * unit.length, n)
    v_vut0 = _starting_speeds(n, rng, scenario)
    on_profile = np.sqrt(v_vut0**2 + 2.0 * a * (x_vut - x_vut0)) + rng.normal(
        0.0, 3.0 * unit.speed, n
    )
    v_vut = np.where(
        rng.random(n) < 0.6,
        on_profile,
        rng.uniform(2.0 * unit.speed, scenario.v_hw_max_mps, n),
    ).clip(unit.speed, scenario.v_hw_max_mps + unit.speed)
    v_pov = np.where(
        rng.random(n) < 0.7,
        rng.uniform(v_low - 5.0 * unit.speed, v_high + 2.0 * unit.speed, n),
        rng.uniform(v_low - 17.0 * unit.speed, v_high + 7.0 * unit.speed, n),
    ).clip(0.0)
    gap = wide_gap * np.where(
        rng.random(n) < 0.7, rng.normal(0.0, 25.0, n), rng.uniform(-120.0, 120.0, n)
    )
    x_pov = gap - v_pov * level0_time_to(-x_vut, v_vut, a, v_cruise)
    x_pov = x_pov.clip(x_low - 80.0 * unit.length, 150.0 * unit.length)
    states = np.stack([x_pov, v_pov, x_vut, v_vut], axis=1)
    return np.where(rng.random((n, 1)) < midway, states, pool_starts(n, rng, scenario))


class MergeVectorEnv(VectorEnv[FloatArray, NDArray[np.int64], NDArray[Any]]):
    """K merging games as one gymnasium vector environment.

    A game that has ended begins anew in the next step, which ignores its action and has reward 0:
    `AutoresetMode.NEXT_STEP`, which the wrappers of gymnasium expect.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 32,
        role: Role = "pov",
        opponent: str = "level0",
        svo: float | Literal["random"] | None = None,
        weights: RewardWeights | None = None,
        scenario: Scenario = US23,
        max_episode_steps: int | None = None,
    ) -> None:
        """Play `role` against `opponent`: "level0", or a policy such as "vut1" or "pov1".

        `svo` is psi of a POV of level 2, or "random" for one drawn anew for every game; psi is
        then part of the observation. The weights are those of the scenario unless they are given.
        A game is truncated by the scenario's timeout, or after `max_episode_steps` decisions where
        that is earlier.
        """
        if role == "vut" and svo is not None:
            raise UserError("svo is the orientation of a POV: leave it out for role='vut'")
        if max_episode_steps is not None and max_episode_steps < 1:
            raise UserError(f"max_episode_steps is {max_episode_steps}: it must be 1 or more")
        self.num_envs, self.role, self.svo = num_envs, role, svo
        self._opponent = make_opponent(role, opponent, num_envs)
        self._scenario = of_two(scenario)
        self._max_steps = min(
            self._scenario.max_steps,
            DECISION_STEPS * (max_episode_steps or self._scenario.max_steps),
        )
        self._reward = Reward(weights or RewardWeights.of(scenario), self._scenario)
        self._game: MergeGame | None = None
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
        self._svo_rad = np.zeros(num_envs)
        self._steps = np.zeros(num_envs, dtype=np.int64)
        self._ended = np.zeros(num_envs, dtype=bool)

    @property
    def game(self) -> MergeGame:
        """The games; SUMO starts when they are first needed, for one process holds only one."""
        if self._game is None:
            road = road_for(self._scenario)
            self._game = MergeGame(self.role, self._opponent, self._reward, road)
        return self._game

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
        return self._observe(self.game.state()), {}

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[FloatArray, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Take one decision in every game that has not ended; begin the others anew."""
        began = self._ended
        a_mps2 = self.game.actions_mps2[np.asarray(actions)]
        state, parts, over = self.game.decide(a_mps2, began)
        self._steps += DECISION_STEPS
        terminated = over & ~began
        truncated = ~over & (self._steps >= self._max_steps)
        reward = np.where(began, 0.0, parts.of(self.role, self._svo_rad))
        self._ended = terminated | truncated
        if began.any():
            self._begin(np.flatnonzero(began))
            state = np.where(began[:, None], self.game.state(), state)
        return self._observe(state), reward, terminated, truncated, {}

    def close_extras(self, **kwargs: Any) -> None:
        """Close SUMO."""
        if self._game is not None:
            self._game.close()
            self._game = None

    def _begin(self, which: NDArray[np.int64]) -> None:
        starts = pool_starts(len(which), self._rng, self._scenario)
        for corridor, start in zip(which.tolist(), starts, strict=True):
            if self.svo is not None:
                draw = self._rng.uniform(SVO.low, SVO.high) if self.svo == "random" else self.svo
                self._svo_rad[corridor] = draw
            self.game.begin(corridor, start)
        self._steps[which] = 0

    def _observe(self, state: FloatArray) -> FloatArray:
        if self.svo is not None:
            state = np.column_stack([state, self._svo_rad])
        return np.clip(state, self._low, self._high)


class MergeEnv(gymnasium.Env[FloatArray, np.int64]):
    """One merging game, `merge_sumo/Merge-v0`; SUMO starts with the first reset."""

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        role: Role = "pov",
        opponent: str = "level0",
        svo: float | Literal["random"] | None = None,
        weights: RewardWeights | None = None,
        render_mode: None = None,
        scenario: Scenario = US23,
    ) -> None:
        """See `MergeVectorEnv`."""
        self.render_mode = render_mode
        self._games = MergeVectorEnv(1, role, opponent, svo, weights, scenario)
        self.observation_space = self._games.single_observation_space
        self.action_space = self._games.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Begin a game from a start of the pool."""
        super().reset(seed=seed)
        observations, _ = self._games.reset(seed=int(self.np_random.integers(2**31)))
        return observations[0], {}

    def step(self, action: np.int64) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Take one decision."""
        observations, reward, terminated, truncated, _ = self._games.step(np.array([action]))
        return observations[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), {}

    def close(self) -> None:
        """Close SUMO."""
        self._games.close()


def make_opponent(role: Role, opponent: str, corridors: int) -> Driver:
    """Return the driver that plays against `role`; `UserError` for a name nobody knows."""
    if role not in ("pov", "vut"):
        raise UserError(f"there is no role {role!r}: choose pov or vut")
    if opponent == "level0":
        return Level0Vut(corridors) if role == "pov" else Level0Pov(corridors)
    wanted = "vut" if role == "pov" else "pov"
    if not opponent.startswith(wanted):
        raise UserError(f"a {role} cannot play against {opponent!r}: choose level0 or a {wanted}")
    return load_driver(opponent, corridors)
