"""Environments, DDQN, best responses and the helix, in real SUMO and small."""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import re
from operator import attrgetter
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from export_policy import export_onnx
from support.calling import invoke
from support.merges import LIKE_A_ROUNDABOUT
from support.plans import plan_for

from merge_sumo.campaigns.scenario_suggestion import unseen
from merge_sumo.drivers.levelk import (
    ACTIONS,
    FEATURES,
    QNetwork,
    actions_mps2,
)
from merge_sumo.drivers.policies import load_network, plays_as, read_manifest, scenario_of
from merge_sumo.errors import UserError
from merge_sumo.road.scenario_file import to_toml
from merge_sumo.scenario.case import from_unit
from merge_sumo.scenario.scenario import US23
from merge_sumo.scenario.trajectory import End
from merge_sumo.simulation.evaluate import simulate_part
from merge_sumo.training import best_response, ddqn, helix, refine, reward
from merge_sumo.training.check import returns_of
from merge_sumo.training.game import Game, greedy, pool_starts
from merge_sumo.training.helix import train_library
from merge_sumo.training.registration import ENV_ID

WEIGHTS = reward.RewardWeights()
REWARD = reward.Reward(WEIGHTS, US23)
ACTIONS_MPS2 = actions_mps2(US23)
TINY = ddqn.DdqnSettings(transitions=600, warm_up=200, updates=1_000, width=16, batch=16)
QUICK = refine.RefineSettings(rounds=2, starts=20, searched=5, beam=4, updates=20, batch=64)
SMALL = helix.TrainingSettings(ddqn=TINY, refine=QUICK, check_cases=4)
COMMAND = ("train", "--only", "pov1", "--a-min", "-2")


class TestEnvironments:
    def test_a_step_is_half_a_second_of_eq_4_against_the_level0_vut(self):
        env = gymnasium.make(ENV_ID, role="pov", opponent="level0")
        before, _ = env.reset(seed=1)
        after, r, terminated, truncated, _ = env.step(5)  # +1 m/s2
        x_pov, v_pov, x_vut, v_vut = before
        expected = x_pov + 0.5 * v_pov + 0.1, v_pov + 0.5, x_vut + 0.5 * v_vut + 0.1, v_vut + 0.5
        assert after == pytest.approx(expected, abs=1e-9)
        assert r == pytest.approx(-0.5 * WEIGHTS.pov_acc)
        assert not terminated
        assert not truncated

    def test_games_of_a_vector_environment_begin_again_in_the_step_after_their_end(self):
        games = gymnasium.make_vec(ENV_ID, num_envs=3, role="vut", opponent="level0")
        games.reset(seed=0)
        ends, ended = 0, np.zeros(3, dtype=bool)
        for _ in range(45):
            observation, rewards, terminated, _, _ = games.step(np.full(3, 5))
            assert (observation[ended, 2] == -182.0).all()
            assert not rewards[ended].any()
            assert (observation[terminated, 2] >= 0.0).all()
            ends, ended = ends + int(terminated.sum()), terminated
        assert ends >= 6


def test_the_tutorial_shows_the_code_that_its_commands_run():
    root = Path(__file__).parents[2]
    page = (root / "docs/how-to/reinforcement-learning.md").read_text(encoding="utf-8")
    code = (root / "examples/merging_agent.py").read_text(encoding="utf-8")
    first, *blocks = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)
    assert "make_vec" in first
    assert len(blocks) == 3
    assert all(block in code for block in blocks)


def trained(seed):
    game = Game("pov", None, REWARD)
    return ddqn.train(game, seed, dataclasses.replace(TINY, updates=200), lambda _: None)


def unrefined():
    torch.manual_seed(0)
    return ddqn.export(ddqn.make_network(FEATURES, 32))


def refined(seed, settings=QUICK):
    return refine.refine(Game("pov", None, REWARD), unrefined(), seed, settings, lambda _: None)


@pytest.mark.slow
@pytest.mark.parametrize("make", [trained, refined])
def test_same_seed_same_weights_and_another_seed_other_weights(make):
    one, two, other = make(0), make(0), make(1)
    for (w1, b1), (w2, b2) in zip(one.layers, two.layers, strict=True):
        assert np.array_equal(w1, w2)
        assert np.array_equal(b1, b2)
    assert not np.array_equal(one.layers[0][0], other.layers[0][0])


class TestDdqn:
    def test_the_numpy_network_equals_the_torch_network(self):
        torch.manual_seed(0)
        network = ddqn.make_network(FEATURES, 32)
        inputs = np.random.default_rng(0).normal(size=(20, FEATURES))
        with torch.no_grad():
            expected = network.double()(torch.from_numpy(inputs)).numpy()
        assert ddqn.export(network).values(inputs) == pytest.approx(expected, abs=1e-12)


