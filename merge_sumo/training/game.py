"""The merging game as a function of states: eq. (4) and a known opponent, thousands at once.

SUMO follows eq. (4) to 1e-9, so a game has the same course there (`check.py` compares them). A
level-k driver knows its opponent, the driver of level k-1, so refinement (`refine`) and the search
for a best response (`best_response`) can play the game to its end.

A state is [x_POV, v_POV, x_VUT, v_VUT], in m and m/s; a decision lasts 0.5 s.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.level0 import level0_acceleration, level0_time_to
from merge_sumo.drivers.levelk import ACTIONS, DECISION_STEPS, QNetwork, actions_mps2
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.imperfection import Actuation, Sensing
from merge_sumo.scenario.scenario import DT_S, Scenario, Units
from merge_sumo.training.reward import Reward, RewardParts, RewardWeights, Role

IntArray = NDArray[np.int64]


def of_two(scenario: Scenario) -> Scenario:
    """Return a scenario of a POV and a VUT alone, with perfect sensors and actuators.

    Args:
        scenario: a scenario, possibly with more cars and imperfect sensors and actuators.
    """
    return replace(
        scenario,
        headway_ahead_s=None,
        headway_behind_s=None,
        sense=Sensing(),
        act=Actuation(),
    )


Policy = Callable[[FloatArray, FloatArray], IntArray]
"""Chooses actions, (n,), as indices of `actions_mps2`, in states, (n, 4), for psi, (n,)."""


@dataclass(frozen=True, slots=True)
class Game:
    """A game of an agent.

    Example:
        game = Game("pov", None, Reward.of(US23))
        returns = game.play(state, svo_rad, greedy(network, US23))

    Attributes:
        role: vehicle of the agent, "pov" or "vut".
        opponent: the network of level k-1; None for the level-0 driver.
        reward: the reward of the scenario that is played.
        a_min_mps2: hardest braking of the agent; None for that of the scenario.
    """

    role: Role
    opponent: QNetwork | None
    reward: Reward
    a_min_mps2: float | None = None

    @property
    def scenario(self) -> Scenario:
        """The scenario that is played."""
        return self.reward.scenario

    @property
    def sees_svo(self) -> bool:
        """Whether the agent sees psi: as a POV whose opponent reacts, that of level 2."""
        return self.role == "pov" and self.opponent is not None

    @property
    def of_agent(self) -> Scenario:
        """The scenario with the agent's limit of braking."""
        if self.a_min_mps2 is None:
            return self.scenario
        return replace(self.scenario, a_min_mps2=self.a_min_mps2)

    @property
    def actions_mps2(self) -> FloatArray:
        """The accelerations that the agent chooses from."""
        return actions_mps2(self.of_agent)

    @property
    def max_decisions(self) -> int:
        """Decisions until the timeout."""
        return self.scenario.max_steps // DECISION_STEPS

    def advance(
        self, state: FloatArray, svo_rad: FloatArray, a_mps2: FloatArray
    ) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """Hold accelerations for one decision.

        Args:
            state: states, (n, 4).
            svo_rad: psi of the POV, (n,).
            a_mps2: accelerations of the agent, (n,).

        Returns:
            The states after it, (n, 4), the agent's rewards, (n,), and whether each game is over,
            (n,).
        """
        after, parts, over = self.decide(state, svo_rad, a_mps2)
        return after, parts.of(self.role, svo_rad), over

    def decide(
        self, state: FloatArray, svo_rad: FloatArray, a_mps2: FloatArray
    ) -> tuple[FloatArray, RewardParts, NDArray[np.bool_]]:
        """Hold accelerations for one decision, with the rewards in parts.

        A game that is over stays in its state at t1.

        Args:
            state: states, (n, 4).
            svo_rad: psi of the POV, (n,).
            a_mps2: accelerations of the agent, (n,).

        Returns:
            The states after it, (n, 4), the parts of the rewards, and whether each game is over,
            (n,).
        """
        x_pov, v_pov, x_vut, v_vut = state.T.copy()
        reward, scenario = self.reward, self.scenario
        other = np.zeros(len(state))
        if self.opponent is not None:
            choices = actions_mps2(self.opponent.limited(scenario))
            other = choices[greedy(self.opponent, scenario)(state, svo_rad)]
        safe, pov_ego, vut_ego = np.zeros((3, len(state)))
        live = np.ones(len(state), dtype=bool)
        for _ in range(DECISION_STEPS):
            if self.role == "pov" and self.opponent is None:
                other = level0_acceleration(v_vut, scenario)
            a_pov, a_vut = (a_mps2, other) if self.role == "pov" else (other, a_mps2)
            pov_ego += live * reward.pov_step(v_pov, a_pov)
            vut_ego += live * reward.vut_step(v_vut, a_vut)
            x_pov = x_pov + live * v_pov * DT_S
            x_vut = x_vut + live * v_vut * DT_S
            v_pov = np.where(live, np.maximum(v_pov + a_pov * DT_S, 0.0), v_pov)
            v_vut = np.where(live, np.maximum(v_vut + a_vut * DT_S, 0.0), v_vut)
            arrived = live & (x_vut >= 0.0)
            if arrived.any():
                safe += arrived * reward.safety(x_pov - x_vut, v_pov - v_vut)
                vut_ego += arrived * reward.vut_end(v_vut)
                live &= ~arrived
        parts = RewardParts(safe, pov_ego, vut_ego)
        return np.stack([x_pov, v_pov, x_vut, v_vut], axis=1), parts, ~live

    def play(
        self,
        state: FloatArray,
        svo_rad: FloatArray,
        policy: Policy,
        first: IntArray | None = None,
        held: int = 1,
    ) -> FloatArray:
        """Play games to their ends.

        Args:
            state: states, (n, 4).
            svo_rad: psi of the POV, (n,).
            policy: chooses the actions.
            first: actions before those of the policy, (n,); None for none.
            held: number of decisions for which these are held.

        Returns:
            The returns, (n,).
        """
        returns, index = np.zeros(len(state)), np.arange(len(state))
        for decision in range(self.max_decisions):
            if first is not None and decision < held:
                action = first[index]
            else:
                action = policy(state, svo_rad)
            state, reward, over = self.advance(state, svo_rad, self.actions_mps2[action])
            returns[index] += reward
            index, state, svo_rad = index[~over], state[~over], svo_rad[~over]
        return returns

    def action_returns(
        self, state: FloatArray, svo_rad: FloatArray, policy: Policy, held: int = 1
    ) -> FloatArray:
        """Play games to their ends with each action as the first.

        Args:
            state: states, (n, 4).
            svo_rad: psi of the POV, (n,).
            policy: chooses the actions after the first.
            held: number of decisions for which the first action is held.

        Returns:
            The return of each action, (n, 7).
        """
        repeated, psi = np.repeat(state, ACTIONS, axis=0), np.repeat(svo_rad, ACTIONS)
        first = np.tile(np.arange(ACTIONS), len(state))
        return self.play(repeated, psi, policy, first, held).reshape(len(state), ACTIONS)

    def improved(self, policy: Policy) -> Policy:
        """Return the policy that plays every action out before it chooses (Tesauro, 1996).

        Args:
            policy: chooses the actions after the first.
        """

        def choose(state: FloatArray, svo_rad: FloatArray) -> IntArray:
            returns = self.action_returns(state, svo_rad, policy)
            return np.asarray(returns.argmax(axis=1))

        return choose


