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
from dataclasses import dataclass
from itertools import chain

import numpy as np
import torch
from torch import Tensor, nn

from merge_sumo.drivers.levelk import ACTIONS, FEATURES, SVO_FEATURES, QNetwork, features
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
    """Settings of `train`."""

    transitions: int = 150_000  # size of the replay; every transition is kept
    updates: int = 12_000  # gradient steps; the transitions are all in after `collecting` of them
    collecting: float = 0.6  # share of the updates during which transitions are collected
    warm_up: int = 10_000  # transitions before the first update
    batch: int = 512  # transitions per update
    width: int = 128  # units of each of the two hidden layers
    learning_rate: float = 1e-3  # at the start; falls to `last_learning_rate` along a cosine
    last_learning_rate: float = 1e-5  # at the end
    exploration: float = 1.0
    """Share of random actions at the start; falls linearly to `last_exploration` when half of
    the transitions are in."""
    last_exploration: float = 0.1  # share of random actions from then on
    gradient_norm: float = 10.0  # bound to which the gradient is clipped
    midway: float = 0.6  # share of games that begin mid-way


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainingProgress:
    """The progress of training, after every thousand updates of DDQN or a round of refinement."""

    network: str = ""  # its name
    stage: str = "ddqn"  # or "refine"
    done: int  # updates or rounds done in this stage
    total: int  # updates or rounds of this stage
    loss: float  # of DDQN's fit, or the mean loss of return that a choice of the network means
    mean_return: float  # of the games played lately, from exploring starts


def squash(q: Tensor) -> Tensor:
    """Return q above -2 and a logarithm of it below."""
    return torch.where(
        q >= SQUASH_BELOW,
        q,
        SQUASH_BELOW - torch.log1p(torch.clamp(SQUASH_BELOW - q, min=0.0)),
    )


def unsquash(squashed: Tensor) -> Tensor:
    """Return the inverse of `squash`, bounded so that an early estimate cannot overflow."""
    depth = torch.clamp(SQUASH_BELOW - squashed, min=0.0, max=4.0)
    return torch.where(squashed >= SQUASH_BELOW, squashed, SQUASH_BELOW - torch.expm1(depth))


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

    def __init__(
        self, game: Game, rng: np.random.Generator, settings: DdqnSettings, *, sees_svo: bool
    ) -> None:
        self.game, self.rng, self.midway, self.sees_svo = game, rng, settings.midway, sees_svo
        self.transitions = np.zeros(settings.transitions, TRANSITION)
        self.filled = 0
        self.state = np.zeros((GAMES, 4))
        self.decisions = np.zeros(GAMES, dtype=np.int64)
        self.svo_rad, self.returns = np.zeros((2, GAMES))
        self.ended: list[float] = []
        self._begin(np.arange(GAMES))

    @property
    def full(self) -> bool:
        return self.filled == len(self.transitions)

    def _begin(self, which: IntArray) -> None:
        n, scenario = len(which), self.game.scenario
        self.state[which] = exploring_starts(n, self.rng, self.midway, scenario=scenario)
        self.svo_rad[which] = self.rng.uniform(SVO.low, SVO.high, n) * self.sees_svo
        self.decisions[which] = 0
        self.returns[which] = 0.0

    def play(self, online: nn.Sequential, epsilon: float) -> None:
        """Take one decision in every game, a random one with probability epsilon."""
        psi = self.svo_rad if self.sees_svo else None
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

    def loss(self, online: nn.Sequential, target: nn.Sequential, batch: int) -> Tensor:
        """Return the loss of the online network on some transitions.

        Args:
            online: the network that learns.
            target: the network that rates the best next action.
            batch: number of transitions.
        """
        rows = self.transitions[self.rng.integers(0, self.filled, batch)]
        before, after = rows["before"], rows["after"]
        svo_rad: np.ndarray = np.zeros(batch, dtype=np.float32)
        if self.sees_svo:
            svo_rad = self.rng.uniform(SVO.low, SVO.high, batch).astype(np.float32)
            columns = np.cos(svo_rad) * 2.0 - 1.0, np.sin(svo_rad) * 2.0 - 1.0
            before, after = np.column_stack([before, *columns]), np.column_stack([after, *columns])
        reward = RewardParts(*rows["parts"].T).of(self.game.role, svo_rad)
        inputs = torch.from_numpy(np.ascontiguousarray(after))
        with torch.no_grad():
            # Double: the online network picks the action, the target network rates it.
            picked = online(inputs).argmax(-1, keepdim=True)
            rated = unsquash(target(inputs).gather(1, picked)[:, 0])
            goal = squash(torch.from_numpy(reward) + torch.from_numpy(rows["continues"]) * rated)
        action = torch.from_numpy(rows["action"])[:, None]
        q = online(torch.from_numpy(np.ascontiguousarray(before))).gather(1, action)[:, 0]
        return nn.functional.smooth_l1_loss(q, goal)


