"""Fine convergence of a network: policy iteration by rollouts, after DDQN has covered the game.

DDQN learns from its own estimates and is left with small errors everywhere; that is most of the
regret of a driver with little to gain. But a level-k driver knows its opponent, so rollouts give
the value of an action. Each round

1. plays the present policy from many starts, and searches for a better game from some of them, half
   of which are near those where the last search was most successful;
2. plays every action out, held for one decision and for two, in states of these games that are
   worth it (`_label`), followed by the policy (Lagoudakis and Parr, 2003). Where the game of the
   search is better, its return counts: a lower bound of the best return, as that of any game that
   was played (He et al., 2016);
3. trains the network so that its choice loses little return, and that Q stays near the returns. The
   average of its weights is the policy of the next round.

The cost of a choice is trained rather than the fit of Q, so that the 128 units describe where one
action becomes better than another. The game is deterministic, and its reward is known.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits
from torch import nn

from merge_sumo.drivers.levelk import ACTIONS, QNetwork
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import SVO
from merge_sumo.training.best_response import beam_search
from merge_sumo.training.ddqn import TrainingProgress, as_torch, descend, export, squash
from merge_sumo.training.game import Game, IntArray, exploring_starts, greedy, inputs_of

BETTER = 1e-3
"""A game of the search is better than that of the policy where its return is higher by more."""
COST_CAP = 1.0
"""Larger costs of a choice count as this, so that a crash does not drown the rest."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RefineSettings:
    """Settings of `refine`."""

    rounds: int = 16  # of policy iteration
    starts: int = 1_500  # games per round
    midway: float = 0.25  # share of them that begin mid-way (`game.exploring_starts`)
    searched: int = 300  # starts from which a better game is searched for
    hard: float = 0.5  # share of these that are near starts where the last search found most
    near: float = 0.02  # how near, in standard deviations of the starts
    beam: int = 32  # width of that search
    exploration: float = 0.2  # share of random actions in a second game from every second start
    unsure: float = 0.05  # lead of the best Q below which a state is always labelled
    sure_share: float = 0.15  # share of the other states that are labelled
    held: int = 2  # most decisions for which an action is held before the policy follows
    kept_rounds: int = 8  # rounds whose states are trained on
    updates: int = 2_500  # gradient steps per round
    batch: int = 512  # states per update
    learning_rate: float = 8e-4  # at the start; falls to 2 % of it along a cosine
    temperature: float = 0.01  # of the softmax by which the cost of a choice is made differentiable
    value_share: float = 0.1  # weight of the fit of Q next to the cost of the choice


@dataclass(frozen=True, slots=True)
class _Starts:
    """Starts of games: states, (n, 4), and psi, (n,)."""

    state: FloatArray
    svo_rad: FloatArray

    def __getitem__(self, which: slice | IntArray) -> _Starts:
        return _Starts(self.state[which], self.svo_rad[which])


@dataclass(frozen=True, slots=True)
class _Tried:
    """States of the games of a round, and the actions that were tried there.

    Attributes:
        at: states and psi.
        action: the actions, (n,).
        to_go: the returns from there on, (n,).
        better: whether the game was found by the search, and is better than that of the policy.
        hard: a quarter of the searched starts: those where the search found most.
        mean_return: mean return of the policy.
    """

    at: _Starts
    action: IntArray
    to_go: FloatArray
    better: NDArray[np.bool_]
    hard: _Starts
    mean_return: float


def refine(
    game: Game,
    network: QNetwork,
    seed: int,
    settings: RefineSettings | None = None,
    on_progress: Callable[[TrainingProgress], None] = lambda _: None,
) -> QNetwork:
    """Return the network, refined for its game; same seed, same weights.

    Args:
        game: the game.
        network: a network that `ddqn.train` has trained for it.
        seed: seed of starts, exploration and batches.
        settings: by default those of level 1.
        on_progress: called after every round.
    """
    s = settings or RefineSettings()
    rng = np.random.default_rng([seed, 1])
    model, average = as_torch(network), as_torch(network)
    optimiser = torch.optim.Adam(model.parameters(), lr=s.learning_rate, fused=True)
    rounds: list[tuple[np.ndarray, np.ndarray]] = []
    hard: _Starts | None = None
    # One thread: rounding must not depend on the number of cores. One limit for all rounds: where
    # it ends, the BLAS of libsumo gives torch its threads back, and they wait for each other.
    with threadpool_limits(1):
        torch.set_num_threads(1)
        for number in range(s.rounds):
            tried = _try(game, network, _starts(game, network, hard, rng, s), rng, s)
            hard = tried.hard
            rounds = [*rounds, _label(game, network, tried, rng, s)][-s.kept_rounds :]
            inputs, returns = map(np.concatenate, zip(*rounds, strict=True))
            cost = _fit(model, average, optimiser, inputs, returns, rng, s, number)
            network = export(average, game.a_min_mps2)
            progress = TrainingProgress(
                stage="refine",
                done=number + 1,
                total=s.rounds,
                loss=cost,
                mean_return=tried.mean_return,
            )
            on_progress(progress)
    return network


