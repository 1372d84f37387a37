"""Regret of the learned drivers: their returns in SUMO compared with the best response."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from merge_sumo.drivers.base import Driver
from merge_sumo.drivers.level0 import Level0Pov, Level0Vut
from merge_sumo.drivers.levelk import LevelKDriver, QNetwork
from merge_sumo.drivers.policies import load_network
from merge_sumo.metrics.paper import is_close
from merge_sumo.road.merge import road_for
from merge_sumo.scenario.case import Case, FloatArray, from_unit
from merge_sumo.scenario.scenario import SVO, Scenario
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.simulation.rollout import Rollout
from merge_sumo.sumo.world import World
from merge_sumo.training.best_response import beam_search, best_response
from merge_sumo.training.game import Game, greedy, of_two
from merge_sumo.training.reward import Reward, RewardParts, Role

CHECK_CASES = 300
CORRIDORS = 32


@dataclass(frozen=True, slots=True)
class PolicyCheck:
    """A driver compared with its best response, over random cases of the pool.

    Attributes:
        mean_return: mean return of the driver, played in SUMO.
        mean_level0: mean return of level-0 behaviour in the driver's place.
        mean_regret: mean of best - return, as a share of the mean gain of the best response over
            level-0 behaviour.
        p99_regret: 99th percentile of the same.
        avoidable_collisions: those in cases where the best response has none.
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
    """Return the reward parts of episodes that were played in SUMO.

    The accelerations that count are the commanded ones; at a stand, those that were possible.
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


def play(
    cases: list[Case], make_pov: type[Driver] | QNetwork, make_vut: type[Driver] | QNetwork
) -> list[Trajectory]:
    """Play cases of one scenario in SUMO between two drivers.

    Args:
        cases: cases of one scenario.
        make_pov: class of the POV's driver, or the network by which it acts.
        make_vut: the same of the VUT.

    Returns:
        The trajectories, in the order of the cases.
    """
    scenario = cases[0].scenario
    pov, vut = (
        LevelKDriver(CORRIDORS, make) if isinstance(make, QNetwork) else make(CORRIDORS)
        for make in (make_pov, make_vut)
    )
    with World(CORRIDORS, road_for(scenario), scenario=scenario) as world:
        return Rollout(world, pov, vut, cases).run()


def check_policy(
    name: str,
    folder: Path | None = None,
    count: int = CHECK_CASES,
    *,
    scenario: Scenario,
) -> PolicyCheck:
    """Compare a network of a folder with its best response.

    Args:
        name: name of the network, such as "pov1".
        folder: the folder; by default the shipped policies.
        count: number of random cases of the pool.
        scenario: the scenario that is played.
    """
    opponent = {"pov2": "vut1", "vut2": "pov1"}.get(name)
    known = None if opponent is None else load_network(opponent, folder)
    return check_network(name, load_network(name, folder), known, Reward.of(scenario), count)


def check_network(
    name: str, network: QNetwork, opponent: QNetwork | None, reward: Reward, count: int
) -> PolicyCheck:
    """Compare a network with its best response.

    Args:
        name: name of the network, such as "pov1".
        network: the network.
        opponent: network of its opponent; None for level 0.
        reward: the reward of the game.
        count: number of random cases of the pool.
    """
    level, scenario = 2 if name == "pov2" else 1, of_two(reward.scenario)
    points = np.random.default_rng(20_201).random((count, len(scenario.dimensions(level))))
    cases = from_unit(points, level, scenario=scenario)
    svo_rad = np.array([case.svo_rad or SVO.low for case in cases])
    role: Role = "pov" if name.startswith("pov") else "vut"
    is_pov = role == "pov"
    level0 = Level0Pov if is_pov else Level0Vut
    other = opponent or (Level0Vut if is_pov else Level0Pov)

    def played(driver: type[Driver] | QNetwork) -> tuple[FloatArray, list[Trajectory]]:
        trajectories = play(cases, *((driver, other) if is_pov else (other, driver)))
        return returns_of(trajectories, reward).of(role, svo_rad), trajectories

    reached, trajectories = played(network)
    collided = np.array([is_close(one) for one in trajectories])
    unmoved, _ = played(level0)
    game = Game(role, opponent, reward, network.a_min_mps2)
    start = np.array([[x for at in case.starts() for x in at] for case in cases])
    if opponent is None:
        best = best_response(game, start)
    else:
        # The driver's own games are some that a search may find.
        searched, _ = beam_search(game, start, svo_rad, network)
        rolled_out = game.play(start, svo_rad, game.improved(greedy(network, game.scenario)))
        best = np.maximum(np.maximum(searched, rolled_out), reached)
    gain = float((best - unmoved).mean())
    regret = (best - reached) / gain
    return PolicyCheck(
        cases=count,
        mean_return=float(reached.mean()),
        mean_best=float(best.mean()),
        mean_level0=float(unmoved.mean()),
        mean_regret=float(regret.mean()),
        p99_regret=float(np.quantile(regret, 0.99)),
        collisions=int(collided.sum()),
        avoidable_collisions=int((collided & (best > -reward.weights.crash / 2)).sum()),
    )