def train(
    game: Game,
    seed: int,
    settings: DdqnSettings | None = None,
    *,
    sees_svo: bool = False,
    on_progress: Callable[[TrainingProgress], None] = lambda _: None,
) -> QNetwork:
    """Train the agent of a game and return its network; same seed, same weights.

    Args:
        game: the game.
        seed: seed of the weights and of the games.
        settings: by default those of the shipped policies.
        sees_svo: whether the network sees psi of the POV.
        on_progress: called after every thousand updates.
    """
    s = settings or DdqnSettings()
    # One thread: the result must not depend on the number of cores.
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    inputs = FEATURES + SVO_FEATURES * sees_svo
    online, target = make_network(inputs, s.width), make_network(inputs, s.width)
    target.load_state_dict(online.state_dict())
    optimiser = torch.optim.Adam(online.parameters(), lr=s.learning_rate, fused=True)
    games = _Games(game, np.random.default_rng(seed), s, sees_svo=sees_svo)
    update = 0
    while update < s.updates:
        if not games.full:
            explored = min(2.0 * games.filled / s.transitions, 1.0)
            games.play(online, s.exploration + explored * (s.last_exploration - s.exploration))
        share = (games.filled - s.warm_up) / (s.transitions - s.warm_up)
        due = s.updates if games.full else int(s.updates * s.collecting * share)
        while update < due:
            cosine = 0.5 * (1.0 + math.cos(math.pi * update / s.updates))
            rate = s.last_learning_rate + (s.learning_rate - s.last_learning_rate) * cosine
            for group in optimiser.param_groups:
                group["lr"] = rate * min(1.0, (update + 1) / 500)
            loss = games.loss(online, target, s.batch)
            descend(optimiser, loss, online, target, s.gradient_norm)
            update += 1
            if update % 1000 == 0:
                progress = TrainingProgress(
                    done=update,
                    total=s.updates,
                    loss=float(loss.detach()),
                    mean_return=float(np.mean(games.ended[-2000:])),
                )
                on_progress(progress)
    return export(target, game.a_min_mps2)


def descend(
    optimiser: torch.optim.Adam,
    loss: Tensor,
    network: nn.Sequential,
    average: nn.Sequential,
    gradient_norm: float,
) -> None:
    """Take one gradient step.

    Args:
        optimiser: optimiser of the weights of the network.
        loss: the loss.
        network: the network.
        average: network with the average of the weights.
        gradient_norm: bound to which the gradient is clipped.
    """
    weights: list[Tensor] = list(network.parameters())
    averages: list[Tensor] = list(average.parameters())
    optimiser.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    nn.utils.clip_grad_norm_(weights, gradient_norm)
    optimiser.step()
    with torch.no_grad():
        torch._foreach_lerp_(averages, weights, POLYAK)


def make_network(inputs: int, width: int) -> nn.Sequential:
    """Return a network with two hidden layers and random weights."""
    return nn.Sequential(
        nn.Linear(inputs, width),
        nn.ReLU(),
        nn.Linear(width, width),
        nn.ReLU(),
        nn.Linear(width, ACTIONS),
    )


def export(network: nn.Sequential, a_min_mps2: float | None = None) -> QNetwork:
    """Return a torch network as one that acts in numpy, with its limit of braking."""
    arrays = [parameter.detach().numpy().copy() for parameter in network.parameters()]
    return QNetwork(list(zip(arrays[::2], arrays[1::2], strict=True)), a_min_mps2)


def as_torch(network: QNetwork) -> nn.Sequential:
    """Return a network as one that torch trains, in float32; the inverse of `export`."""
    width, inputs = network.layers[0][0].shape
    model = make_network(inputs, width)
    with torch.no_grad():
        for parameter, values in zip(model.parameters(), chain(*network.layers), strict=True):
            parameter.copy_(torch.from_numpy(values))
    return model
