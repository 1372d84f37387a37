"""Fine convergence of a network: policy iteration by rollouts, after DDQN has covered the game.

DDQN learns from its own estimates and is left with small errors everywhere; that is most of the
regret of a driver with little to gain. But a level-k driver knows its opponent, so what an action
is worth can be found by playing it out. Each round

1. plays the present policy from many starts and searches, from some of them, for a better game;
   part of the latter are near those where the last search was most successful;
2. plays every action out, held for one decision and for two, in the states of all these games that
   are worth it (`_label`), with the policy going on after it (Lagoudakis and Parr, 2003);
   where the game that was found is better, its return counts (a lower bound of the best return, as
   that of any game that was played: He et al., 2016);
3. trains the network so that the loss of return which its choice means is small, and that Q stays
   near the returns. The average of its weights is the policy of the next round.

The cost of a choice is what is trained, not the fit of Q: the 128 units spend themselves on where
one action becomes better than another. The game is deterministic, and its reward is known.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from merge_sumo.drivers.levelk import ACTIONS, QNetwork
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import SVO
from merge_sumo.training.best_response import beam_search
from merge_sumo.training.ddqn import TrainingProgress, as_torch, descend, export, squash
from merge_sumo.training.game import Game, IntArray, exploring_starts, greedy, inputs_of

BETTER = 1e-3
"""A game that was found is better than the policy's where its return is higher by more."""
COST_CAP = 1.0
"""A choice that costs more is wrong enough: what a crash costs must not drown the rest."""


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
    held: int = 2  # most decisions for which an action is held before the policy goes on
    kept_rounds: int = 8  # rounds whose states are trained on
    updates: int = 2_500  # gradient steps per round
    batch: int = 512  # states per update
    learning_rate: float = 8e-4  # at the start; falls to 2 % of it along a cosine
    polyak: float = 0.005  # share of the weights that their average takes over per update
    temperature: float = 0.01  # of the softmax by which the cost of a choice is made differentiable
    value_share: float = 0.1  # weight of the fit of Q beside the cost of the choice


_Starts = tuple[FloatArray, FloatArray]
"""Starts of games: states, (n, 4), and psi, (n,)."""


@dataclass(frozen=True, slots=True)
class _Tried:
    """States of the games that are kept: what was done there, and the return from there on."""

    state: FloatArray
    svo_rad: FloatArray
    action: IntArray
    to_go: FloatArray
    better: NDArray[np.bool_]  # whether the game was found, and is better than the policy's
    hard: _Starts  # a quarter of the searched starts: those where the search found most
    mean_return: float


_Labelled = tuple[np.ndarray, np.ndarray]
"""States as the network sees them, (n, features), and what each action is worth, (n, 7)."""


def refine(
    game: Game,
    network: QNetwork,
    seed: int,
    settings: RefineSettings | None = None,
    on_progress: Callable[[TrainingProgress], None] | None = None,
) -> QNetwork:
    """Return the network, refined for its game; same seed, same weights.

    Args:
        game: the game.
        network: a network that `ddqn.train` has trained for it.
        seed: of starts, exploration and batches.
        settings: by default those of level 1.
        on_progress: called after every round.
    """
    from threadpoolctl import threadpool_limits

    s = settings or RefineSettings()
    rng = np.random.default_rng([seed, 1])
    model, average = as_torch(network), as_torch(network)
    optimiser = torch.optim.Adam(model.parameters(), lr=s.learning_rate, fused=True)
    rounds: list[_Labelled] = []
    hard: _Starts | None = None
    # One thread: rounding must not depend on the number of cores. One limit for all rounds: where
    # it ends, the BLAS beside libsumo gives torch its threads back, and they wait for each other.
    with threadpool_limits(1):
        torch.set_num_threads(1)
        for number in range(s.rounds):
            tried = _try(game, network, _starts(game, network, hard, rng, s), rng, s)
            hard = tried.hard
            rounds = [*rounds, _label(game, network, tried, rng, s)][-s.kept_rounds :]
            cost = _fit(model, average, optimiser, rounds, rng, s, number)
            network = export(average, game.a_min_mps2)
            if on_progress is not None:
                on_progress(
                    TrainingProgress(
                        stage="refine",
                        done=number + 1,
                        total=s.rounds,
                        loss=cost,
                        mean_return=tried.mean_return,
                    )
                )
    return network


def _starts(
    game: Game, network: QNetwork, hard: _Starts | None, rng: np.random.Generator, s: RefineSettings
) -> _Starts:
    """Return the starts of the games of a round; the first are near hard starts, if any."""
    state = exploring_starts(s.starts, rng, s.midway, scenario=game.scenario)
    svo_rad = rng.uniform(SVO.low, SVO.high, s.starts) * network.sees_svo
    if hard is not None and len(hard[0]):
        which = rng.integers(0, len(hard[0]), round(s.hard * s.searched))
        # The VUT starts where it did: it is the POV's state and psi that make a case.
        shift = rng.normal(size=(3, len(which))) * s.near
        near = hard[0][which]
        near[:, 0] += shift[0] * state[:, 0].std()
        near[:, 1] = np.maximum(near[:, 1] + shift[1] * state[:, 1].std(), 0.0)
        psi = hard[1][which] + shift[2] * svo_rad.std()
        state[: len(which)] = near
        svo_rad[: len(which)] = psi.clip(SVO.low, SVO.high) * network.sees_svo
    return state, svo_rad


