"""The merging game as a function of states: eq. (4) and a known opponent, thousands at once.

SUMO follows eq. (4) to 1e-9, so what is played here is what happens there. A level-k driver knows
its opponent, the driver of level k-1, so it can play the game out: that is what refinement
(`refine`) and the search for a best response (`best_response`) do.

A state is [x_POV, v_POV, x_VUT, v_VUT], in m and m/s; a decision lasts 0.5 s.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.level0 import level0_acceleration
from merge_sumo.drivers.levelk import ACTIONS_MPS2, DECISION_STEPS, QNetwork, features
from merge_sumo.training.reward import (
    RewardWeights,
    pov_reward,
    pov_step,
    safety,
    vut_end,
    vut_step,
)
from merge_sumo.values.case import FloatArray
from merge_sumo.values.scenario import DT_S, MAX_STEPS

Role = Literal["pov", "vut"]
IntArray = NDArray[np.int64]

MAX_DECISIONS: Final = MAX_STEPS // DECISION_STEPS

Policy = Callable[[FloatArray, FloatArray], IntArray]
"""The places in ACTIONS_MPS2, (n,), that are chosen in states, (n, 4), for psi, (n,)."""


@dataclass(frozen=True, slots=True)
class Game:
    """What an agent plays: its role, the opponent that it knows, and the reward.

    Attributes:
        role: "pov" or "vut".
        opponent: the network of level k-1, or None for the level-0 driver.
        weights: of the reward.
    """

    role: Role
    opponent: QNetwork | None
    weights: RewardWeights

    def advance(
        self, state: FloatArray, svo_rad: FloatArray, a_mps2: FloatArray
    ) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """Hold accelerations, (n,), for one decision; return states, rewards, and what is over."""
        x_pov, v_pov, x_vut, v_vut = state.T.copy()
        of_pov, weights = self.role == "pov", self.weights
        learned = self._learned_answer(state, svo_rad)
        safe, pov_ego, vut_ego = np.zeros((3, len(state)))
        live = np.ones(len(state), dtype=bool)
        for _ in range(DECISION_STEPS):
            other = self._level0_answer(v_vut) if learned is None else learned
            a_pov, a_vut = (a_mps2, other) if of_pov else (other, a_mps2)
            pov_ego += live * pov_step(v_pov, a_pov, weights)
            vut_ego += live * vut_step(v_vut, a_vut, weights)
            x_pov = x_pov + live * v_pov * DT_S
            x_vut = x_vut + live * v_vut * DT_S
            v_pov = np.where(live, np.maximum(v_pov + a_pov * DT_S, 0.0), v_pov)
            v_vut = np.where(live, np.maximum(v_vut + a_vut * DT_S, 0.0), v_vut)
            arrived = live & (x_vut >= 0.0)
            if arrived.any():
                safe += arrived * safety(x_pov - x_vut, v_pov - v_vut, weights)
                vut_ego += arrived * vut_end(v_vut, weights)
                live &= ~arrived
        reward = pov_reward(safe, pov_ego, vut_ego, svo_rad) if of_pov else safe + vut_ego
        return np.stack([x_pov, v_pov, x_vut, v_vut], axis=1), reward, ~live

    def play(
        self,
        state: FloatArray,
        svo_rad: FloatArray,
        policy: Policy,
        first: IntArray | None = None,
    ) -> FloatArray:
        """Return the returns, (n,), of playing to the end, with `first` as the first actions."""
        returns, index = np.zeros(len(state)), np.arange(len(state))
        for _ in range(MAX_DECISIONS):
            action = policy(state, svo_rad) if first is None else first
            first = None
            state, reward, over = self.advance(state, svo_rad, ACTIONS_MPS2[action])
            returns[index] += reward
            index, state, svo_rad = index[~over], state[~over], svo_rad[~over]
            if not index.size:
                break
        return returns

    def action_returns(self, state: FloatArray, svo_rad: FloatArray, policy: Policy) -> FloatArray:
        """Return what each action is worth, (n, 7), when the policy goes on after it."""
        actions = len(ACTIONS_MPS2)
        repeated, psi = np.repeat(state, actions, axis=0), np.repeat(svo_rad, actions)
        first = np.tile(np.arange(actions), len(state))
        return self.play(repeated, psi, policy, first).reshape(len(state), actions)

    def improved(self, policy: Policy) -> Policy:
        """Return the policy that plays every action out before it chooses (Tesauro, 1996)."""
        return lambda state, svo_rad: self.action_returns(state, svo_rad, policy).argmax(axis=1)

    def _learned_answer(self, state: FloatArray, svo_rad: FloatArray) -> FloatArray | None:
        """Return what the learned opponent holds for the decision, (n,)."""
        if self.opponent is None:
            return None
        return np.asarray(ACTIONS_MPS2[greedy(self.opponent)(state, svo_rad)], dtype=np.float64)

    def _level0_answer(self, v_vut_mps: FloatArray) -> FloatArray:
        """Return the level-0 opponent's acceleration at a step, (n,)."""
        if self.role == "vut":
            return np.zeros_like(v_vut_mps)
        return np.asarray(level0_acceleration(v_vut_mps), dtype=np.float64)


def greedy(network: QNetwork) -> Policy:
    """Return the policy that takes the action of the highest Q."""

    def choose(state: FloatArray, svo_rad: FloatArray) -> IntArray:
        return np.asarray(network.values_at_once(inputs_of(network, state, svo_rad)).argmax(axis=1))

    return choose


def inputs_of(network: QNetwork, state: FloatArray, svo_rad: FloatArray) -> FloatArray:
    """Return what a network sees of states, (n, 4), and of psi, (n,), if it has one."""
    x_pov, v_pov, x_vut, v_vut = state.T
    return features(x_pov, v_pov, x_vut, v_vut, svo_rad if network.sees_svo else None)