class TestBestResponse:
    @pytest.mark.parametrize("role", ["pov", "vut"])
    @pytest.mark.parametrize("v_vut0", [6.0, (5.0, 7.0)])
    def test_it_is_the_best_of_all_sequences_also_where_actions_have_no_common_unit(
        self, role, v_vut0
    ):
        tiny = dataclasses.replace(
            LIKE_A_ROUNDABOUT,
            x_pov0_m=(-18.0, -4.0),
            x_vut0_m=-9.0,
            v_vut0_mps=v_vut0,
            a_min_mps2=-3.1,
            a_max_mps2=2.3,
            timeout_s=2.5,
        )
        game = Game(role, None, reward.Reward.of(tiny))
        start = pool_starts(12, np.random.default_rng(6), tiny)
        sequences = list(itertools.product(range(ACTIONS), repeat=game.max_decisions))
        index, state = np.arange(len(start) * len(sequences)), np.repeat(start, len(sequences), 0)
        returns, arrived = np.zeros(len(index)), np.zeros(len(index), dtype=bool)
        for actions in np.tile(sequences, (len(start), 1)).T:
            a = game.actions_mps2[actions[index]]
            state, gained, over = game.advance(state, np.zeros(len(index)), a)
            returns[index] += gained
            arrived[index[over]] = True
            index, state = index[~over], state[~over]
        returns[~arrived] = -np.inf
        every = returns.reshape(len(start), -1)
        known = every[:, -1]  # full acceleration
        found = best_response.best_response(game, start, known)
        assert found == pytest.approx(every.max(axis=1))
        assert (every.argmax(axis=1) > 0).any()

    def test_a_beam_search_against_a_driver_that_ignores_it_finds_the_exact_answer(self):
        # A network whose action +1 is always the best is the level-0 VUT until 28 m/s.
        zeros = np.zeros((ACTIONS, FEATURES))
        always_1 = QNetwork([(zeros, (ACTIONS_MPS2 == 1.0).astype(float))])
        rng = np.random.default_rng(5)
        x, v = rng.uniform(-340, -180, 6), rng.uniform(25, 35, 6)
        starts = np.stack([x, v, np.full(6, -182.0), np.full(6, 18.0)], axis=1)
        game = Game("pov", always_1, REWARD)
        found, _ = best_response.beam_search(game, starts, np.zeros(6), always_1, width=400)
        exact = best_response.best_response(Game("pov", None, REWARD), starts, found - 0.1)
        assert (found <= exact + 1e-5).all()
        assert np.median(exact - found) < 0.02


@pytest.mark.parametrize("role", ["pov", "vut"])
@pytest.mark.parametrize("scenario", [US23, LIKE_A_ROUNDABOUT], ids=lambda s: s.name)
def test_the_returns_of_a_game_are_those_in_sumo(role, scenario):
    points, played = np.random.default_rng(2).random((8, 2)), reward.Reward.of(scenario)
    level, vut = (1, "level0") if role == "pov" else (0, "level1")
    cases = from_unit(points, level, scenario=scenario)
    start = np.array([np.ravel(case.starts()) for case in cases])
    policy = greedy(load_network(f"{role}1"), scenario)
    expected = Game(role, None, played).play(start, np.zeros(8), policy)
    plan = plan_for(vut, scenario=scenario)
    trajectories = simulate_part(plan, cases, attrgetter("trajectory"))
    ended = [one.end is End.MERGED for one in trajectories]
    returns = returns_of(trajectories, played).of(role, np.zeros(8))
    assert returns[ended] == pytest.approx(expected[ended], abs=1e-9)
    assert any(ended)


def test_refinement_lowers_the_regret():
    game, psi = Game("pov", None, REWARD), np.zeros(16)
    start = pool_starts(16, np.random.default_rng(3), US23)
    enough = dataclasses.replace(QUICK, starts=40, searched=10, beam=8, updates=200)
    before = game.play(start, psi, greedy(unrefined(), US23))
    after = game.play(start, psi, greedy(refined(0, enough), US23))
    best = best_response.best_response(game, start, after)
    assert (best - after).mean() < 0.5 * (best - before).mean()


