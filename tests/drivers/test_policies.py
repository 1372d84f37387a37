"""The shipped drivers: deterministic and nearly rational."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from support.merges import HALF, SMALLER
from support.vut_contract import factory, run_cases, same

from merge_sumo.drivers.levelk import (
    FEATURES,
    LevelKDriver,
    QNetwork,
    actions_mps2,
    features,
)
from merge_sumo.drivers.policies import (
    NETWORKS,
    load_network,
    plays_as,
    policies_in,
    policies_of,
    read_manifest,
    scenario_of,
)
from merge_sumo.road.loader import road_for
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.case import from_unit
from merge_sumo.scenario.scenario import US23
from merge_sumo.simulation.kinematic_simulation import KinematicSimulation
from merge_sumo.simulation.rollout import Rollout
from merge_sumo.training.best_response import best_response
from merge_sumo.training.game import Game, greedy, pool_starts
from merge_sumo.training.reward import Reward, RewardWeights

REGRET_BOUNDS = {
    "pov1": (0.01, 0.05),
    "vut1": (0.01, 0.05),
    "pov2": (0.02, 0.15),
    # The 99th percentile is short of the 15 % aimed at: `policies/README.md` says why.
    "vut2": (0.02, 0.20),
}
"""Mean and 99th percentile of the regret, as shares of the mean gain over level-0 behaviour."""


def uniform_cases(level, count, seed=0):
    points = np.random.default_rng(seed).random((count, 3 if level == 2 else 2))
    return from_unit(points, level, scenario=US23)


@pytest.mark.parametrize("name", ["us23", "human", "roundabout"])
def test_a_shipped_library_is_complete_and_its_manifest_says_how_it_was_made(name):
    folder = policies_in(name) if name == "human" else policies_of(named_scenario(name))
    scenario = US23 if name == "human" else named_scenario(name)
    manifest = read_manifest(folder)
    assert tuple(manifest) == NETWORKS
    weights = dataclasses.asdict(RewardWeights.of(scenario))
    for network_name, entry in manifest.items():
        network = load_network(network_name, folder)
        limited = name == "human" and network_name.startswith("pov")
        assert network.sees_svo == (network_name == "pov2")
        assert network.a_min_mps2 == entry.get("a_min_mps2") == (-2.0 if limited else None)
        assert plays_as(scenario_of(entry), scenario)
        assert entry["reward_weights"] == pytest.approx(weights)
        assert entry["check"]["avoidable_collisions"] == 0
        mean_bound, p99_bound = REGRET_BOUNDS[network_name]
        assert entry["check"]["mean_regret"] <= mean_bound
        assert entry["check"]["p99_regret"] <= p99_bound
    for network_name, opponent in (("pov2", "vut1"), ("vut2", "pov1")):
        assert manifest[network_name]["opponent_sha256"] == manifest[opponent]["sha256"]


def test_learned_episodes_are_the_same_in_1_and_in_32_corridors():
    cases = uniform_cases(1, 50, seed=3) + uniform_cases(2, 50, seed=3)
    assert same(*(run_cases(factory("level1"), cases, corridors) for corridors in (1, 32)))


def states(n):
    rng = np.random.default_rng(1)
    return rng.uniform((-900.0, 0.0, -182.0, 0.0), (200.0, 60.0, 20.0, 60.0), (n, 4))


class TestOtherScenarios:
    def test_in_a_merge_of_half_the_size_they_see_the_same_and_act_half(self):
        half = features(states(20_000).T / 2, scenario=HALF)
        assert np.array_equal(half, features(states(20_000).T, scenario=US23))
        assert np.array_equal(actions_mps2(HALF), actions_mps2(US23) / 2)

    @pytest.mark.parametrize("name", ["pov1", "vut1"])
    def test_on_a_ramp_like_ours_they_are_nearly_rational_as_they_would_not_be_unscaled(self, name):
        role = name[:3]
        game, network = Game(role, None, Reward.of(SMALLER)), load_network(name)
        start = pool_starts(12, np.random.default_rng(2), SMALLER)
        psi = np.zeros(len(start))
        reached = game.play(start, psi, greedy(network, SMALLER))
        best = best_response(game, start, reached)
        scaled = best - reached
        unscaled = best - game.play(start, psi, greedy(network, US23))
        assert scaled.mean() < 0.02
        assert unscaled.mean() > 5.0 * scaled.mean()


class TestALimitOfBraking:
    """A network whose driver brakes by 2 m/s2 at most."""

    LAYERS = (  # weights (actions, features) and biases
        (np.zeros((7, FEATURES)), np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])),
    )
    """Always the hardest braking."""

    def test_is_that_of_its_actions_and_observations_unless_the_scenario_s_is_lower(self):
        limited = QNetwork(self.LAYERS, -2.0)
        assert actions_mps2(limited.limited(US23)).tolist() == [-2, -1.5, -1, -0.5, 0, 1, 2]
        assert limited.limited(dataclasses.replace(US23, a_min_mps2=-1.5)).a_min_mps2 == -1.5
        assert QNetwork(self.LAYERS).limited(US23) is US23
        # The gap at M of a POV that brakes for the 8.125 s of a VUT at 22.4 m/s: columns 13 to 15.
        at = [np.array([v]) for v in (-273.0, 33.0, -182.0, 22.4)]
        whole, half = (features(at, scenario=s)[0] for s in (US23, limited.limited(US23)))
        assert np.flatnonzero(whole != half).tolist() == [13, 14, 15]

    def test_holds_in_a_simulation_in_which_the_vut_brakes_harder(self):
        corridors, case = 2, from_unit(np.array([[0.5, 0.5]]), 1, scenario=US23)[0]
        simulation = KinematicSimulation(corridors, road_for(US23), US23)
        pov = LevelKDriver(corridors, QNetwork(self.LAYERS, -2.0))
        vut = LevelKDriver(corridors, QNetwork(self.LAYERS))
        (found,) = Rollout(simulation, pov, vut, [case]).run()
        assert found.a_pov_mps2[:10].tolist() == [-2.0] * 10
        assert found.a_vut_mps2[:10].tolist() == [-4.0] * 10
