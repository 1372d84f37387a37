"""Environments, DDQN, best responses and the helix, in real SUMO and small."""

from __future__ import annotations

import dataclasses
import itertools
import json
import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from export_policy import export_onnx
from support.calling import invoke
from support.merges import LIKE_A_ROUNDABOUT

from merge_sumo.campaigns.scenario_suggestion import unseen
from merge_sumo.drivers.level0 import Level0Pov, Level0Vut
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
from merge_sumo.training import best_response, ddqn, helix, refine, reward
from merge_sumo.training.check import play, returns_of
from merge_sumo.training.game import Game, greedy, pool_starts
from merge_sumo.training.helix import train_library
from merge_sumo.training.registration import ENV_ID

WEIGHTS = reward.RewardWeights()
REWARD = reward.Reward(WEIGHTS, US23)
ACTIONS_MPS2 = actions_mps2(US23)
TINY = ddqn.DdqnSettings(transitions=600, warm_up=200, updates=1_000, width=16, batch=16)
QUICK = refine.RefineSettings(rounds=2, starts=20, searched=5, beam=4, updates=20, batch=64)
SMALL = helix.TrainingSettings(ddqn=TINY, refine=QUICK, check_cases=4)


class TestEnvironments:
    def test_a_step_is_half_a_second_of_eq_4_against_the_level0_vut(self):
        env = gymnasium.make(ENV_ID, role="pov", opponent="level0")
        (x_pov, v_pov, x_vut, v_vut), _ = env.reset(seed=1)
        (x, v, xv, vv), r, terminated, truncated, _ = env.step(5)  # +1 m/s2
        assert x == pytest.approx(x_pov + 0.5 * v_pov + 0.1, abs=1e-9)
        assert v == pytest.approx(v_pov + 0.5, abs=1e-9)
        assert xv == pytest.approx(x_vut + 0.5 * v_vut + 0.1, abs=1e-9)
        assert vv == pytest.approx(v_vut + 0.5, abs=1e-9)
        assert r == pytest.approx(-0.5 * WEIGHTS.pov_acc)
        assert not terminated
        assert not truncated

    def test_games_of_a_vector_environment_begin_anew_in_the_step_after_their_end(self):
        games = gymnasium.make_vec(ENV_ID, num_envs=3, role="vut", opponent="level0")
        games.reset(seed=0)
        ends, ended = 0, np.zeros(3, dtype=bool)
        for _ in range(45):
            observation, rewards, terminated, _, _ = games.step(np.full(3, 5))
            assert (observation[ended, 2] == -182.0).all()
            assert not rewards[ended].any()
            assert not terminated[ended].any()
            assert (observation[terminated, 2] >= 0.0).all()
            ends, ended = ends + int(terminated.sum()), terminated
        assert ends >= 6


def test_the_tutorial_shows_the_code_that_its_commands_run():
    root = Path(__file__).parents[2]
    page = (root / "docs/tutorials/reinforcement-learning.md").read_text(encoding="utf-8")
    code = (root / "examples/merging_agent.py").read_text(encoding="utf-8")
    first, *blocks = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)
    assert "make_vec" in first
    assert len(blocks) == 3
    assert all(block in code for block in blocks)


def trained(seed):
    game = Game("pov", None, REWARD)
    return ddqn.train(game, seed, dataclasses.replace(TINY, updates=200))


def unrefined():
    torch.manual_seed(0)
    return ddqn.export(ddqn.make_network(FEATURES, 32))