@pytest.mark.slow
class TestTraining:
    """`merge-sumo train`, end to end and very small, for a scenario on the shipped road."""

    @pytest.fixture(scope="class")
    @classmethod
    def ring(cls, tmp_path_factory):
        """Write the scenario as a file."""
        file = tmp_path_factory.mktemp("scenario") / "ring.toml"
        file.write_text(to_toml(LIKE_A_ROUNDABOUT, []))
        return file

    @pytest.fixture(scope="class")
    @classmethod
    def trained(cls, ring, tmp_path_factory):
        """Train one network, whose driver brakes by 2 m/s2 at most."""
        out = tmp_path_factory.mktemp("own") / "policies"
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(helix, "LEVEL_SETTINGS", {1: SMALL, 2: SMALL})
            done = invoke(*COMMAND, "--scenario", ring, "--out", out)
        assert done.exit_code == 0, done.output
        return out, done.output

    def test_the_regret_is_printed_and_the_manifest_has_the_scenario_and_the_limit(self, trained):
        folder, said = trained
        assert "network  mean regret" in said
        entry = read_manifest(folder)["pov1"]
        assert entry["seed"] == 0
        assert entry["check"]["cases"] == 4
        assert entry["a_min_mps2"] == load_network("pov1", folder).a_min_mps2 == -2.0
        assert plays_as(scenario_of(entry), LIKE_A_ROUNDABOUT)
        assert not plays_as(scenario_of(entry), US23)
        expected = dataclasses.asdict(reward.RewardWeights.of(LIKE_A_ROUNDABOUT))
        assert entry["reward_weights"] == expected
        with pytest.raises(UserError, match="accelerations of its own, down to -2 m/s2"):
            export_onnx("pov1", folder / "pov1.onnx", folder)

    def test_a_network_has_a_log(self, trained):
        lines = (trained[0] / "pov1.training.jsonl").read_text().splitlines()
        first, last = json.loads(lines[0]), json.loads(lines[-1])
        assert (first["network"], first["stage"], first["done"]) == ("pov1", "ddqn", TINY.updates)
        assert (last["stage"], last["done"]) == ("refine", QUICK.rounds)

    def test_a_finished_network_is_trained_again_for_no_other_plan(self, trained, monkeypatch):
        folder, _ = trained
        monkeypatch.setattr(helix, "LEVEL_SETTINGS", {1: SMALL, 2: SMALL})
        before = (folder / "pov1.safetensors").stat().st_mtime_ns
        limited: dict[str, Any] = {"scenario": LIKE_A_ROUNDABOUT, "a_min_mps2": -2.0}
        said: list[str] = []
        train_library(folder, ("pov1",), **limited, say=said.append)
        assert said == ["pov1 exists already"]
        for other in ({"a_min_mps2": None}, {"a_min_mps2": -1.0}, {"seed": 1}, {"scenario": US23}):
            with pytest.raises(UserError, match=r"has a pov1 of another .*`out`"):
                train_library(folder, ("pov1",), **limited | other)
        assert (folder / "pov1.safetensors").stat().st_mtime_ns == before

    def test_the_drivers_know_the_scenario_and_the_shipped_ones_do_not(self, trained, ring):
        assert unseen(LIKE_A_ROUNDABOUT, trained[0]) == []
        said = invoke("scenario", "check", ring).output
        assert "a_min_mps2 -4 corresponds to -8.51 in us23; training used -4" in said
        assert f"merge-sumo train --scenario {ring} --out ring-policies" in said

    def test_a_check_measures_the_regret_on_the_scenario(self, trained, ring):
        words = ("train", "--check", "--only", "pov1", "--cases", 4, "--json", "--out", trained[0])
        done = invoke(*words, "--scenario", ring)
        assert json.loads(done.stdout)["pov1"] == read_manifest(trained[0])["pov1"]["check"]
        assert "was trained for ring: set `scenario`" in str(invoke(*words).exception)

    def test_a_process_that_ends_is_a_sentence(self, tmp_path, monkeypatch):
        monkeypatch.setattr(helix, "_train_one", os._exit)
        with pytest.raises(UserError, match="the process that trains pov1 has ended"):
            train_library(tmp_path, ("pov1",), scenario=US23)
        assert read_manifest(tmp_path) == {}


@pytest.mark.parametrize("a_min_mps2", [0.0, -4.5, float("nan")])
def test_a_limit_outside_that_of_the_scenario_is_refused(tmp_path, a_min_mps2):
    with pytest.raises(UserError, match="choose a number from -4 to below 0"):
        train_library(tmp_path / "new", scenario=US23, a_min_mps2=a_min_mps2)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ("--only", "pov2", "--out", "new"),
            "unknown policy 'vut1' in new: run `merge-sumo train --out new`",
        ),
        (("--only", "pov3"), "unknown network 'pov3': choose pov1, vut1, pov2, vut2"),
        (("--scenario", "roundabout"), "the shipped policies are for us23"),
        (
            ("--check", "--out", "none"),
            "unknown policy 'pov1' in none: run `merge-sumo train --out none`",
        ),
    ],
)
def test_a_training_that_cannot_be_is_refused(tmp_path, monkeypatch, words, said):
    monkeypatch.chdir(tmp_path)
    assert said in str(invoke("train", *words).exception)
