"""Double deep Q-learning (van Hasselt et al., 2016) of one level-k driver; read top to bottom.

Differences from the textbook:

- Targets are squashed by an increasing function, the identity above -2 and logarithmic below. The
  game is deterministic, so that does not change which action is best, and the crash term no longer
  drowns the rest.
- The target network follows by Polyak averaging, and that average is the result.
- Exploring starts (`game.exploring_starts`).
- psi is drawn again for every replayed transition: the reward is stored in its three parts.
- No discount, because every game ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from itertools import chain

import numpy as np
import torch
from torch import Tensor, nn

from merge_sumo.drivers.levelk import (
    ACTIONS,
    FEATURES,
    SVO_FEATURES,
    QNetwork,
    features,
    svo_features,
)
from merge_sumo.scenario.scenario import SVO
from merge_sumo.training.game import Game, IntArray, exploring_starts
from merge_sumo.training.reward import RewardParts

SQUASH_BELOW = -2.0
POLYAK = 0.005
"""Share of the weights that their average takes over per update."""
GAMES = 64
"""Games that are played at once."""


@dataclass(frozen=True, kw_only=True, slots=True)
class DdqnSettings:
    """Settings of `train`.

    Attributes:
        transitions: size of the replay buffer, which keeps every transition.
        updates: number of gradient steps.
        collecting: share of the updates during which transitions are collected.
        warm_up: transitions before the first update.
        batch: transitions per update.
        width: units of each of the two hidden layers.
        learning_rate: learning rate at the start; it falls to `last_learning_rate` along a cosine.
        last_learning_rate: learning rate at the end.
        exploration: share of random actions at the start. It falls linearly to `last_exploration`,
            which it reaches with half of the transitions.
        last_exploration: share of random actions from then on.
        gradient_norm: bound to which the gradient is clipped.
        midway: share of games that begin mid-way (`game.exploring_starts`).
    """

    transitions: int = 150_000
    updates: int = 12_000
    collecting: float = 0.6
    warm_up: int = 10_000
    batch: int = 512
    width: int = 128
    learning_rate: float = 1e-3
    last_learning_rate: float = 1e-5
    exploration: float = 1.0
    last_exploration: float = 0.1
    gradient_norm: float = 10.0
    midway: float = 0.6


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainingProgress:
    """The progress of training, after every thousand updates of DDQN or a round of refinement.

    Attributes:
        network: name of the network.
        stage: "ddqn" or "refine".
        done: updates or rounds that are done in this stage.
        total: updates or rounds of this stage.
        loss: loss of the last update of DDQN, or the mean cost of a choice in refinement.
        mean_return: mean return of recent games from exploring starts.
    """

    network: str = ""
    stage: str = "ddqn"
    done: int
    total: int
    loss: float
    mean_return: float


def squash(q: Tensor) -> Tensor:
    """Squash action values, of any shape: the identity above -2, and logarithmic below.

    Args:
        q: action values.

    Returns:
        The squashed values, in the same order.
    """
    depth = torch.clamp(SQUASH_BELOW - q, min=0.0)
    return torch.where(q >= SQUASH_BELOW, q, SQUASH_BELOW - torch.log1p(depth))


def unsquash(squashed: Tensor) -> Tensor:
    """Invert `squash`, with a bound so that an early estimate cannot overflow.

    Args:
        squashed: squashed values, of any shape.

    Returns:
        The action values.
    """
    depth = torch.clamp(SQUASH_BELOW - squashed, min=0.0, max=4.0)
    return torch.where(squashed >= SQUASH_BELOW, squashed, SQUASH_BELOW - torch.expm1(depth))


class Learner:
    """A network that Adam trains, and the Polyak average of its weights.

    Example:
        learner = Learner(make_network(FEATURES, 128))
        learner.descend(loss, learning_rate=1e-3, gradient_norm=10.0)

    Attributes:
        network: the network that learns.
        average: network with the average of the weights: the target of DDQN, and the result.
    """

    def __init__(self, network: nn.Sequential) -> None:
        """Begin with an average that equals the network.

        Args:
            network: the network; its weights change.
        """
        self.network, self.average = network, deepcopy(network)
        self._weights: list[Tensor] = list(network.parameters())
        self._averages: list[Tensor] = list(self.average.parameters())
        self._optimiser = torch.optim.Adam(self._weights, fused=True)

    def descend(self, loss: Tensor, learning_rate: float, gradient_norm: float) -> None:
        """Take one gradient step.

        Args:
            loss: the loss.
            learning_rate: learning rate of this step.
            gradient_norm: bound to which the gradient is clipped.
        """
        self._optimiser.param_groups[0]["lr"] = learning_rate
        self._optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self._weights, gradient_norm)
        self._optimiser.step()
        with torch.no_grad():
            torch._foreach_lerp_(self._averages, self._weights, POLYAK)


TRANSITION = np.dtype(
    [
        ("action", np.int64),
        ("before", np.float32, FEATURES),
        ("after", np.float32, FEATURES),
        ("parts", np.float32, 3),
        ("continues", np.float32),
    ]
)
"""Features before and after a decision, its action, the parts of the reward, and whether the game
continues."""


class _Games:
    """Games that are played at once, and the transitions of all games so far."""

    def __init__(self, game: Game, rng: np.random.Generator, settings: DdqnSettings) -> None:
        self.game, self.rng, self.midway = game, rng, settings.midway
        self.transitions = np.zeros(settings.transitions, TRANSITION)
        self.filled = 0
        self.state = np.zeros((GAMES, 4))
        self.decisions = np.zeros(GAMES, dtype=np.int64)
        self.svo_rad, self.returns = np.zeros((2, GAMES))
        self.ended: list[float] = []
        self._begin(np.arange(GAMES))

    def _begin(self, which: IntArray) -> None:
        n, scenario = len(which), self.game.scenario
        self.state[which] = exploring_starts(n, self.rng, self.midway, scenario=scenario)
        self.svo_rad[which] = self.rng.uniform(SVO.low, SVO.high, n) * self.game.sees_svo
        self.decisions[which] = 0
        self.returns[which] = 0.0

    def play(self, online: nn.Sequential, epsilon: float) -> None:
        """Take one decision in every game, a random one with probability epsilon."""
        psi = self.svo_rad if self.game.sees_svo else None
        before = features(self.state.T, psi, scenario=self.game.of_agent)
        with torch.no_grad():
            action = online(torch.from_numpy(before.astype(np.float32))).argmax(-1).numpy()
        random = self.rng.integers(0, ACTIONS, GAMES)
        action = np.where(self.rng.random(GAMES) < epsilon, random, action)
        a_mps2 = self.game.actions_mps2[action]
        self.state, parts, over = self.game.decide(self.state, self.svo_rad, a_mps2)
        after = features(self.state.T, scenario=self.game.of_agent)
        rows = self.transitions[self.filled : self.filled + GAMES]
        n = len(rows)
        rows["action"], rows["continues"] = action[:n], ~over[:n]
        rows["before"], rows["after"] = before[:n, :FEATURES], after[:n]
        rows["parts"] = np.stack([parts.safe, parts.pov_ego, parts.vut_ego], axis=1)[:n]
        self.filled += n
        self.returns += parts.of(self.game.role, self.svo_rad)
        self.decisions += 1
        again = np.flatnonzero(over | (self.decisions >= self.game.max_decisions))
        if again.size:
            self.ended += self.returns[again].tolist()
            self._begin(again)

    def loss(self, learner: Learner, batch: int) -> Tensor:
        """Return the loss of the learning network on `batch` transitions, drawn at random.

        The average network is the target network.
        """
        rows = self.transitions[self.rng.integers(0, self.filled, batch)]
        before, after = rows["before"], rows["after"]
        svo_rad: np.ndarray = np.zeros(batch, dtype=np.float32)
        if self.game.sees_svo:
            svo_rad = self.rng.uniform(SVO.low, SVO.high, batch).astype(np.float32)
            columns = svo_features(svo_rad)
            before, after = np.column_stack([before, *columns]), np.column_stack([after, *columns])
        reward = RewardParts(*rows["parts"].T).of(self.game.role, svo_rad)
        inputs = torch.from_numpy(np.ascontiguousarray(after))
        with torch.no_grad():
            # Double: the learning network picks the action, the target network rates it.
            picked = learner.network(inputs).argmax(-1, keepdim=True)
            rated = unsquash(learner.average(inputs).gather(1, picked)[:, 0])
            goal = squash(torch.from_numpy(reward) + torch.from_numpy(rows["continues"]) * rated)
        action = torch.from_numpy(rows["action"])[:, None]
        q = learner.network(torch.from_numpy(np.ascontiguousarray(before))).gather(1, action)[:, 0]
        return nn.functional.smooth_l1_loss(q, goal)


def train(
    game: Game,
    seed: int,
    settings: DdqnSettings,
    on_progress: Callable[[TrainingProgress], None],
) -> QNetwork:
    """Train the agent of a game; same seed, same weights.

    Args:
        game: the game.
        seed: seed of the weights and of the games.
        settings: settings; their defaults are those of the shipped policies.
        on_progress: called after every thousand updates.

    Returns:
        The network of the agent.
    """
    s = settings
    # One thread: the result must not depend on the number of cores.
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    learner = Learner(make_network(FEATURES + SVO_FEATURES * game.sees_svo, s.width))
    games = _Games(game, np.random.default_rng(seed), s)
    update = 0
    while update < s.updates:
        is_full = games.filled == s.transitions
        if not is_full:
            explored = min(2.0 * games.filled / s.transitions, 1.0)
            epsilon = s.exploration + explored * (s.last_exploration - s.exploration)
            games.play(learner.network, epsilon)
        share = (games.filled - s.warm_up) / (s.transitions - s.warm_up)
        due = s.updates if is_full else int(s.updates * s.collecting * share)
        while update < due:
            cosine = 0.5 * (1.0 + math.cos(math.pi * update / s.updates))
            rate = s.last_learning_rate + (s.learning_rate - s.last_learning_rate) * cosine
            loss = games.loss(learner, s.batch)
            learner.descend(loss, rate * min(1.0, (update + 1) / 500), s.gradient_norm)
            update += 1
            if update % 1000 == 0:
                progress = TrainingProgress(
                    done=update,
                    total=s.updates,
                    loss=float(loss.detach()),
                    mean_return=float(np.mean(games.ended[-2000:])),
                )
                on_progress(progress)
    return export(learner.average, game.a_min_mps2)


def make_network(inputs: int, width: int) -> nn.Sequential:
    """Return a network with two hidden layers and random weights.

    Args:
        inputs: number of inputs.
        width: units of each hidden layer.
    """
    return nn.Sequential(
        nn.Linear(inputs, width),
        nn.ReLU(),
        nn.Linear(width, width),
        nn.ReLU(),
        nn.Linear(width, ACTIONS),
    )


def export(network: nn.Sequential, a_min_mps2: float | None = None) -> QNetwork:
    """Return a torch network as one that acts in numpy.

    Args:
        network: the network, of linear layers with rectified units between them.
        a_min_mps2: hardest braking of its driver; None for that of the scenario.
    """
    arrays = [parameter.detach().numpy().copy() for parameter in network.parameters()]
    return QNetwork(list(zip(arrays[::2], arrays[1::2], strict=True)), a_min_mps2)


def as_torch(network: QNetwork) -> nn.Sequential:
    """Return a network as one that torch trains, in float32; the inverse of `export`.

    Args:
        network: a network with two hidden layers.
    """
    width, inputs = network.layers[0][0].shape
    model = make_network(inputs, width)
    with torch.no_grad():
        for parameter, values in zip(model.parameters(), chain(*network.layers), strict=True):
            parameter.copy_(torch.from_numpy(values))
    return model