def refined(seed, settings=QUICK):
    return refine.refine(Game("pov", None, REWARD), unrefined(), seed, settings)


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
        assert best_response.best_response(game, start) == pytest.approx(every.max(axis=1))
        assert (every.argmax(axis=1) > 0).any()

    def test_a_beam_search_against_a_driver_that_ignores_it_finds_the_exact_answer(self):
        # A network whose action +1 is always the best is the level-0 VUT until 28 m/s.
        zeros = np.zeros((ACTIONS, FEATURES))
        always_1 = QNetwork([(zeros, (ACTIONS_MPS2 == 1.0).astype(float))])
        rng = np.random.default_rng(5)
        x, v = rng.uniform(-340, -180, 6), rng.uniform(25, 35, 6)
        starts = np.stack([x, v, np.full(6, -182.0), np.full(6, 18.0)], axis=1)
        exact = best_response.best_response(Game("pov", None, REWARD), starts)
        game = Game("pov", always_1, REWARD)
        found, _ = best_response.beam_search(game, starts, np.zeros(6), always_1, width=400)
        assert (found <= exact + 1e-5).all()
        assert np.median(exact - found) < 0.02


class TestGame:
    """The game as a function of states, beside the one in SUMO."""

    @pytest.fixture
    def network(self):
        torch.manual_seed(1)
        return ddqn.export(ddqn.make_network(FEATURES, 32))

    @pytest.mark.parametrize("role", ["pov", "vut"])
    @pytest.mark.parametrize("scenario", [US23, LIKE_A_ROUNDABOUT], ids=lambda s: s.name)
    def test_its_returns_are_those_of_the_game_in_sumo(self, role, network, scenario):
        points, played = np.random.default_rng(2).random((8, 2)), reward.Reward.of(scenario)
        cases = from_unit(points, 1, scenario=scenario)
        start = np.array([[x for at in case.starts() for x in at] for case in cases])
        pair = (network, Level0Vut) if role == "pov" else (Level0Pov, network)
        expected = Game(role, None, played).play(start, np.zeros(8), greedy(network, scenario))
        trajectories = play(cases, *pair)
        ended = [one.end is End.MERGED for one in trajectories]
        returns = returns_of(trajectories, played).of(role, np.zeros(8))
        assert returns[ended] == pytest.approx(expected[ended], abs=1e-9)
        assert any(ended)


class TestRefinement:
    def test_it_lowers_the_regret(self):
        game, psi = Game("pov", None, REWARD), np.zeros(100)
        start = pool_starts(100, np.random.default_rng(3), US23)
        best = best_response.best_response(game, start)
        enough = dataclasses.replace(QUICK, starts=40, searched=10, beam=8, updates=200)
        before, after = (
            (best - game.play(start, psi, greedy(network, US23))).mean()
            for network in (unrefined(), refined(0, enough))
        )
        assert after < 0.5 * before


class TestHelix:
    @pytest.fixture(scope="class")
    @classmethod
    def library(cls, tmp_path_factory):
        folder = tmp_path_factory.mktemp("policies")
        train_library(folder, ("pov1",), settings=SMALL, scenario=US23)
        return folder

    @pytest.mark.slow
    def test_a_network_has_a_manifest_entry_and_a_log(self, library):
        entry = read_manifest(library)["pov1"]
        assert entry["command"] == "merge-sumo train --only pov1 --seed 0"
        assert entry["check"]["cases"] == 4
        lines = (library / "pov1.training.jsonl").read_text().splitlines()
        first, last = json.loads(lines[0]), json.loads(lines[-1])
        assert (first["stage"], first["done"]) == ("ddqn", TINY.updates)
        assert (last["stage"], last["done"]) == ("refine", QUICK.rounds)
        assert load_network("pov1", library).layers[-1][0].shape[0] == 7

    @pytest.mark.slow
    def test_a_finished_network_is_not_trained_again(self, library):
        before = (library / "pov1.safetensors").stat().st_mtime_ns
        told = []
        train_library(
            library,
            ("pov1",),
            settings=SMALL,
            on_done=lambda *said: told.append(said),
            scenario=US23,
        )
        assert told == [("pov1", None)]
        assert (library / "pov1.safetensors").stat().st_mtime_ns == before

    @pytest.mark.slow
    def test_a_pov_with_a_limit_of_braking_keeps_it_in_its_file(self, tmp_path):
        train_library(tmp_path, ("pov1",), settings=SMALL, scenario=US23, a_min_mps2=-2.0)
        entry = read_manifest(tmp_path)["pov1"]
        assert entry["command"] == "merge-sumo train --only pov1 --seed 0 --a-min -2"
        assert entry["a_min_mps2"] == load_network("pov1", tmp_path).a_min_mps2 == -2.0
        for other in (None, -1.0):
            with pytest.raises(UserError, match=r"has a pov1 of another .*`out`"):
                train_library(tmp_path, ("pov1",), settings=SMALL, scenario=US23, a_min_mps2=other)
        with pytest.raises(UserError, match="accelerations of its own, down to -2 m/s2"):
            export_onnx("pov1", tmp_path / "pov1.onnx", tmp_path)

    @pytest.mark.parametrize("a_min_mps2", [0.0, 1.0, -4.5, float("nan")])
    def test_a_limit_that_is_none_of_the_scenario_is_refused(self, tmp_path, a_min_mps2):
        with pytest.raises(UserError, match="choose a number from -4 to below 0"):
            train_library(tmp_path / "new", scenario=US23, a_min_mps2=a_min_mps2)
        assert not (tmp_path / "new").exists()

    def test_level_2_needs_level_1_first(self, tmp_path):
        with pytest.raises(UserError, match="pov2 is trained against vut1: train that one first"):
            train_library(tmp_path, ("pov2",), settings=SMALL, scenario=US23)


