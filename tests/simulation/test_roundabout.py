"""The second shipped scenario: its road, its pool and its drivers."""

# mypy: no-strict-optional

from __future__ import annotations

import dataclasses

import pytest

from merge_sumo.drivers.policies import (
    NETWORKS,
    load_network,
    plays_as,
    policies_of,
    read_manifest,
    scenario_of,
)
from merge_sumo.road.merge import road_for
from merge_sumo.road.scenario_file import named_scenario, shipped_scenarios
from merge_sumo.scenario.scenario import US23
from merge_sumo.training.reward import RewardWeights

ROUNDABOUT = named_scenario("roundabout")


class TestItsDrivers:
    def test_are_its_own_and_rational(self):
        folder = policies_of(ROUNDABOUT)
        assert folder == policies_of(scenario=US23) / "roundabout"
        manifest = read_manifest(folder)
        assert tuple(manifest) == NETWORKS
        for name, entry in manifest.items():
            assert load_network(name, folder).sees_svo == (name == "pov2")
            assert plays_as(scenario_of(entry), ROUNDABOUT)
            weights = RewardWeights.of(ROUNDABOUT)
            assert entry["reward_weights"] == pytest.approx(dataclasses.asdict(weights))
            assert entry["check"]["mean_regret"] <= 0.02
            assert entry["check"]["avoidable_collisions"] == 0
        for name, opponent in (("pov2", "vut1"), ("vut2", "pov1")):
            assert manifest[name]["opponent_sha256"] == manifest[opponent]["sha256"]


def test_every_shipped_scenario_has_a_road_with_room_for_its_starts():
    assert {"us23", "roundabout"} <= set(shipped_scenarios())
    for name in shipped_scenarios():
        scenario = named_scenario(name)
        assert scenario.name == name
        road_for(scenario)
