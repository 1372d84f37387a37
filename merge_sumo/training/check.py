"""Regret of the learned drivers: their returns in SUMO compared with the best response."""

from __future__ import annotations

from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path

import numpy as np

from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.drivers.policies import load_network
from merge_sumo.metrics.measures import Measures
from merge_sumo.scenario.case import Case, from_unit
from merge_sumo.scenario.scenario import SVO, Scenario
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.simulation.evaluate import simulate_part
from merge_sumo.training.best_response import beam_search, best_response
from merge_sumo.training.game import Game, greedy, of_two
from merge_sumo.training.reward import Reward, RewardParts, Role

OPPONENTS: dict[str, tuple[Role, str]] = {
    "pov1": ("pov", "level0"),
    "vut1": ("vut", "level0"),
    "pov2": ("pov", "vut1"),
    "vut2": ("vut", "pov1"),
}
"""Role and opponent of each network, in the order of the helix."""


def game_of(name: str, folder: Path, scenario: Scenario, a_min_mps2: float | None) -> Game:
    """Return the game in which a network is trained and checked.

    Args:
        name: name of the network, such as "pov1".
        folder: folder of its opponent.
        scenario: the scenario that is played.
        a_min_mps2: hardest braking of the agent; None for that of the scenario.

    Raises:
        UserError: if the opponent is missing.
    """
    role, opponent = OPPONENTS[name]
    network = None if opponent == "level0" else load_network(opponent, folder)
    return Game(role, network, Reward.of(scenario), a_min_mps2)


@dataclass(frozen=True, slots=True)
class PolicyCheck:
    """A driver compared with its best response, over random cases of the pool.

    Attributes:
        cases: number of cases.
        mean_return: mean return of the driver, played in SUMO.
        mean_best: mean return of the best response.
        mean_level0: mean return of level-0 behaviour in the place of the driver.
        mean_regret: mean of the best return minus the return, divided by the mean gain of the best
            response over level-0 behaviour.
        p99_regret: 99th percentile of the regret, divided by the same gain.
        collisions: number of collisions.
        avoidable_collisions: collisions in cases where the best response has none.
    """

    cases: int
    mean_return: float
    mean_best: float
    mean_level0: float
    mean_regret: float
    p99_regret: float
    collisions: int
    avoidable_collisions: int


def returns_of(trajectories: list[Trajectory], reward: Reward) -> RewardParts:
    """Compute the reward parts of n episodes that were played in SUMO.

    The accelerations that count are the commanded ones; at a stand, those that were possible.

    Args:
        trajectories: motions of the episodes.
        reward: the reward of their scenario.

    Returns:
        The parts, (n,) each.
    """
    parts = np.zeros((3, len(trajectories)))
    for n, trajectory in enumerate(trajectories):
        v_pov, a_pov = trajectory.v_pov_mps[:-1], trajectory.a_pov_mps2[:-1]
        v_vut, a_vut = trajectory.v_vut_mps[:-1], trajectory.a_vut_mps2[:-1]
        parts[1, n] = reward.pov_step(v_pov, a_pov).sum()
        parts[2, n] = reward.vut_step(v_vut, a_vut).sum()
        if trajectory.end is End.MERGED:
            (x_pov, v_pov_end, _), (x_vut, v_vut_end, _) = trajectory.motion[-1]
            dx = np.array([x_pov - x_vut])
            parts[0, n] = reward.safety(dx, np.array([v_pov_end - v_vut_end]))[0]
            parts[2, n] += reward.vut_end(np.array([v_vut_end]))[0]
    return RewardParts(*parts)


def check_policy(
    name: str,
    folder: Path,
    count: int,
    scenario: Scenario,
) -> PolicyCheck:
    """Compare a network with its best response.

    Args:
        name: name of the network, such as "pov1".
        folder: folder of the networks.
        count: number of random cases of the pool.
        scenario: the scenario that is played.

    Raises:
        UserError: if the network or its opponent is missing.
    """
    network = load_network(name, folder)
    game = game_of(name, folder, of_two(scenario), network.a_min_mps2)
    scenario, reward = game.scenario, game.reward
    level = 2 if game.sees_svo else 1
    points = np.random.default_rng(20_201).random((count, len(scenario.dimensions(level))))
    cases = from_unit(points, level, scenario=scenario)
    svo_rad = np.array([case.svo_rad or SVO.low for case in cases])
    trajectories = _play(cases, name, name, folder)
    without = _play(cases, name, "level0", folder)
    reached = returns_of(trajectories, reward).of(game.role, svo_rad)
    level0 = returns_of(without, reward).of(game.role, svo_rad)
    collided = np.array([Measures(one).is_close for one in trajectories])
    start = np.array([np.ravel(case.starts()) for case in cases])
    if game.opponent is None:
        best = best_response(game, start, reached)
    else:
        searched, _ = beam_search(game, start, svo_rad, network)
        rolled_out = game.play(start, svo_rad, game.improved(greedy(network, scenario)))
        # The games of the driver are some that a search may find.
        best = np.maximum(np.maximum(searched, rolled_out), reached)
    gain = float((best - level0).mean())
    regret = (best - reached) / gain
    return PolicyCheck(
        cases=count,
        mean_return=float(reached.mean()),
        mean_best=float(best.mean()),
        mean_level0=float(level0.mean()),
        mean_regret=float(regret.mean()),
        p99_regret=float(np.quantile(regret, 0.99)),
        collisions=int(collided.sum()),
        avoidable_collisions=int((collided & (best > -reward.weights.crash / 2)).sum()),
    )


def _play(cases: list[Case], name: str, agent: str, folder: Path) -> list[Trajectory]:
    """Run the cases of a network in SUMO, with an agent against its opponent.

    Args:
        cases: the cases.
        name: name of the network.
        agent: the driver in its place: the network itself, or "level0".
        folder: folder of the networks.
    """
    role, opponent = OPPONENTS[name]
    pov, vut = (agent, opponent) if role == "pov" else (opponent, agent)
    scenario, level = cases[0].scenario, int(pov[-1])
    settings = CampaignSettings(
        vut=f"level{vut[-1]}", levels=(level,), scenario=scenario, policies=str(folder)
    )
    played = []
    for case in cases:
        svo_rad = case.svo_rad if level == 2 else None
        played.append(replace(case, level=level, svo_rad=svo_rad))
    return simulate_part(settings.load_plan(), played, attrgetter("trajectory"))