def _label(
    game: Game, network: QNetwork, tried: _Tried, rng: np.random.Generator, s: RefineSettings
) -> _Labelled:
    """Return states that were tried, with the worth of each action."""
    policy = greedy(network, game.scenario)
    inputs = inputs_of(network, tried.state, tried.svo_rad, game.scenario)
    # A network changes its choice where two actions are nearly equal. So these states are kept,
    # those of games that are better than the policy's, and a share of the others.
    second, first = np.partition(network.values_at_once(inputs), -2, axis=1)[:, -2:].T
    some = rng.random(len(inputs)) < s.sure_share
    kept = np.flatnonzero((first - second < s.unsure) | tried.better | some)
    state, svo_rad = tried.state[kept], tried.svo_rad[kept]
    of_holds = [
        game.action_returns(state, svo_rad, policy, decisions) for decisions in range(1, s.held + 1)
    ]
    returns = np.max(of_holds, axis=0)
    row, action = np.arange(len(kept)), tried.action[kept]
    returns[row, action] = np.maximum(returns[row, action], tried.to_go[kept])
    return inputs[kept].astype(np.float32), returns.astype(np.float32)


def _try(
    game: Game, network: QNetwork, starts: _Starts, rng: np.random.Generator, s: RefineSettings
) -> _Tried:
    """Play by the policy, from half of the starts with random actions too, and what is found."""
    start, svo_rad = starts
    policy, searched = greedy(network, game.scenario), slice(s.searched)
    _, plans = beam_search(game, start[searched], svo_rad[searched], network, s.beam)
    state = np.concatenate([start, start[::2], start[searched]])
    psi = np.concatenate([svo_rad, svo_rad[::2], svo_rad[searched]])
    index, total = np.arange(len(state)), np.zeros(len(state))
    plan = np.full((len(state), game.max_decisions), -1)
    plan[len(state) - len(plans) :] = plans
    random = np.zeros(len(state))
    random[len(start) : len(state) - len(plans)] = s.exploration
    steps: list[tuple[IntArray, FloatArray, IntArray, FloatArray]] = []
    for decision in range(game.max_decisions):
        planned = plan[index, decision]
        action = np.where(planned >= 0, planned, policy(state, psi[index]))
        at_random = rng.random(len(index)) < random[index]
        action = np.where(at_random, rng.integers(0, ACTIONS, len(index)), action)
        before = state
        state, reward, over = game.advance(state, psi[index], game.actions_mps2[action])
        steps.append((index, before, action, total[index]))
        total[index] += reward
        index, state = index[~over], state[~over]
        if not index.size:
            break
    gained = total[len(total) - len(plans) :] - total[searched]
    better = np.zeros(len(total), dtype=bool)
    better[len(total) - len(plans) :] = gained > BETTER
    most = np.argsort(-gained, kind="stable")[: len(gained) // 4]
    index = np.concatenate([step[0] for step in steps])
    return _Tried(
        state=np.concatenate([step[1] for step in steps]),
        svo_rad=psi[index],
        action=np.concatenate([step[2] for step in steps]),
        to_go=total[index] - np.concatenate([step[3] for step in steps]),
        better=better[index],
        hard=(start[most], svo_rad[most]),
        mean_return=float(total[: len(start)].mean()),
    )


def _fit(
    model: nn.Sequential,
    average: nn.Sequential,
    optimiser: torch.optim.Adam,
    rounds: list[_Labelled],
    rng: np.random.Generator,
    s: RefineSettings,
    number: int,
) -> float:
    """Train on the kept rounds; return the mean cost of a choice over the last updates.

    `average` follows the weights of the model.
    """
    inputs, returns = (torch.from_numpy(np.concatenate(of)) for of in zip(*rounds, strict=True))
    costs = (returns.max(dim=1, keepdim=True).values - returns).clamp(max=COST_CAP)
    values = squash(returns)
    last_costs = []
    for update in range(s.updates):
        done = (number * s.updates + update) / (s.rounds * s.updates)
        for group in optimiser.param_groups:
            group["lr"] = s.learning_rate * max(0.02, 0.5 * (1.0 + math.cos(math.pi * done)))
        rows = torch.from_numpy(rng.integers(0, len(inputs), s.batch))
        q = model(inputs[rows])
        chosen = torch.softmax(q / s.temperature, dim=1)
        cost = (chosen * costs[rows]).sum(dim=1).mean()
        loss = cost + s.value_share * nn.functional.smooth_l1_loss(q, values[rows])
        descend(optimiser, loss, model, average, 1.0, s.polyak)
        if update >= s.updates - 100:
            last_costs.append(float(cost.detach()))
    return float(np.mean(last_costs))
