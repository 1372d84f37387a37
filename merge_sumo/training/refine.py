"""Fine convergence of a network: policy iteration by rollouts, after DDQN has covered the game.

DDQN learns from its own estimates and is left with small errors everywhere; that is most of the
regret of a driver with little to gain. But a level-k driver knows its opponent, so what an action
is worth can be found by playing it out. Each round

1. plays the present policy from many starts and searches, from some of them, for a better game;
2. plays every action out in the states of all these games, with the policy going on after it
   (Lagoudakis and Parr, 2003); where the game that was found is better, its return counts (a lower
   bound of the best return, as that of any game that was played: He et al., 2016);
3. trains the network so that the loss of return which its choice means is small, and that Q stays
   near the returns.

The cost of a choice is what is trained, not the fit of Q: the 128 units spend themselves on where
one action becomes better than another. The game is deterministic, and its reward is known.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from torch import nn

from merge_sumo.drivers.levelk import ACTIONS, QNetwork
from merge_sumo.training.best_response import beam_search
from merge_sumo.training.ddqn import Progress, as_torch, export, squash
from merge_sumo.training.env import exploring_starts
from merge_sumo.training.game import Game, IntArray, greedy, inputs_of
from merge_sumo.values.case import FloatArray
from merge_sumo.values.scenario import SVO

COST_CAP: Final = 1.0
"""A choice that costs more is wrong enough: what a crash costs must not drown the rest."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RefineSettings:
    """What `refine` does."""

    rounds: int = 16  # of policy iteration
    starts: int = 1_500  # games per round
    midway: float = 0.25  # share of them that begin mid-way (`env.exploring_starts`)
    searched: int = 300  # starts from which a better game is searched for
    beam: int = 32  # width of that search
    exploration: float = 0.2  # share of random actions in a second game from every second start
    kept_rounds: int = 16  # rounds whose states are trained on
    updates: int = 2_500  # gradient steps per round
    batch: int = 1_024  # states per update
    learning_rate: float = 5e-4  # at the start; falls to 2 % of it along a cosine
    temperature: float = 0.01  # of the softmax by which the cost of a choice is made differentiable
    value_share: float = 0.1  # weight of the fit of Q beside the cost of the choice


@dataclass(frozen=True, slots=True)
class _Labelled:
    """States as the network sees them, (n, features), and what each action is worth, (n, 7)."""

    inputs: np.ndarray
    returns: np.ndarray


def refine(
    game: Game,
    network: QNetwork,
    seed: int,
    settings: RefineSettings | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> QNetwork:
    """Return the network, refined for its game; same seed, same weights."""
    from threadpoolctl import threadpool_limits

    s = settings or RefineSettings()
    rng = np.random.default_rng([seed, 1])
    model = as_torch(network)
    optimiser = torch.optim.Adam(model.parameters(), lr=s.learning_rate, fused=True)
    rounds: list[_Labelled] = []
    # One thread: rounding must not depend on the number of cores. One limit for all rounds: where
    # it ends, the BLAS beside libsumo gives torch its threads back, and they wait for each other.
    with threadpool_limits(1):
        torch.set_num_threads(1)
        for number in range(s.rounds):
            labelled, mean_return = _label(game, network, rng, s)
            rounds = [*rounds, labelled][-s.kept_rounds :]
            cost = _fit(model, optimiser, rounds, rng, s, number)
            network = export(model)
            if on_progress is not None:
                on_progress(Progress(number + 1, cost, mean_return, None, network))
    return network


def _label(
    game: Game, network: QNetwork, rng: np.random.Generator, s: RefineSettings
) -> tuple[_Labelled, float]:
    """Return states of this round with the worth of each action, and the mean return."""
    policy = greedy(network, game.scenario)
    start = exploring_starts(s.starts, rng, s.midway, scenario=game.scenario)
    svo_rad = rng.uniform(SVO.low, SVO.high, s.starts) * network.sees_svo
    tried = _try(game, network, start, svo_rad, rng, s)
    returns = game.action_returns(tried.state, tried.svo_rad, policy)
    row = np.arange(len(returns))
    returns[row, tried.action] = np.maximum(returns[row, tried.action], tried.to_go)
    inputs = inputs_of(network, tried.state, tried.svo_rad, game.scenario)
    return _Labelled(inputs.astype(np.float32), returns.astype(np.float32)), tried.mean_return


@dataclass(frozen=True, slots=True)
class _Tried:
    """States of the games that are kept: what was done there, and the return from there on."""

    state: FloatArray
    svo_rad: FloatArray
    action: IntArray
    to_go: FloatArray
    mean_return: float


def _try(
    game: Game,
    network: QNetwork,
    start: FloatArray,
    svo_rad: FloatArray,
    rng: np.random.Generator,
    s: RefineSettings,
) -> _Tried:
    """Play by the policy, from half of the starts with random actions too, and what is found."""
    policy, searched = greedy(network, game.scenario), slice(s.searched)
    found = beam_search(game, start[searched], svo_rad[searched], network, s.beam)
    state = np.concatenate([start, start[::2], start[searched]])
    psi = np.concatenate([svo_rad, svo_rad[::2], svo_rad[searched]])
    index, total = np.arange(len(state)), np.zeros(len(state))
    plan = np.full((len(state), game.max_decisions), -1)
    plan[len(state) - len(found.plans) :] = found.plans
    random = np.zeros(len(state))
    random[len(start) : len(state) - len(found.plans)] = s.exploration
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
    index = np.concatenate([step[0] for step in steps])
    return _Tried(
        state=np.concatenate([step[1] for step in steps]),
        svo_rad=psi[index],
        action=np.concatenate([step[2] for step in steps]),
        to_go=total[index] - np.concatenate([step[3] for step in steps]),
        mean_return=float(total[: len(start)].mean()),
    )


def _fit(
    model: nn.Sequential,
    optimiser: torch.optim.Adam,
    rounds: list[_Labelled],
    rng: np.random.Generator,
    s: RefineSettings,
    number: int,
) -> float:
    """Train on the kept rounds; return the mean cost of a choice over the last updates."""
    inputs = torch.from_numpy(np.concatenate([r.inputs for r in rounds]))
    returns = torch.from_numpy(np.concatenate([r.returns for r in rounds]))
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
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        if update >= s.updates - 100:
            last_costs.append(float(cost.detach()))
    return float(np.mean(last_costs))
