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
from merge_sumo.training.ddqn import Learner, TrainingProgress, as_torch, export, squash
from merge_sumo.training.game import Game, IntArray, exploring_starts, greedy

BETTER = 1e-3
"""A game of the search is better than that of the policy where its return is higher by more."""
COST_CAP = 1.0
"""Larger costs of a choice count as this, so that a crash does not drown the rest."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RefineSettings:
    """Settings of `refine`.

    Attributes:
        rounds: rounds of policy iteration.
        starts: games per round.
        midway: share of games that begin mid-way (`game.exploring_starts`).
        searched: starts from which a better game is searched for.
        hard: share of these that are near starts where the last search gained most.
        near: distance to those starts, in standard deviations of the starts.
        beam: width of the search.
        exploration: share of random actions in a second game from every second start.
        unsure: lead of the best Q below which a state is always labelled.
        sure_share: share of the other states that are labelled.
        held: most decisions for which an action is held before the policy follows.
        kept_rounds: rounds whose states are trained on.
        updates: gradient steps per round.
        batch: states per update.
        learning_rate: learning rate at the start; it falls to 2 % of it along a cosine.
        temperature: temperature of the softmax that makes the cost of a choice differentiable.
        value_share: weight of the fit of Q; the cost of the choice has weight 1.
    """

    rounds: int = 16
    starts: int = 1_500
    midway: float = 0.25
    searched: int = 300
    hard: float = 0.5
    near: float = 0.02
    beam: int = 32
    exploration: float = 0.2
    unsure: float = 0.05
    sure_share: float = 0.15
    held: int = 2
    kept_rounds: int = 8
    updates: int = 2_500
    batch: int = 512
    learning_rate: float = 8e-4
    temperature: float = 0.01
    value_share: float = 0.1


@dataclass(frozen=True, slots=True)
class _Tried:
    """States of the games of a round, and the actions that were tried there.

    Attributes:
        at: states and psi, (n, 5).
        action: the actions, (n,).
        to_go: the returns from there on, (n,).
        better: whether the game was found by the search, and is better than that of the policy.
        hard: starts, (m, 5): the quarter of the searched ones where the search gained most.
        mean_return: mean return of the policy.
    """

    at: FloatArray
    action: IntArray
    to_go: FloatArray
    better: NDArray[np.bool_]
    hard: FloatArray
    mean_return: float


def refine(
    game: Game,
    network: QNetwork,
    seed: int,
    settings: RefineSettings,
    on_progress: Callable[[TrainingProgress], None],
) -> QNetwork:
    """Refine a network for its game; same seed, same weights.

    Args:
        game: the game.
        network: a network that `ddqn.train` has trained for it.
        seed: seed of starts, exploration and batches.
        settings: settings; their defaults are those of level 1.
        on_progress: called after every round.

    Returns:
        The refined network.
    """
    s = settings
    rng = np.random.default_rng([seed, 1])
    learner = Learner(as_torch(network))
    rounds: list[tuple[np.ndarray, np.ndarray]] = []
    hard = np.zeros((0, 5))
    # One thread: rounding must not depend on the number of cores. One limit for all rounds: where
    # it ends, the BLAS of libsumo gives torch its threads back, and they wait for each other.
    with threadpool_limits(1):
        torch.set_num_threads(1)
        for number in range(s.rounds):
            tried = _try(game, network, _starts(game, network, hard, rng, s), rng, s)
            hard = tried.hard
            rounds = [*rounds, _label(game, network, tried, rng, s)][-s.kept_rounds :]
            inputs, returns = map(np.concatenate, zip(*rounds, strict=True))
            cost = _fit(learner, inputs, returns, rng, s, number)
            network = export(learner.average, game.a_min_mps2)
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
    game: Game, network: QNetwork, hard: FloatArray, rng: np.random.Generator, s: RefineSettings
) -> FloatArray:
    """Return states and psi, (n, 5), at the starts of a round; the first are near hard starts."""
    state = exploring_starts(s.starts, rng, s.midway, scenario=game.scenario)
    svo_rad = rng.uniform(SVO.low, SVO.high, s.starts) * network.sees_svo
    starts = np.column_stack([state, svo_rad])
    if len(hard):
        near = hard[rng.integers(0, len(hard), round(s.hard * s.searched))]
        # The VUT starts where it did: the state and psi of the POV make a case.
        of_pov = [0, 1, 4]
        spread = starts.T[of_pov].std(axis=1)
        near[:, of_pov] += rng.normal(size=(3, len(near))).T * s.near * spread
        near[:, 1] = np.maximum(near[:, 1], 0.0)
        near[:, 4] = near[:, 4].clip(SVO.low, SVO.high) * network.sees_svo
        starts[: len(near)] = near
    return starts


def _label(
    game: Game, network: QNetwork, tried: _Tried, rng: np.random.Generator, s: RefineSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Return states as the network sees them, (n, features), and the return of each action, (n, 7).

    A network changes its choice where two actions are nearly equal. So these states are kept, those
    of games that are better than those of the policy, and a share of the others.
    """
    policy = greedy(network, game.scenario)
    inputs = network.observe(tried.at.T[:4], tried.at[:, 4], game.scenario)
    second, first = np.partition(network.values_at_once(inputs), -2, axis=1)[:, -2:].T
    some = rng.random(len(inputs)) < s.sure_share
    kept = np.flatnonzero((first - second < s.unsure) | tried.better | some)
    state, svo_rad = tried.at[kept, :4], tried.at[kept, 4]
    returns = game.action_returns(state, svo_rad, policy)
    for held in range(2, s.held + 1):
        longer = game.action_returns(state, svo_rad, policy, held)
        returns = np.maximum(returns, longer)
    row, action = np.arange(len(kept)), tried.action[kept]
    returns[row, action] = np.maximum(returns[row, action], tried.to_go[kept])
    return inputs[kept].astype(np.float32), returns.astype(np.float32)


def _try(
    game: Game, network: QNetwork, starts: FloatArray, rng: np.random.Generator, s: RefineSettings
) -> _Tried:
    """Play games by the policy, by the policy with random actions, and those of a search."""
    n, policy = len(starts), greedy(network, game.scenario)
    searched = starts[: s.searched]
    _, plans = beam_search(game, searched[:, :4], searched[:, 4], network, s.beam)
    played = np.concatenate([starts, starts[::2], searched])
    state, psi = played[:, :4], played[:, 4]
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
        at=np.column_stack([state, psi[index]]),
        action=action,
        to_go=total[index] - before,
        better=better[index],
        hard=starts[most],
        mean_return=float(total[:n].mean()),
    )


def _fit(
    learner: Learner,
    inputs: np.ndarray,
    returns: np.ndarray,
    rng: np.random.Generator,
    s: RefineSettings,
    number: int,
) -> float:
    """Train on states, and let the average of the weights follow.

    Args:
        learner: the network that is trained, with the average of its weights.
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
        rate = s.learning_rate * max(0.02, 0.5 * (1.0 + math.cos(math.pi * done)))
        rows = torch.from_numpy(rng.integers(0, len(states), s.batch))
        q = learner.network(states[rows])
        chosen = torch.softmax(q / s.temperature, dim=1)
        cost = (chosen * costs[rows]).sum(dim=1).mean()
        loss = cost + s.value_share * nn.functional.smooth_l1_loss(q, values[rows])
        learner.descend(loss, rate, 1.0)
        last_costs.append(float(cost.detach()))
    return float(np.mean(last_costs[-100:]))