def greedy(network: QNetwork, scenario: Scenario) -> Policy:
    """Return the policy that takes the action of the highest Q.

    Args:
        network: gives Q, by products in float32.
        scenario: the scenario that is played.
    """

    def choose(state: FloatArray, svo_rad: FloatArray) -> IntArray:
        inputs = network.observe(state.T, svo_rad, scenario)
        return np.asarray(network.values_at_once(inputs).argmax(axis=1))

    return choose


def pool_starts(n: int, rng: np.random.Generator, scenario: Scenario) -> FloatArray:
    """Draw starting states, uniform over the pool.

    Args:
        n: number of states.
        rng: source of random numbers.
        scenario: the scenario of the pool.

    Returns:
        The states, (n, 4).
    """
    x_pov = rng.uniform(*scenario.x_pov0_m, n)
    v_pov = rng.uniform(*scenario.v_pov0_mps, n)
    v_vut = _starting_speeds(n, rng, scenario)
    return np.stack([x_pov, v_pov, np.full(n, scenario.x_vut0_m), v_vut], axis=1)


def _starting_speeds(n: int, rng: np.random.Generator, scenario: Scenario) -> FloatArray:
    low, high = scenario.bounds("v_vut0_mps")
    return rng.uniform(low, high, n) if low < high else np.full(n, low)


def exploring_starts(
    n: int, rng: np.random.Generator, midway: float, *, scenario: Scenario
) -> FloatArray:
    """Draw starting states: a share from mid-way in a game, the rest from the pool.

    Mid-way, both vehicles would mostly reach M together, because a small error of Q is a collision
    there. Some states are anywhere, because a black-box VUT leads the drivers to them.

    Args:
        n: number of states.
        rng: source of random numbers.
        midway: share of states from mid-way in a game.
        scenario: the scenario that is played.

    Returns:
        The states, (n, 4).
    """
    unit, wide_gap = Units.of(scenario), RewardWeights.of(scenario).gap_full_m / 60.0
    speed, x_vut0 = unit.speed, scenario.x_vut0_m
    (x_low, _), (v_low, v_high) = scenario.x_pov0_m, scenario.v_pov0_mps
    x_vut = rng.uniform(x_vut0, -1.0 * unit.length, n)
    v_vut0 = _starting_speeds(n, rng, scenario)
    on_profile = np.sqrt(v_vut0**2 + 2.0 * scenario.level0_a_mps2 * (x_vut - x_vut0))
    on_profile += rng.normal(0.0, 3.0 * speed, n)
    follows = rng.random(n) < 0.6
    v_vut = np.where(follows, on_profile, rng.uniform(2.0 * speed, scenario.v_hw_max_mps, n))
    v_vut = v_vut.clip(speed, scenario.v_hw_max_mps + speed)
    likely = rng.random(n) < 0.7
    near = rng.uniform(v_low - 5.0 * speed, v_high + 2.0 * speed, n)
    far = rng.uniform(v_low - 17.0 * speed, v_high + 7.0 * speed, n)
    v_pov = np.where(likely, near, far).clip(0.0)
    together = rng.random(n) < 0.7
    gap = np.where(together, rng.normal(0.0, 25.0, n), rng.uniform(-120.0, 120.0, n))
    x_pov = wide_gap * gap - v_pov * level0_time_to(-x_vut, v_vut, scenario)
    x_pov = x_pov.clip(x_low - 80.0 * unit.length, 150.0 * unit.length)
    states = np.stack([x_pov, v_pov, x_vut, v_vut], axis=1)
    return np.where(rng.random((n, 1)) < midway, states, pool_starts(n, rng, scenario))
