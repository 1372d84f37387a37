"""Double deep Q-learning (van Hasselt et al., 2016) of one level-k driver; read top to bottom.

What differs from the textbook, and why:

- Targets are squashed by an increasing function, the identity above -2 and logarithmic below. The
  game is deterministic, so that does not change which action is best, and the crash term no longer
  drowns the rest.
- The target network follows by Polyak averaging, and that average is what is kept.
- Exploring starts (`game.exploring_starts`).
- psi is drawn again for every replayed transition: the reward is stored in its three parts.
- No discount: every game ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from merge_sumo.drivers.levelk import ACTIONS, FEATURES, SVO_FEATURES, QNetwork, features
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import SVO
from merge_sumo.training.game import Game, exploring_starts
from merge_sumo.training.reward import RewardParts, Role

SQUASH_BELOW = -2.0
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
    polyak: float = 0.005  # share of the network that the target network takes over per update
    exploration: float = 1.0
    """Share of random actions at the start; falls linearly to `last_exploration` when half of
    the transitions are in."""
    last_exploration: float = 0.1  # share of random actions from then on
    gradient_norm: float = 10.0  # bound to which the gradient is clipped
    midway: float = 0.6
    """Share of games that begin mid-way at the start; falls linearly to `last_midway` when half
    of the transitions are in. Coverage first, then precision where a pool case leads."""
    last_midway: float = 0.6  # share of games that begin mid-way from then on


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainingProgress:
    """The progress of training, after every thousand updates of DDQN or a round of refinement."""

    network: str = ""  # its name
    stage: str = "ddqn"  # or "refine"
    done: int  # updates or rounds done in this stage
    total: int  # updates or rounds of this stage
    loss: float  # of DDQN's fit, or the mean loss of return that a choice of the network means
    mean_return: float  # of the games played lately, from exploring starts
    crash_share: float | None = None  # share of collisions among them; None while refining

    @property
    def note(self) -> str:
        """The measurements, for a bar."""
        crashes = "" if self.crash_share is None else f"  crashes {self.crash_share:.2%}"
        return f"return {self.mean_return:.3f}{crashes}"


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


class ReplayBuffer:
    """All transitions so far: features before and after, action, reward in parts, end."""

    def __init__(self, size: int) -> None:
        """Make room for `size` transitions."""
        self.before = np.zeros((size, FEATURES), dtype=np.float32)
        self.after = np.zeros((size, FEATURES), dtype=np.float32)
        self.parts = np.zeros((size, 3), dtype=np.float32)
        self.action = np.zeros(size, dtype=np.int64)
        self.goes_on = np.zeros(size, dtype=np.float32)
        self.filled = 0

    @property
    def full(self) -> bool:
        """Whether there is no room left."""
        return self.filled == len(self.action)

    def add(
        self,
        before: FloatArray,
        action: np.ndarray,
        parts: FloatArray,
        after: FloatArray,
        goes_on: np.ndarray,
    ) -> None:
        """Add a transition per game, as far as there is room.

        Args:
            before: features before the decision, (n, 26).
            action: actions, (n,).
            parts: rewards in their three parts, (n, 3).
            after: features after the decision, (n, 26).
            goes_on: whether the game continues, (n,).
        """
        rows = slice(self.filled, min(self.filled + len(action), len(self.action)))
        n = rows.stop - rows.start
        self.before[rows], self.after[rows] = before[:n], after[:n]
        self.parts[rows], self.action[rows] = parts[:n], action[:n]
        self.goes_on[rows] = goes_on[:n]
        self.filled = rows.stop


def train(
    game: Game,
    seed: int,
    settings: DdqnSettings | None = None,
    *,
    sees_svo: bool = False,
    on_progress: Callable[[TrainingProgress], None] | None = None,
) -> QNetwork:
    """Train the agent of a game and return its network; same seed, same weights.

    Args:
        game: the game.
        seed: of the weights and of the games.
        settings: by default those of the shipped policies.
        sees_svo: whether the network sees psi of the POV.
        on_progress: called after every thousand updates.
    """
    s = settings or DdqnSettings()
    # One thread: the result must not depend on the number of cores.
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    inputs = FEATURES + SVO_FEATURES * sees_svo
    online, target = make_network(inputs, s.width), make_network(inputs, s.width)
    target.load_state_dict(online.state_dict())
    optimiser = torch.optim.Adam(online.parameters(), lr=s.learning_rate, fused=True)
    replay = ReplayBuffer(s.transitions)
    collector = _Collector(game, rng, s.midway, sees_svo=sees_svo)
    loss = torch.zeros(())
    update = 0
    while update < s.updates:
        if not replay.full:
            explored = min(2.0 * replay.filled / s.transitions, 1.0)
            epsilon = s.exploration + explored * (s.last_exploration - s.exploration)
            collector.midway = s.midway + explored * (s.last_midway - s.midway)
            collector.collect(online, epsilon, replay)
        share = (replay.filled - s.warm_up) / (s.transitions - s.warm_up)
        due = s.updates if replay.full else int(s.updates * s.collecting * share)
        while update < due:
            cosine = 0.5 * (1.0 + math.cos(math.pi * update / s.updates))
            rate = s.last_learning_rate + (s.learning_rate - s.last_learning_rate) * cosine
            for group in optimiser.param_groups:
                group["lr"] = rate * min(1.0, (update + 1) / 500)
            loss = _loss(online, target, replay, s.batch, rng, game.role, sees_svo=sees_svo)
            descend(optimiser, loss, online, target, s.gradient_norm, s.polyak)
            update += 1
            if on_progress and update % 1000 == 0:
                mean_return, crash_share = collector.recent()
                on_progress(
                    TrainingProgress(
                        done=update,
                        total=s.updates,
                        loss=float(loss.detach()),
                        mean_return=mean_return,
                        crash_share=crash_share,
                    )
                )
    return export(target, game.a_min_mps2)


def descend(
    optimiser: torch.optim.Adam,
    loss: Tensor,
    network: nn.Sequential,
    average: nn.Sequential,
    gradient_norm: float,
    polyak: float,
) -> None:
    """Take one gradient step.

    Args:
        optimiser: of the weights of the network.
        loss: what is to fall.
        network: the network.
        average: the network whose weights follow.
        gradient_norm: the bound to which the gradient is clipped.
        polyak: the share of the weights that the average takes over.
    """
    weights: list[Tensor] = list(network.parameters())
    averages: list[Tensor] = list(average.parameters())
    optimiser.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    nn.utils.clip_grad_norm_(weights, gradient_norm)
    optimiser.step()
    with torch.no_grad():
        torch._foreach_lerp_(averages, weights, polyak)


class _Collector:
    """Plays games and writes what happened into the replay."""

    def __init__(
        self, game: Game, rng: np.random.Generator, midway: float, *, sees_svo: bool
    ) -> None:
        self.game, self.rng, self.midway, self.sees_svo = game, rng, midway, sees_svo
        self.state = np.zeros((GAMES, 4))
        self.decisions = np.zeros(GAMES, dtype=np.int64)
        self.svo_rad, self.returns = np.zeros((2, GAMES))
        self.ended: list[tuple[float, bool]] = []
        self._begin(np.arange(GAMES))

    def _begin(self, which: np.ndarray) -> None:
        n, scenario = len(which), self.game.scenario
        self.state[which] = exploring_starts(n, self.rng, self.midway, scenario=scenario)
        self.svo_rad[which] = self.rng.uniform(SVO.low, SVO.high, n) * self.sees_svo
        self.decisions[which] = 0
        self.returns[which] = 0.0

    def collect(self, online: nn.Sequential, epsilon: float, replay: ReplayBuffer) -> None:
        """Take one decision in every game, a random one with probability epsilon.

        Args:
            online: network that decides.
            epsilon: probability of a random action.
            replay: buffer that takes the transitions.
        """
        before = features(*self.state.T, scenario=self.game.of_agent)
        seen = before
        if self.sees_svo:
            seen = np.column_stack([before, *_svo_columns(self.svo_rad)])
        with torch.no_grad():
            action = online(torch.from_numpy(seen.astype(np.float32))).argmax(-1).numpy()
        random = self.rng.integers(0, ACTIONS, GAMES)
        action = np.where(self.rng.random(GAMES) < epsilon, random, action)
        a_mps2 = self.game.actions_mps2[action]
        self.state, parts, over = self.game.decide(self.state, self.svo_rad, a_mps2)
        in_parts = np.stack([parts.safe, parts.pov_ego, parts.vut_ego], axis=1)
        after = features(*self.state.T, scenario=self.game.of_agent)
        replay.add(before, action, in_parts, after, ~over)
        self.returns += parts.of(self.game.role, self.svo_rad)
        self.decisions += 1
        again = np.flatnonzero(over | (self.decisions >= self.game.max_decisions))
        if again.size:
            crash = self.game.reward.weights.crash
            self.ended += zip(
                self.returns[again].tolist(), (parts.safe[again] < -crash / 2).tolist(), strict=True
            )
            self._begin(again)

    def recent(self) -> tuple[float, float]:
        """Return mean return and share of crashes of the games that ended last."""
        last = self.ended = self.ended[-2000:]
        mean_return, crash_share = np.mean(last, axis=0).tolist() if last else (math.nan, math.nan)
        return mean_return, crash_share


def _loss(
    online: nn.Sequential,
    target: nn.Sequential,
    replay: ReplayBuffer,
    batch: int,
    rng: np.random.Generator,
    role: Role,
    *,
    sees_svo: bool,
) -> Tensor:
    rows = rng.integers(0, replay.filled, batch)
    before, after = replay.before[rows], replay.after[rows]
    svo_rad: np.ndarray = np.zeros(batch, dtype=np.float32)
    if sees_svo:
        svo_rad = rng.uniform(SVO.low, SVO.high, batch).astype(np.float32)
        columns = _svo_columns(svo_rad)
        before, after = np.column_stack([before, *columns]), np.column_stack([after, *columns])
    reward = RewardParts(*replay.parts[rows].T).of(role, svo_rad)
    with torch.no_grad():
        # Double: the online network picks the action, the target network rates it.
        picked = online(torch.from_numpy(after)).argmax(-1, keepdim=True)
        rated = unsquash(target(torch.from_numpy(after)).gather(1, picked)[:, 0])
        goal = squash(torch.from_numpy(reward) + torch.from_numpy(replay.goes_on[rows]) * rated)
    action = torch.from_numpy(replay.action[rows])[:, None]
    q = online(torch.from_numpy(before)).gather(1, action)[:, 0]
    return nn.functional.smooth_l1_loss(q, goal)


def _svo_columns(svo_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.cos(svo_rad) * 2.0 - 1.0, np.sin(svo_rad) * 2.0 - 1.0


def make_network(inputs: int, width: int) -> nn.Sequential:
    """Return a network with two hidden layers, at random."""
    return nn.Sequential(
        nn.Linear(inputs, width),
        nn.ReLU(),
        nn.Linear(width, width),
        nn.ReLU(),
        nn.Linear(width, ACTIONS),
    )


def export(network: nn.Sequential, a_min_mps2: float | None = None) -> QNetwork:
    """Return a torch network as one that acts in numpy, with its limit of braking."""
    layers = [
        (layer.weight.detach().numpy().copy(), layer.bias.detach().numpy().copy())
        for layer in network
        if isinstance(layer, nn.Linear)
    ]
    return QNetwork(layers, a_min_mps2)


def as_torch(network: QNetwork) -> nn.Sequential:
    """Return a network as one that torch trains, in float32; the inverse of `export`."""
    width, inputs = network.layers[0][0].shape
    model = make_network(inputs, width)
    linear = [layer for layer in model if isinstance(layer, nn.Linear)]
    with torch.no_grad():
        for layer, (weight, bias) in zip(linear, network.layers, strict=True):
            layer.weight.copy_(torch.from_numpy(weight))
            layer.bias.copy_(torch.from_numpy(bias))
    return model