class TestTrainingForAnotherScenario:
    """`merge-sumo train --scenario`, end to end and very small."""

    @pytest.fixture(scope="class")
    @classmethod
    def ring(cls, tmp_path_factory):
        """Write the scenario as a file; it lies on the shipped road."""
        file = tmp_path_factory.mktemp("scenario") / "ring.toml"
        file.write_text(to_toml(LIKE_A_ROUNDABOUT, []))
        return file

    @pytest.fixture(scope="class")
    @classmethod
    def trained(cls, ring, tmp_path_factory):
        """Train one network."""
        out = tmp_path_factory.mktemp("own") / "policies"
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(helix, "LEVEL_SETTINGS", {1: SMALL, 2: SMALL})
            done = invoke("train", "--scenario", ring, "--out", out, "--only", "pov1")
        assert done.exit_code == 0, done.output
        return out, done.output

    @pytest.mark.slow
    def test_the_regret_is_printed_and_the_manifest_has_the_scenario(self, trained):
        folder, said = trained
        assert "network  mean regret" in said
        entry = read_manifest(folder)["pov1"]
        assert entry["command"] == "merge-sumo train --only pov1 --seed 0 --scenario ring"
        assert entry["scenario"]["x_vut0_m"] == -40.02
        assert plays_as(scenario_of(entry), LIKE_A_ROUNDABOUT)
        assert not plays_as(scenario_of(entry), US23)
        expected = dataclasses.asdict(reward.RewardWeights.of(LIKE_A_ROUNDABOUT))
        assert entry["reward_weights"] == expected

    @pytest.mark.slow
    def test_its_drivers_know_the_scenario_and_the_shipped_ones_do_not(self, trained, ring):
        assert unseen(LIKE_A_ROUNDABOUT, trained[0]) == []
        said = invoke("scenario", "check", ring, "--policies", trained[0]).output
        assert "were trained on such starts" in said
        said = invoke("scenario", "check", ring).output
        assert "a_min_mps2 -4 is like -8.51 in us23 (trained on -4)" in said
        assert f"merge-sumo train --scenario {ring} --out ring-policies" in said

    @pytest.mark.slow
    def test_a_check_measures_the_regret_on_the_scenario(self, trained, ring):
        words = ("train", "--check", "--scenario", ring, "--only", "pov1", "--cases", 4, "--json")
        done = invoke(*words, "--out", trained[0])
        assert json.loads(done.stdout)["pov1"] == read_manifest(trained[0])["pov1"]["check"]

    def test_a_check_without_the_scenario_says_what_is_missing(self, trained):
        done = invoke("train", "--check", "--out", trained[0], "--only", "pov1")
        assert "was trained for ring: say with `scenario`" in str(done.exception)