def _starts(
    game: Game, network: QNetwork, hard: _Starts | None, rng: np.random.Generator, s: RefineSettings
) -> _Starts:
    """Return the starts of the games of a round; the first are near hard starts, if any."""
    state = exploring_starts(s.starts, rng, s.midway, scenario=game.scenario)
    svo_rad = rng.uniform(SVO.low, SVO.high, s.starts) * network.sees_svo
    if hard is not None and len(hard.state):
        near = hard[rng.integers(0, len(hard.state), round(s.hard * s.searched))]
        n = len(near.state)
        # The VUT starts where it did: the state and psi of the POV make a case.
        shift = rng.normal(size=(3, n)) * s.near
        x_pov = near.state[:, 0] + shift[0] * state[:, 0].std()
        v_pov = np.maximum(near.state[:, 1] + shift[1] * state[:, 1].std(), 0.0)
        psi = near.svo_rad + shift[2] * svo_rad.std()
        state[:n] = np.column_stack([x_pov, v_pov, near.state[:, 2:]])
        svo_rad[:n] = psi.clip(SVO.low, SVO.high) * network.sees_svo
    return _Starts(state, svo_rad)


def _label(
    game: Game, network: QNetwork, tried: _Tried, rng: np.random.Generator, s: RefineSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Return states as the network sees them, (n, features), and the return of each action, (n, 7).

    A network changes its choice where two actions are nearly equal. So these states are kept, those
    of games that are better than those of the policy, and a share of the others.
    """
    policy = greedy(network, game.scenario)
    inputs = inputs_of(network, tried.at.state, tried.at.svo_rad, game.scenario)
    second, first = np.partition(network.values_at_once(inputs), -2, axis=1)[:, -2:].T
    some = rng.random(len(inputs)) < s.sure_share
    kept = np.flatnonzero((first - second < s.unsure) | tried.better | some)
    at = tried.at[kept]
    returns = game.action_returns(at.state, at.svo_rad, policy)
    for held in range(2, s.held + 1):
        longer = game.action_returns(at.state, at.svo_rad, policy, held)
        returns = np.maximum(returns, longer)
    row, action = np.arange(len(kept)), tried.action[kept]
    returns[row, action] = np.maximum(returns[row, action], tried.to_go[kept])
    return inputs[kept].astype(np.float32), returns.astype(np.float32)


def _try(
    game: Game, network: QNetwork, starts: _Starts, rng: np.random.Generator, s: RefineSettings
) -> _Tried:
    """Play games by the policy, by the policy with random actions, and those of a search."""
    n, policy = len(starts.state), greedy(network, game.scenario)
    searched = starts[: s.searched]
    _, plans = beam_search(game, searched.state, searched.svo_rad, network, s.beam)
    groups = starts, starts[::2], searched
    state = np.concatenate([group.state for group in groups])
    psi = np.concatenate([group.svo_rad for group in groups])
    first_search = len(state) - len(plans)
    index, total = np.arange(len(state)), np.zeros(len(state))
    plan = np.full((len(state), game.max_decisions), -1)
    plan[first_search:] = plans
    random = np.zeros(len(state))
    random[n:first_search] = s.exploration
    steps = []
    for decision in range(game.max_decisions):
        planned = plan[index, decision]
        action = np.where(planned >= 0, planned, policy(state, psi[index]))
        at_random = rng.random(len(index)) < random[index]
        action = np.where(at_random, rng.integers(0, ACTIONS, len(index)), action)
        steps.append((index, state, action, total[index]))
        state, reward, over = game.advance(state, psi[index], game.actions_mps2[action])
        total[index] += reward
        index, state = index[~over], state[~over]
        if not index.size:
            break
    gained = total[first_search:] - total[: s.searched]
    better = np.zeros(len(total), dtype=bool)
    better[first_search:] = gained > BETTER
    most = np.argsort(-gained, kind="stable")[: len(gained) // 4]
    index, state, action, before = map(np.concatenate, zip(*steps, strict=True))
    return _Tried(
        at=_Starts(state, psi[index]),
        action=action,
        to_go=total[index] - before,
        better=better[index],
        hard=starts[most],
        mean_return=float(total[:n].mean()),
    )


def _fit(
    model: nn.Sequential,
    average: nn.Sequential,
    optimiser: torch.optim.Adam,
    inputs: np.ndarray,
    returns: np.ndarray,
    rng: np.random.Generator,
    s: RefineSettings,
    number: int,
) -> float:
    """Train on states, and let the average of the weights follow.

    Args:
        model: the network that is trained.
        average: network with the average of the weights.
        optimiser: optimiser of the weights of the model.
        inputs: states as the network sees them, (n, features).
        returns: returns of the actions, (n, 7).
        rng: source of random numbers.
        s: the settings.
        number: number of the round.

    Returns:
        The mean cost of a choice over the last 100 updates.
    """
    states, targets = torch.from_numpy(inputs), torch.from_numpy(returns)
    costs = (targets.max(dim=1, keepdim=True).values - targets).clamp(max=COST_CAP)
    values = squash(targets)
    last_costs = []
    for update in range(s.updates):
        done = (number * s.updates + update) / (s.rounds * s.updates)
        for group in optimiser.param_groups:
            group["lr"] = s.learning_rate * max(0.02, 0.5 * (1.0 + math.cos(math.pi * done)))
        rows = torch.from_numpy(rng.integers(0, len(states), s.batch))
        q = model(states[rows])
        chosen = torch.softmax(q / s.temperature, dim=1)
        cost = (chosen * costs[rows]).sum(dim=1).mean()
        loss = cost + s.value_share * nn.functional.smooth_l1_loss(q, values[rows])
        descend(optimiser, loss, model, average, 1.0)
        last_costs.append(float(cost.detach()))
    return float(np.mean(last_costs[-100:]))
